"""The curve from whose slopes AEM chooses its window (eq. 17), as two constant matrices."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["fit_matrices"]


def fit_matrices(history: int, order: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what takes the last readings to the slopes of a least-squares polynomial through them.

    On equally spaced readings the fit is a constant matrix. In orthonormal polynomials p_j it is a sum of c_j p_j, with
    c_j the inner product of p_j and the readings; the slope between neighbours is the sum of c_j (p_j(i+1) - p_j(i)).
    p_0 has no slope, and p_1 the same everywhere, so neither bears on how far the slopes spread.

    Args:
        history: readings that the curve is fitted to, more than `order`.
        order: degree of the polynomial, at least 2: the slopes of a straight line do not spread.

    Returns:
        Coefficients from readings, oldest first, shape (order - 1, history), and slopes from coefficients, per reading,
        shape (history - 1, order - 1).
    """
    place = np.linspace(-1.0, 1.0, history)
    polynomials, _ = np.linalg.qr(np.polynomial.legendre.legvander(place, order))
    bent = polynomials[:, 2:]
    return np.ascontiguousarray(bent.T), np.ascontiguousarray(np.diff(bent, axis=0))
