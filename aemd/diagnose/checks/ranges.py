"""Whether the reading's level brings an offset or a noise of its own, as a range does."""

from math import exp, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc, ndtr, ndtri
from scipy.stats import chi2

from aemd.diagnose.evidence import Evidence, bonferroni
from aemd.diagnose.fit import Fit, densities
from aemd.diagnose.hypothesis import Base
from aemd.diagnose.kernels import whiten
from aemd.diagnose.terms.lines import amplitude_cost
from aemd.diagnose.terms.ranges import RangeOffset, RangeOverlap, RangeSwitching, in_wide_range

__all__ = ["check_hole", "check_overlap", "check_range_switching"]

Floats = NDArray[np.float64]

_PARTS = np.linspace(0.05, 0.95, 19)
"""Of the readings, below the threshold that is tried."""
_HOLE = 1.5
"""Usual gaps from which one is a hole."""
_ENOUGH, _PLACES = 2_000, 200
"""Readings, and values, from which it is told how many are expected about each value."""
_EDGES = np.linspace(0.015, 0.985, 64)
"""Of the readings, below the edges of the stretch that two ranges are to share."""
_FINE = 12
"""Places within two such steps of an edge that is found."""
_LONG = 30_000
"""Readings that are searched for an overlap; of a longer record, the first so many."""
_WIDEST = 2.0
"""Deviations of the innovation that an overlap may be wide."""
_WORTH = 6.0
"""Nats that closing a hole must add: a dead band and a lattice leave holes too, and closing those moves readings away
from where they were expected."""


def check_range_switching(fit: Fit) -> Evidence:
    """Regress the residuals, and their squares, on being in the wider range, for thresholds all over the readings.

    The reading before says which range, so both are sums whose terms the past decides; together chi-square of two
    degrees. Of a few squares the sum is not normal yet, and far out not at all: its score is that of its own law.
    """
    data, used = fit.data, fit.data.used
    magnitude = np.abs(data.y + data.origin_V / data.unit_V)[used]
    squares = np.where(used, fit.z**2, 0.0)
    degrees = 2 / max(float(np.var(squares[used])), 2.0)  # of a square; fewer where they spread more than normal ones
    best, trials = (0.0, 0.0, 0.0, 0.0), 0
    for threshold in np.unique(np.quantile(magnitude, _PARTS)):
        wide = in_wide_range(data, float(threshold), 0.0)
        shape = fit.whitened(wide)
        louder = np.where(used, wide - wide[used].mean(), 0.0)
        size, loud = float(shape @ shape), float(louder @ louder)
        if size <= 0 or loud <= 0:
            continue
        trials += 1
        power = float(shape @ fit.z) ** 2 / size + _score_of_share(squares[used], wide[used], degrees) ** 2
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


def _score_of_share(squares: Floats, wide: Floats, degrees: float) -> float:
    """Return, in deviations, by how much some squares make up more, or less, of all than they are readings.

    The share that m of n chi-square variables have in their sum has the beta law of m/2 and (n - m)/2.
    """
    a, b = 0.5 * degrees * float(wide.sum()), 0.5 * degrees * float((1 - wide).sum())
    share = float(wide @ squares) / max(float(squares.sum()), 1e-300)
    tail = min(float(betainc(a, b, share)), float(betainc(b, a, 1 - share)))
    return -float(ndtri(min(max(tail, 1e-300), 0.5)))


