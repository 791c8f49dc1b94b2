"""Known shapes in the mean: each is whitened by the filter that made the residuals, then correlated with them."""

from dataclasses import dataclass
from math import log, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve
from scipy.stats import chi2, norm

from aemd.diagnose.checks.gains import LONG, gain_of
from aemd.diagnose.evidence import Evidence, bonferroni, two_sided
from aemd.diagnose.fit import Fit, residuals
from aemd.diagnose.hypothesis import Base
from aemd.diagnose.kernels import whiten
from aemd.diagnose.terms.lines import amplitude_cost
from aemd.diagnose.terms.shapes import ReadingPattern, Step, WarmUp

__all__ = ["check_pattern", "check_step", "check_warm_up", "settled_response", "step_scores"]

Floats = NDArray[np.float64]

_LONGEST_RESPONSE = 20_000
"""Readings of the filter's response to a step that are used; by then it has followed."""
_FREEDOM = 3
"""Degrees of chi-square for twice what a decay gains: its size, and the drift's two numbers, which may have had nothing
else to do than to follow the record's beginning. With a factor of 8 for the time constants tried, of 415 clean records
that had no part in this choice 8, 4, 2, 1 and none are below 0.05, 0.02, 0.01, 0.003 and 0.001, where 21, 8, 4, 1 and
0.4 would be by chance: on the safe side, about twofold."""
_LESS_DRIFT = 1.0
"""By how much the drift's logarithm of its rate is lowered, where it may have grown for a step."""
_LASTING = 10.0
"""Intervals of decay from which shocks may stand for a step."""
_ABOUT = 8
"""Readings about the best place among which a step may have been taken for a shock."""
_WORTH_A_FIT = 8.0
"""Nats of a step's score from which all is fitted again; by chance some thousand readings have as much in one of three
records."""
_PERIODS = (2, 3, 4, 5, 6, 7, 8, 10, 12, 16)


@dataclass(frozen=True, slots=True)
class _Promised:
    """A base and what its residuals say of steps."""

    theta: Floats
    scores: Floats
    size: Floats
    """Deviations of one unit of a step, by its place."""
    nats: float
    """By which base and step are promised to be above the fit."""

    def places(self, fit: Fit) -> set[int]:
        """Return the place of the strongest, and of the reading about it that is off by most."""
        at = int(np.argmax(np.abs(self.scores)))
        begin = max(at - _ABOUT, 2)
        off = fit.innovation[begin : at + _ABOUT + 1] ** 2 / fit.variance[begin : at + _ABOUT + 1]
        return {at, begin + int(np.argmax(off))}

    def size_at(self, at: int) -> float:
        """Return how large a step is there."""
        return float(self.scores[at] / self.size[at])

    def steps(self, fit: Fit, cost: float) -> list[tuple[Step, Floats]]:
        """Return the steps of these places and where fits of them begin."""
        found = [Step(float(fit.data.t_s[at]), self.size_at(at), cost) for at in self.places(fit)]
        return [(step, np.append(self.theta, step.start)) for step in found]


