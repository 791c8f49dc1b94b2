"""Whether the reading's level brings an offset or a noise of its own, as a range does."""

from math import exp, log, sqrt

import numpy as np
from scipy.special import ndtr
from scipy.stats import chi2

from aemd.diagnose.evidence import Evidence, bonferroni
from aemd.diagnose.fit import Fit, densities
from aemd.diagnose.terms.lines import amplitude_cost
from aemd.diagnose.terms.ranges import RangeOffset, RangeSwitching, in_wide_range

__all__ = ["check_hole", "check_range_switching"]

_PARTS = np.linspace(0.05, 0.95, 19)
"""Of the readings, below the threshold that is tried."""
_WORTH = 6.0
"""Nats that closing a hole must add: a dead band and a lattice leave holes too, and closing those moves readings away
from where they were expected."""


def check_range_switching(fit: Fit) -> Evidence:
    """Regress the residuals, and their squares, on being in the wider range, for thresholds all over the readings.

    The reading before says which range, so both are sums whose terms the past decides; together chi-square of two
    degrees.
    """
    data, used = fit.data, fit.data.used
    magnitude = np.abs(data.y + data.origin_V / data.unit_V)[used]
    squares = np.where(used, fit.z**2, 0.0)
    spread = max(float(np.var(squares[used])), 1e-12)
    best, trials = (0.0, 0.0, 0.0, 0.0), 0
    for threshold in np.unique(np.quantile(magnitude, _PARTS)):
        wide = in_wide_range(data, float(threshold), 0.0)
        shape = fit.whitened(wide)
        louder = np.where(used, wide - wide[used].mean(), 0.0)
        size, loud = float(shape @ shape), float(louder @ louder)
        if size <= 0 or loud <= 0:
            continue
        trials += 1
        power = float(shape @ fit.z) ** 2 / size + float(louder @ squares) ** 2 / (loud * spread)
        if power > best[0]:
            best = power, float(threshold), float(shape @ fit.z) / size, float(louder @ squares) / loud
    power, threshold, offset, more = best
    p_value = bonferroni(float(chi2.sf(power, 2)), max(trials, 1))
    terms: tuple[RangeSwitching, ...] = ()
    if p_value < 0.05:
        sd = sqrt(max(more, 0.01) * float(np.median(fit.variance[used])))
        cost = amplitude_cost(2, data.n) + log(max(trials, 1))
        terms = (RangeSwitching(threshold, 0.0, offset, sd, cost),)
    return Evidence(
        check="residuals and their squares against the reading's range: chi-square of two degrees",
        p_value=p_value,
        observed=power,
        low=1.0,
        high=float(chi2.isf(0.025 / max(trials, 1), 2)),
        terms=terms,
    )


def check_hole(fit: Fit) -> Evidence:
    """Look for the hole among the readings that they should have fallen into.

    Given the past, a reading falls into a stated interval with the probability that the filter gives it; that none did
    has the product of what is left, and the hole is one of as many as there are readings.
    """
    data, used = fit.data, fit.data.used
    if any(isinstance(term, RangeOffset) for term in fit.terms):  # one is closed, and a second is not looked for
        return _hole(1.0, 0.0, data.n, ())
    inner = np.sort(fit.y[used])[data.n // 20 : -(data.n // 20)]
    gaps = np.diff(inner)
    at = int(np.argmax(gaps))
    if gaps[at] < 2 * np.partition(gaps, -2)[-2]:  # one of many: a lattice
        return _hole(1.0, 0.0, data.n, ())
    low, high = float(inner[at]), float(inner[at + 1])
    sd = np.sqrt(fit.variance[used])
    inside = ndtr((high - fit.predicted[used]) / sd) - ndtr((low - fit.predicted[used]) / sd)
    expected = float(inside.sum())
    p_value = min(1.0, data.n * exp(max(float(np.log1p(-np.minimum(inside, 1 - 1e-12)).sum()), -650.0)))
    terms: tuple[RangeOffset, ...] = ()
    if p_value < 0.01:
        term = RangeOffset(low, high, (low + high) / 2 * data.unit_V + data.origin_V > 0, log(data.n))
        theta = np.append(fit.theta, term.start)
        if float(densities([*fit.terms, term], theta, data).sum()) > fit.log_likelihood + _WORTH:
            terms = (term,)
        else:
            p_value = 1.0
    if np.count_nonzero(~used) > expected / 4:  # readings that were kept out, such as a dead band's, may lie there
        p_value, terms = 1.0, ()
    return _hole(p_value, expected, data.n, terms)


def _hole(p_value: float, expected: float, n: int, terms: tuple[RangeOffset, ...]) -> Evidence:
    return Evidence(
        check="readings missing from a hole between two levels: how many were expected there",
        p_value=p_value,
        observed=expected,
        low=0.0,
        high=log(n / 0.025),
        terms=terms,
    )