def check_hole(fit: Fit) -> Evidence:
    """Look for the hole among the readings that they should have fallen into.

    Given the past, a reading falls into a stated interval with the probability that the filter gives it; that none did
    has the product of what is left, and the hole is one of as many as there are readings.
    """
    data, used = fit.data, fit.data.used
    if any(isinstance(term, RangeOffset) for term in fit.terms):  # one is closed, and a second is not looked for
        return _hole(1.0, 0.0, data.n, ())
    inner = np.sort(fit.y[used])[data.n // 20 : -(data.n // 20)]
    missing = np.diff(inner) * _expected_about(fit, 0.5 * (inner[1:] + inner[:-1]))
    at = int(np.argmax(missing))
    gaps = np.diff(inner)
    usual = float(np.median(gaps[gaps > 0])) if gaps.any() else 0.0
    # One of many, a lattice: where the filter expects more about one of its gaps, that is as wide as the others still.
    if missing[at] < 2 * np.partition(missing, -2)[-2] or gaps[at] < _HOLE * usual:
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


def _expected_about(fit: Fit, values: Floats) -> Floats:
    """Return how many readings a unit the filter expects about each value, from enough of them for that.

    Where a record has dwelt for long, a small gap is more surprising than a large one where it has hardly been.
    """
    some = np.flatnonzero(fit.data.used)
    some = some[:: max(some.size // _ENOUGH, 1)]
    sd = np.sqrt(fit.variance[some])
    grid = np.linspace(values[0], values[-1], _PLACES)
    each = np.exp(-0.5 * ((grid[:, None] - fit.predicted[some]) / sd) ** 2) / sd
    return np.asarray(np.interp(values, grid, each.sum(axis=1) * fit.data.n / (some.size * sqrt(2 * pi))))


def check_overlap(fit: Fit) -> Evidence:
    """Look for a stretch of values that readings of two ranges share, as it has twice as many, and both were moved.

    Moved apart by half the stretch at each of its edges, readings are those of the base again. What the filter leaves
    of a step at one value is known once for each value, and makes the likelihood of all pairs of edges by sums. The
    likelihood ratio of the best pair, by the exact filter, exceeds x with a probability of at most the number of pairs
    over x, since under the base each has a mean of one or less (Ville 1939).
    """
    data = fit.data
    nothing = _overlap(1.0, 0.0, 1.0, ())
    if data.low is not None or not isinstance(fit.terms[0], Base) or fit.y is not data.y:
        return nothing
    if any(isinstance(term, RangeOffset | RangeOverlap) for term in fit.terms):
        return nothing
    edges = np.unique(np.quantile(data.y[data.used], _EDGES))
    if edges.size < _EDGES.size:  # a lattice
        return nothing
    low, high, worth = _best_pair(fit, edges)
    trials = edges.size**2 / 2 * (_FINE / 4) ** 2
    if worth <= 0:
        return nothing
    step = 2 * float(np.diff(edges)[np.searchsorted(edges[:-1], [low, high]).clip(0, edges.size - 2)].max())
    near = np.unique([edge + step * shift for edge in (low, high) for shift in np.linspace(-1, 1, _FINE)])
    finer = _best_pair(fit, near)
    low, high = finer[:2] if finer[2] > worth else (low, high)
    cost = log(trials)
    term = RangeOverlap(low, high, (low + high) / 2 * data.unit_V + data.origin_V > 0, _usual_variance(fit), cost)
    theta = fit.theta.copy()
    theta[5] += float(term.apart(data.y)[data.used].mean())
    gained = float(densities([*fit.terms, term], theta, data).sum()) - fit.log_likelihood
    p_value = min(1.0, trials * exp(-min(max(gained, 0.0), 650.0)))
    return _overlap(p_value, gained, trials, (term,) if p_value < 0.01 else ())


def _best_pair(fit: Fit, edges: Floats) -> tuple[float, float, float]:
    """Return the two edges that explain most, the lower first, and the nats."""
    some = min(fit.data.y.size, _LONG)
    data, z = fit.data.first(some), np.where(fit.data.used, fit.z, 0.0)[:some]
    scale = np.where(data.used, 1 / np.sqrt(fit.variance[:some]), 0.0)

    def left(shape: Floats) -> Floats:
        return scale * whiten(shape, data.step_s, fit.states, fit.gains[:some], data.used)

    level = left(np.ones(some))
    level /= np.sqrt(max(float(level @ level), 1e-300))
    steps = np.array([left((data.y >= edge).astype(np.float64)) for edge in edges])
    steps -= np.outer(steps @ level, level)
    below = np.searchsorted(np.sort(data.y[data.used]), edges)
    shared = below[None, :] - below[:, None]
    apart = edges[None, :] - edges[:, None]
    along, together = steps @ z, steps @ steps.T
    square = np.diag(together)
    variance = _usual_variance(fit)
    nats = shared * (log(2) - apart**2 / (8 * variance)) - 0.5 * apart * (along[:, None] + along[None, :])
    nats -= 0.125 * apart**2 * (square[:, None] + square[None, :] + 2 * together)
    nats[(apart <= 0) | (apart > _WIDEST * sqrt(variance))] = -np.inf
    low, high = np.unravel_index(int(np.argmax(nats)), nats.shape)
    return float(edges[low]), float(edges[high]), float(nats[low, high])


def _usual_variance(fit: Fit) -> float:
    return float(np.median(fit.variance[fit.data.used]))


def _overlap(p_value: float, gained: float, trials: float, terms: tuple[RangeOverlap, ...]) -> Evidence:
    return Evidence(
        check="readings that two ranges share, moved apart: nats",
        p_value=p_value,
        observed=gained,
        low=-log(max(trials, 1.0)),
        high=log(max(trials, 1.0) / 0.025),
        terms=terms,
    )


def _hole(p_value: float, expected: float, n: int, terms: tuple[RangeOffset, ...]) -> Evidence:
    return Evidence(
        check="readings missing from a hole between two levels: how many were expected there",
        p_value=p_value,
        observed=expected,
        low=0.0,
        high=log(n / 0.025),
        terms=terms,
    )