def settled_response(fit: Fit, length: int) -> Floats:
    """Return what the filter leaves, in deviations, of a unit step, once its gains have settled, shape (length,)."""
    used = fit.data.used
    half = used & (np.arange(used.size) > used.size // 4)
    gains = np.median(fit.gains[half], axis=0)
    step_s = np.full(length, fit.data.interval_s)
    left = whiten(np.ones(length), step_s, fit.states, np.tile(gains, (length, 1)), np.ones(length, bool))
    return np.asarray(left / sqrt(float(np.median(fit.variance[half]))))


def step_scores(fit: Fit, counted: NDArray[np.bool_] | None = None) -> tuple[Floats, Floats]:
    """Return the score of a step at each reading, in deviations, and the deviations of one unit of it; shapes (n,).

    Of all residuals, or of those that are `counted`.
    """
    n = fit.data.y.size
    response = settled_response(fit, min(n, _LONGEST_RESPONSE))
    z = fit.z if counted is None else np.where(counted, fit.z, 0.0)
    sums = fftconvolve(z, response[::-1])[response.size - 1 :][:n]
    if counted is None:
        norms = np.cumsum(response**2)[np.minimum(n - 1 - np.arange(n), response.size - 1)]
    else:
        norms = fftconvolve(counted.astype(np.float64), response[::-1] ** 2)[response.size - 1 :][:n]
    size = np.sqrt(np.maximum(norms, 1e-12))
    scores = sums / size
    scores[:2] = scores[n - 2 :] = 0.0  # the first readings have the level to themselves
    return scores, size


def check_step(fit: Fit) -> Evidence:
    """Look for a step at every reading.

    A drift, or slow shocks, that were fitted to it hide much of it from a score. So where residuals show one well, be
    it of a base with less of those, all is fitted again beside it. Of both the better counts, as one of two.
    """
    data = fit.data
    n = data.y.size
    scores, size = step_scores(fit)
    at = int(np.argmax(np.abs(scores)))
    score = float(scores[at])
    p_value = bonferroni(two_sided(score), n)
    cost = amplitude_cost(1, data.n) + log(n)
    places = [(near, float(scores[near] / size[near])) for near in range(max(at - 1, 2), min(at + 2, n - 2))]
    if data.n <= LONG:
        gain, more = _gained(fit, [_Promised(fit.theta, scores, size, score**2 / 2), *_with_less(fit)], cost)
        p_value = min(1.0, 2 * min(p_value, bonferroni(float(chi2.sf(2 * max(gain, 0.0), _FREEDOM)), n)))
        places += more
    terms = [Step(float(data.t_s[place]), strength, cost) for place, strength in places] if p_value < 0.05 else []
    return Evidence(
        check="strongest step in the residuals: score in deviations",
        p_value=p_value,
        observed=abs(score),
        low=float(norm.isf(0.5 * (1 - 0.025 ** (1 / n)))),
        high=float(norm.isf(0.5 * (1 - 0.975 ** (1 / n)))),
        terms=tuple(terms),
    )


def _gained(fit: Fit, tries: list[_Promised], cost: float) -> tuple[float, list[tuple[int, float]]]:
    """Return the nats that a step adds once all is fitted again, and places with sizes; nothing without a sign of one.

    A reading near the place that is off by most may be a shock to the base and the step all the same.
    """
    promising = [one for one in tries if one.nats > _WORTH_A_FIT]
    if not promising:
        return 0.0, []
    gain, theta = gain_of(fit, [start for one in promising for start in one.steps(fit, cost)])
    again = residuals(fit.terms, theta[:-1], fit.data)  # beside a base that has given way its place shows better
    there = _Promised(again.theta, *step_scores(again), 0.0)
    more, _ = gain_of(fit, there.steps(fit, cost))
    return max(gain, more), [(at, there.size_at(at)) for at in there.places(fit)]


def _with_less(fit: Fit) -> list[_Promised]:
    """Return what bases promise in which less imitates a step.

    One whose drift is slower, and where shocks last long, one whose shocks are quick.
    """
    if not isinstance(fit.terms[0], Base):
        return []
    slower = fit.theta.copy()
    slower[3 if slower[2] > slower[0] else 1] -= _LESS_DRIFT
    tries = [slower]
    if fit.base.shocks and fit.theta[8] > log(_LASTING * fit.data.interval_s):
        for theta in (fit.theta, slower):
            quick = theta.copy()
            quick[8] = log(fit.data.interval_s)
            tries.append(quick)
    found = []
    for theta in tries:
        trial = residuals(fit.terms, theta, fit.data)
        scores, size = step_scores(trial)
        nats = trial.log_likelihood - fit.log_likelihood + 0.5 * float(np.abs(scores).max()) ** 2
        found.append(_Promised(theta, scores, size, nats))
    return found


def check_warm_up(fit: Fit) -> Evidence:
    """Look for a decay that began with the record."""
    data = fit.data
    taus = np.geomspace(10 * data.interval_s, data.span_s / 3, 8)
    tries = []
    for tau in taus:
        shape = fit.whitened(np.exp(-data.t_s / tau))
        size = float(np.sqrt(np.sum(shape[2:] ** 2)))  # the first readings have the level to themselves
        tries.append((float(shape[2:] @ fit.z[2:]) / max(size, 1e-12), size, float(tau)))
    score, size, tau = max(tries, key=lambda item: abs(item[0]))
    decay = WarmUp(tau, score / max(size, 1e-12), amplitude_cost(1, data.n) + log(taus.size))
    if data.n > LONG or any(isinstance(term, WarmUp) for term in fit.terms):
        check, observed, low, high = "score in deviations", abs(score), 0.1, float(norm.isf(0.0125 / taus.size))
        p_value = bonferroni(two_sided(score), taus.size)
    else:
        # A drift that was fitted to the decay is too fast, and hides half of it from a score.
        gain, _ = gain_of(fit, [(decay, np.append(fit.theta, decay.start))])
        check, observed, low, high = "nats gained", gain, 0.0, float(chi2.isf(0.05 / taus.size, _FREEDOM)) / 2
        p_value = bonferroni(float(chi2.sf(2 * max(gain, 0.0), _FREEDOM)), taus.size)
    return Evidence(
        check=f"decay from the first reading on: {check}",
        p_value=p_value,
        observed=observed,
        low=low,
        high=high,
        terms=(decay,) if p_value < 0.05 else (),
    )


def check_pattern(fit: Fit) -> Evidence:
    """Fold the residuals over small numbers of readings: sums of squared means are chi-square."""
    data, used = fit.data, fit.data.used
    tries = []
    for period in _PERIODS:
        phase = data.slot[used] % period
        counts = np.bincount(phase, minlength=period)
        if counts.min() < 10:
            continue
        means = np.bincount(phase, fit.z[used], period) / counts
        statistic = float(np.sum(counts * (means - fit.z[used].mean()) ** 2))
        tries.append((float(chi2.sf(statistic, period - 1)), period, statistic))
    if not tries:
        return Evidence("pattern locked to the reading's number, chi-square per degree", 1.0, 1.0, 0.0, 3.0)
    p_value, period, statistic = min(tries)
    corrected = bonferroni(p_value, len(tries))
    observed, high = (value / (period - 1) for value in (statistic, float(chi2.isf(0.025 / len(tries), period - 1))))
    # What comes every other reading comes every fourth as well: the period is the one that is worth its freedom.
    _, period, _ = max(tries, key=lambda one: one[2] / 2 - amplitude_cost(one[1] - 1, data.n))
    terms: tuple[ReadingPattern, ...] = ()
    if corrected < 0.05:
        phase = data.slot % period
        shapes = np.column_stack(
            [fit.whitened((phase == k).astype(np.float64) - (phase == period - 1)) for k in range(period - 1)]
        )
        offsets, *_ = np.linalg.lstsq(shapes, fit.z, rcond=None)
        cost = amplitude_cost(period - 1, data.n) + log(len(_PERIODS))
        terms = (ReadingPattern(period, tuple(float(offset) for offset in offsets), cost),)
    return Evidence(
        check="pattern locked to the reading's number: chi-square per degree",
        p_value=corrected,
        observed=observed,
        low=0.0,
        high=high,
        terms=terms,
    )
