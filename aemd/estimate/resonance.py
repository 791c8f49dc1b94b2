"""The resonances of what vibrates: an autoregression fitted to readings, as parts that one common noise drives.

y_k = a_1 y_{k-1} + ... + a_p y_{k-p} + e_k has the response 1 / prod(1 - p_j / z) = sum(r_j / (1 - p_j / z)), with
r_j = 1 / prod_{i != j}(1 - p_i / p_j). So y is the sum of p first-order processes, all driven by the same e, and two
with conjugate poles are one that swings: rho = |p_j|, theta = arg p_j, driven by 2 r_j e.
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
_LEAST_ERROR = 1e-9  # a sine without noise leaves none, and its logarithm is taken
_SAME = 1e-9  # imaginary part below which a pole is real


@dataclass(frozen=True, slots=True)
class Resonances:
    """The parts of an autoregression; one for each pair of conjugate poles, and for each real one."""

    tau: NDArray[np.float64]
    """Readings in which each forgets."""
    frequency: NDArray[np.float64]
    """Cycles per reading."""
    gain: NDArray[np.complex128]
    """By which the common noise drives each."""
    error: float
    """Standard deviation of the common noise, in the unit of the readings."""


def find_resonances(stretches: Sequence[NDArray[np.float64]], order: int) -> Resonances:
    """Return the resonances of an autoregression fitted by least squares, shocks put aside.

    Args:
        stretches: readings about their middle, each without holes.
        order: of the autoregression.
    """
    rows = np.concatenate(
        [np.lib.stride_tricks.sliding_window_view(value, order + 1) for value in stretches if value.size > order]
    )
    reach = _SHOCK * float(np.median(np.abs(rows[:, -1]))) / 0.6745  # of a Gaussian, the median
    kept = np.abs(rows).max(axis=1) <= reach
    if np.count_nonzero(kept) < _LEAST_ROWS * order:
        kept[:] = True
    for _ in range(4):
        weights = np.linalg.lstsq(rows[kept, :-1], rows[kept, -1], rcond=None)[0]
        error = rows[:, -1] - rows[:, :-1] @ weights
        kept = np.abs(error) <= _SHOCK * float(np.median(np.abs(error))) / 0.6745
    poles = np.roots(np.concatenate([[1.0], -weights[::-1]])).astype(complex)
    poles[poles == 0] = 1e-12
    poles *= np.minimum(1.0, _FURTHEST / np.abs(poles))
    apart = 1 - poles[None, :] / poles[:, None]
    np.fill_diagonal(apart, 1.0)
    residues = 1 / np.prod(apart, axis=1)
    upper, real = poles.imag > _SAME, np.abs(poles.imag) <= _SAME
    chosen = upper | real
    return Resonances(
        tau=-1 / np.log(np.abs(poles[chosen])),
        frequency=np.abs(np.angle(poles[chosen])) / (2 * math.pi),
        gain=np.where(upper[chosen], 2.0, 1.0) * residues[chosen],
        error=max(float(np.std(error[kept])), _LEAST_ERROR),
    )
