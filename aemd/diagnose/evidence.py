"""What a check answers: how surprising, and which terms could explain it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import erfc, exp, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.stats import gamma, norm

from aemd.diagnose.hypothesis import Term
from aemd.diagnose.result import Value

__all__ = ["Defect", "Evidence", "bonferroni", "two_sided", "weighted_chi2_tail"]

Floats = NDArray[np.float64]


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
    third cumulant vanishes.
    """
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
