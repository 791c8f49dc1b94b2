"""The resonances of what vibrates: an autoregression fitted to readings, as parts that one common noise drives.

y_k = a_1 y_{k-1} + ... + a_p y_{k-p} + e_k has the response 1 / prod(1 - p_j / z) = sum(r_j / (1 - p_j / z)), with
r_j = 1 / prod_{i != j}(1 - p_i / p_j). So y is the sum of p first-order processes, all driven by the same e, and two
with conjugate poles are one that swings: rho = |p_j|, theta = arg p_j, driven by 2 r_j e.

Least squares finds them at once, where a search by likelihood would take a day over forty numbers; the order is found
by it too (Schwarz's criterion), since one triangle, X = Q R, holds the fits of every order up to the highest.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Resonances", "find_resonances"]

_FURTHEST = 1 - 1e-6  # of a pole from 0; least squares may put one beyond 1, and what it described would grow
_SHOCK = 5.0  # standard deviations of the error beyond which a reading has no say
_LEAST_ROWS = 10  # for each weight, or they would fit what little there is
_LEAST_ERROR = 1e-9  # in rms readings: a sine without noise leaves none, and its logarithm is taken
_SAME = 1e-9  # imaginary part below which a pole is real
_MOST_GAIN = 1e3  # of a part: where poles nearly coincide their parts cancel, to fewer digits than there are


@dataclass(frozen=True, slots=True)
class Resonances:
    """The parts of an autoregression; one for each pair of conjugate poles, and for each real one."""

    order: int
    """Of the autoregression."""
    tau: NDArray[np.float64]
    """Readings in which each forgets."""
    frequency: NDArray[np.float64]
    """Cycles per reading."""
    gain: NDArray[np.complex128]
    """By which the common noise drives each."""
    error_V: float
    """Standard deviation of the common noise, V."""


def find_resonances(stretches: Sequence[tuple[NDArray[np.int64], NDArray[np.float64]]], most: int) -> Resonances | None:
    """Return the resonances of the autoregression that explains readings best for its order, shocks put aside.

    Args:
        stretches: numbers of readings, and the readings about their middle.
        most: resonances, each of two poles.

    Returns:
        None where the readings in a row are too few.
    """
    most = min(2 * most, sum(value.size for _, value in stretches) // _LEAST_ROWS)
    rows = np.concatenate([np.empty((0, most + 1)), *(_rows(index, value, most) for index, value in stretches)])
    if most == 0 or len(rows) < _LEAST_ROWS * most:
        return None
    reach = _SHOCK * float(np.median(np.abs(rows[:, -1]))) / 0.6745  # of a Gaussian, the median
    kept = np.abs(rows).max(axis=1) <= reach
    if np.count_nonzero(kept) < _LEAST_ROWS * most:
        kept[:] = True
    for _ in range(4):
        R = np.asarray(np.linalg.qr(rows[kept], mode="r"), dtype=np.float64)
        error = rows[:, -1] - rows[:, :-1] @ _weights(R, most)
        size, kept = np.count_nonzero(kept), np.abs(error) <= _SHOCK * float(np.median(np.abs(error))) / 0.6745
    orders = np.arange(1, most + 1)
    variance = np.cumsum(R[::-1, -1] ** 2)[::-1] / size  # of the error of each order, from 0
    variance = np.maximum(variance[1:], _LEAST_ERROR**2 * variance[0])
    for order in orders[np.argsort(size * np.log(variance) + orders * math.log(size))].tolist():
        poles, residues = _split(_weights(R, order))
        if np.abs(residues).max() < _MOST_GAIN:
            break
    upper, real = poles.imag > _SAME, np.abs(poles.imag) <= _SAME
    chosen = upper | real
    return Resonances(
        order=order,
        tau=-1 / np.log(np.abs(poles[chosen])),
        frequency=np.abs(np.angle(poles[chosen])) / (2 * math.pi),
        gain=np.where(upper[chosen], 2.0, 1.0) * residues[chosen],
        error_V=math.sqrt(variance[order - 1]),
    )


def _rows(index: NDArray[np.int64], value: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """Return each reading after those before it, the latest first, where none is missing; shape (rows, most + 1)."""
    if value.size <= most:
        return np.empty((0, most + 1))
    latest_first = np.lib.stride_tricks.sliding_window_view(value, most + 1)[:, ::-1]
    rows = np.roll(latest_first, -1, axis=1)  # the reading itself last
    return np.asarray(rows[index[most:] - index[:-most] == most])


def _weights(R: NDArray[np.float64], order: int) -> NDArray[np.float64]:
    """Return a_1 to a_p: what R says of the last column by the first p; of least norm where R is singular."""
    return np.asarray(np.linalg.lstsq(R[:order, :order], R[:order, -1], rcond=None)[0])


def _split(weights: NDArray[np.float64]) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the poles p_j and the residues r_j."""
    poles = np.roots(np.concatenate([[1.0], -weights])).astype(complex)
    poles[poles == 0] = 1e-12
    poles *= np.minimum(1.0, _FURTHEST / np.abs(poles))
    apart = 1 - poles[None, :] / poles[:, None]
    np.fill_diagonal(apart, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):  # two poles that are the same have none
        return poles, 1 / np.prod(apart, axis=1)
