"""What a check answers: how surprising, and which terms could explain it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import erfc, exp, log, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.stats import gamma, norm

from aemd.diagnose.hypothesis import Term
from aemd.diagnose.result import Value

__all__ = ["Defect", "Evidence", "bonferroni", "two_sided", "weighted_chi2_tail"]

Floats = NDArray[np.float64]


_CLOSER_BELOW = 0.05
"""Probability of a sum of squares from which its law is taken by its first three cumulants."""
_MOST_STEPS = 60


@dataclass(frozen=True, slots=True)
class Evidence:
    """The outcome of one check on the residuals."""

    check: str
    p_value: float
    """Over the check's whole grid; uniform, or larger, if the model is right."""
    observed: float
    low: float
    """Where the statistic lies in 95 % of the cases if the model is right."""
    high: float
    terms: tuple[Term, ...] = ()
    """What could explain it, with starts from the statistic; empty where the check is for anything."""
    looks: str = ""
    """Of a check for anything: where it is and what it looks like, in words that follow `Unexplained:`."""


@dataclass(frozen=True, slots=True)
class Defect:
    """Something that is wrong with the readings themselves, told without a model of the input."""

    cause: str
    p_value: float
    parameters: Mapping[str, Value]
    experiment: str
    check: str
    observed: float
    expected: float
    """At most this if nothing is wrong."""
    dropped: NDArray[np.bool_] | None = None
    """Readings to leave out of everything that follows, shape (n,)."""
    rivals: tuple[str, ...] = field(default=())


def two_sided(score: float) -> float:
    """Return the probability that |N(0, 1)| exceeds |score|."""
    return erfc(abs(score) / sqrt(2))


def bonferroni(p_value: float, trials: float) -> float:
    """Return the probability that any of so many independent trials is as extreme.

    >>> bonferroni(0.01, 1)
    0.01
    """
    return float(-np.expm1(trials * np.log1p(-min(p_value, 1 - 1e-16))))


def weighted_chi2_tail(weights: Floats, observed: float, dof: int = 1) -> float:
    """Return P(sum w_i (c_i - dof) > observed) for independent chi-square variables c_i of `dof` degrees of freedom.

    By a shifted gamma law with the sum's second and third cumulants 2 dof sum w^2 and 8 dof sum w^3, which is exact for
    equal weights (Wilson and Hilferty's case) and close wherever no few weights dominate; the normal law where the
    third cumulant vanishes. A small probability is looked at more closely, because that law ends on one side, and a sum
    with weights of both signs does not.

    >>> round(weighted_chi2_tail(np.ones(1), 2.841), 3)
    0.05
    """
    p_value = _by_cumulants(weights, observed, dof)
    return p_value if p_value > _CLOSER_BELOW else _by_saddle(weights, observed, dof, p_value)


def _by_saddle(weights: Floats, observed: float, dof: int, otherwise: float) -> float:
    """Return the same tail by the saddle-point (Lugannani and Rice 1980; Kuonen 1999 for these sums).

    The cumulant function K(t) = -dof/2 sum log(1 - 2 w t) - dof t sum w has its slope K' = observed at one t within
    1/(2 min w) and 1/(2 max w). Newton's steps, halved where they would leave that interval.
    """
    scale = float(np.abs(weights).max())
    w = weights[np.abs(weights) > 1e-9 * scale] / scale if scale > 0 else weights
    x = observed / scale if scale > 0 else 0.0
    top = 1 / (2 * float(w.max())) if w.size and w.max() > 0 else np.inf
    low, high = 0.0, top
    if x <= 0 or (top == np.inf and x >= -dof * float(w.sum())):  # not a tail, or beyond the greatest sum there is
        return otherwise
    left, bend = np.ones(w.size), 2 * dof * float(np.sum(w**2))
    t = min(x / bend, 0.9 * top)
    for _ in range(_MOST_STEPS):
        left = 1 - 2 * w * t
        slope, bend = dof * float(np.sum(2 * w**2 * t / left)), dof * float(np.sum(2 * w**2 / left**2))
        if abs(slope - x) < 1e-9 * x:
            break
        low, high = (t, high) if slope < x else (low, t)
        step = t + (x - slope) / bend
        t = step if low < step < high else 0.5 * (low + high) if high < np.inf else 2 * t
    cumulant = -dof / 2 * float(np.sum(np.log(left))) - dof * t * float(np.sum(w))
    r, u = sqrt(max(2 * (t * x - cumulant), 1e-300)), t * sqrt(bend)
    return float(norm.sf(r + log(u / r) / r))


def _by_cumulants(weights: Floats, observed: float, dof: int) -> float:
    """Return the tail by the law of the same second and third cumulants; see `weighted_chi2_tail`."""
    second, third = 2 * dof * float(np.sum(weights**2)), 8 * dof * float(np.sum(weights**3))
    if second <= 0:
        return 1.0
    if abs(third) < 1e-6 * second**1.5:
        return float(norm.sf(observed / sqrt(second)))
    shape = 4 * second**3 / third**2
    scale = abs(third) / (2 * second)
    if third > 0:
        return float(gamma.sf(observed / scale + shape, shape))
    return float(gamma.cdf(shape - observed / scale, shape))


def exceedance_of_peaks(power: float, cells: float) -> float:
    """Return the probability that a whitened periodogram, exponential at each frequency, exceeds `power` anywhere.

    Baluev (2008) for sinusoids: at most e^-z (1 + W sqrt z) with W = band times effective span, here `cells`.
    """
    return float(min(1.0, exp(-power) * (1 + cells * sqrt(power))))
