"""Intervals of the reported parameters, from the readings' own scores.

A slow term (a warm-up, a temperature's share) is uncertain by what the drift may have done meanwhile, and a record of a
few turns of the drift says little of it: the most likely one is often too small or too short, of which little is left
at low frequencies, and intervals that take it as given are too short. So the drift is integrated out wherever such a
term stands beside a fitted base.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp, inf, log, sqrt

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.fit import Fit, climb, densities, readings_scores, residuals
from aemd.diagnose.hypothesis import Base, Bounds, Data, Parameter, Parts, Term
from aemd.diagnose.result import Value

__all__ = ["covariance", "describe"]

Floats = NDArray[np.float64]


_SLOW = ("step", "warmup_drift", "thermal_drift", "latency")
"""What a drift can pass for, in part."""
_CROOKED = ("smoothing",)
"""What another process of the base can pass for, by a change of places: its likelihood is no parabola."""
_LONG = 10_000
"""Readings beyond which the drift is known well enough."""
_DRIFT_TAUS = (0.1, 0.4, 2.0)
"""Time constants of the drift that are tried, in spans of the record; what is longer looks the same."""
_DRIFT_STEP = log(2.0)
"""From one rate of the drift to the next."""
_UNLIKELY = 4.0
"""Nats below the best from which a rate is left out."""
_UNSEEN = 0.1
"""Of the deviation of an innovation: what the drift goes in the whole record, below which it is none."""
_INSIDE = 0.1
"""Step away from a bound that shows what depends on it; free numbers are logarithms or of order 1."""
_SAME = 1e-3
"""Change of what does not, in parts of it or of its interval."""
_FARTHEST = 50.0
"""Natural logarithms, up to which an interval reaches that is not open."""
_MOST_STEPS = 4
_CLIMB = 3
_FALLEN = 1.96**2 / 2
"""Nats that a profile has fallen at the ends of a 95 % interval."""
_FALLEN_ALONE = 1.645**2 / 2
"""Nats that it has fallen at the one end that an interval has within a number's bounds."""
_FARTHER = 2.5
"""Times its parabola's reach that an end is sought, at most. Nor is it nearer than the parabola's: what a few steps of
a climb have not yet regained makes a profile look steeper than it is."""


def covariance(fit: Fit) -> Floats:
    """Return the covariance of the free numbers about their most likely values, shape (k, k)."""
    if not any(_is_slow(fit, number) for number in range(1, len(fit.terms))):
        return _given_the_drift(fit)
    tries = _drifts(fit)
    highest = max(log_weight for log_weight, _, _ in tries)
    weights = np.array([exp(log_weight - highest) for log_weight, _, _ in tries])
    weights /= weights.sum()
    total = np.zeros((fit.theta.size, fit.theta.size))
    for weight, (_, theta, within) in zip(weights, tries, strict=True):
        apart = theta - fit.theta
        total += weight * (within + np.outer(apart, apart))
    return total


def describe(fit: Fit, number: int, spread: Floats) -> Mapping[str, Value]:
    """Return the reported parameters of one term with 95 % intervals, by the delta method or the profile."""
    begin = sum(term.start.size for term in fit.terms[:number])
    term, theta = fit.terms[number], fit.parts_of(number)
    own = spread[begin : begin + theta.size, begin : begin + theta.size]
    low, high = np.array(term.bounds, np.float64).reshape(-1, 2).T
    ends = np.where(theta >= high, 1.0, np.where(theta <= low, -1.0, 0.0))
    told = {parameter.name: _opened(parameter, theta, own, ends) for parameter in term.parameters(fit.data)}
    for parameter in term.parameters(fit.data):
        alone = np.flatnonzero(_slopes(parameter, theta))
        if parameter.ends is not None:
            low_end, high_end = parameter.ends
            told[parameter.name] = replace(told[parameter.name], low=low_end, high=high_end)
        elif alone.size == 1 and ends[alone[0]]:
            at = int(alone[0])
            inner = parameter.value(_moved(theta, at, _inner(fit, number, at, -float(ends[at]))))
            value = told[parameter.name]
            told[parameter.name] = replace(value, low=min(value.low, inner), high=max(value.high, inner))
        least, most = parameter.limits
        value = told[parameter.name]
        told[parameter.name] = replace(value, low=max(value.low, least), high=min(value.high, most))
    if not _is_slow(fit, number) and term.cause not in _CROOKED:
        return told
    given = np.diag(_given_the_drift(fit))[begin : begin + theta.size]
    reaches = [
        _reach(fit, number, at, spread, max(float(own[at, at]) / known, 1.0)) if known > 0 and not ends[at] else None
        for at, known in enumerate(given)
    ]
    for parameter in term.parameters(fit.data):
        alone = np.flatnonzero(_slopes(parameter, theta))
        reach = reaches[int(alone[0])] if alone.size == 1 else None
        if reach is not None:
            pair = sorted(parameter.value(_moved(theta, int(alone[0]), by)) for by in reach)
            told[parameter.name] = replace(told[parameter.name], low=pair[0], high=pair[1])
    return told


def _is_slow(fit: Fit, number: int) -> bool:
    """Return whether a term is one that the drift can pass for, where the drift is not known well enough."""
    slow = number > 0 and fit.terms[number].cause in _SLOW
    return slow and fit.data.n <= _LONG and isinstance(fit.terms[0], Base)


@dataclass(frozen=True, slots=True)
class _Held:
    """A term one of whose free numbers is held where it is."""

    term: Term
    at: int
    value: float

    @property
    def cause(self) -> str:
        return self.term.cause

    @property
    def cost_nats(self) -> float:
        return self.term.cost_nats

    @property
    def start(self) -> Floats:
        return self.term.start

    @property
    def bounds(self) -> Sequence[Bounds]:
        held = (self.value, self.value)
        return [held if at == self.at else bound for at, bound in enumerate(self.term.bounds)]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        self.term.add(theta, data, parts)

    def parameters(self, data: Data) -> Sequence[Parameter]:
        return self.term.parameters(data)


def _reach(fit: Fit, number: int, at: int, spread: Floats, wider: float) -> tuple[float, float]:
    """Return how far down and up a term's number may be: where the profile of the likelihood has fallen far enough.

    Args:
        fit: at its top.
        number: of the term.
        at: of the number within the term.
        spread: covariance of all free numbers.
        wider: variance of the number over that which the most likely drift leaves it.
    """
    index = sum(term.start.size for term in fit.terms[:number]) + at
    low, high = fit.terms[number].bounds[at]
    sd = sqrt(float(spread[index, index]))
    along = spread[:, index] / spread[index, index]
    found = []
    for side in (-1.0, 1.0):
        parabola = reach = 1.96 * sd
        for _ in range(2):
            value = float(np.clip(fit.theta[index] + side * reach, low, high))
            moved = value - float(fit.theta[index])
            terms = [*fit.terms]
            terms[number] = _Held(fit.terms[number], at, value)
            fallen = fit.log_likelihood - climb(terms, fit.theta + along * moved, fit.data, _CLIMB)[1]
            further = abs(moved) * sqrt(_FALLEN * wider / max(fallen, 1e-3))
            reach = float(np.clip(further, parabola, parabola * _FARTHER))
        found.append(side * reach)
    return found[0], found[1]


def _inner(fit: Fit, number: int, at: int, side: float) -> float:
    """Return how far from its bound a number may be: where the profile has fallen far enough for one end alone."""
    index = sum(term.start.size for term in fit.terms[:number]) + at
    low, high = fit.terms[number].bounds[at]
    reach, farthest = _INSIDE, high - low
    for _ in range(_CLIMB):
        value = float(np.clip(fit.theta[index] + side * reach, low, high))
        terms = [*fit.terms]
        terms[number] = _Held(fit.terms[number], at, value)
        near = fit.theta.copy()
        near[index] = value
        fallen = fit.log_likelihood - climb(terms, near, fit.data, _CLIMB)[1]
        # From the bound the fall is between a line and a parabola; the parabola's end is the nearer one to begin with.
        reach = min(reach * float(np.clip(sqrt(_FALLEN_ALONE / max(fallen, 1e-3)), 0.1, 10.0)), farthest)
    return side * reach


def _moved(theta: Floats, at: int, by: float) -> Floats:
    """Return free numbers, one of them moved."""
    aside = theta.copy()
    aside[at] += by
    return aside


def _drifts(fit: Fit) -> list[tuple[float, Floats, Floats]]:
    """Return, for drifts that the readings allow, log weight, free numbers and their covariance.

    The weight is the likelihood, the term's numbers integrated out by Laplace's approximation, under a prior that is
    even in the logarithm of the drift's time constant and even in its rate: one that is even in the logarithm of that
    would put everything at no drift at all.
    """
    base, span_s = fit.base, fit.data.span_s
    slow = 2 if fit.theta[2] >= fit.theta[0] else 0
    low, high = base.box[slow + 1]
    sd = sqrt(float(np.median(fit.variance[fit.data.used])))
    unseen = max(log(_UNSEEN * sd / sqrt(span_s)), low)
    begin = max(float(fit.theta[slow + 1]), unseen)
    tries: list[tuple[float, Floats, Floats]] = []

    def weigh(tau: float, rate: float, near: Floats) -> tuple[float, Floats]:
        pinned = {slow: (tau, tau), slow + 1: (rate, rate)}
        box = tuple(pinned.get(number, bound) for number, bound in enumerate(base.box))
        terms = [Base(base.start, base.shocks, box), *fit.terms[1:]]
        there = residuals(terms, climb(terms, near, fit.data, _CLIMB)[0], fit.data)
        within = _given_the_drift(there)
        own = within[base.start.size :, base.start.size :]
        certain = np.diag(own) <= 0  # on a bound
        _, volume = np.linalg.slogdet(own + np.diag(np.where(certain, 1.0, 1e-9 * np.diag(own))))
        tries.append((there.log_likelihood + rate + 0.5 * float(volume), there.theta, within))
        return there.log_likelihood, there.theta

    top = fit.log_likelihood
    for tau in {float(fit.theta[slow]), *(log(part * span_s) for part in _DRIFT_TAUS)}:
        here, middle = weigh(tau, begin, fit.theta)
        for direction in (1.0, -1.0):
            near, last = middle, here
            for count in range(1, _MOST_STEPS + 1):
                rate = begin + direction * count * _DRIFT_STEP
                if not unseen <= rate <= high:
                    break
                now, near = weigh(tau, rate, near)
                if now < min(last, top - _UNLIKELY):
                    break
                last = now
    return tries


def _given_the_drift(fit: Fit) -> Floats:
    """Return the covariance at a maximum: the inverse of the outer product of scores."""
    low, high = np.array([bound for term in fit.terms for bound in term.bounds], np.float64).reshape(-1, 2).T
    here = densities(fit.terms, fit.theta, fit.data)
    scores = readings_scores(fit.terms, fit.theta, fit.data, here, high)
    free = (fit.theta > low) & (fit.theta < high)  # what lies on a bound is not uncertain by this measure
    information = scores.T @ scores
    covered = np.zeros(information.shape)
    scale = np.asarray(np.sqrt(np.maximum(np.diag(information), 1e-12)))
    kept = np.flatnonzero(free)
    inner = (information / np.outer(scale, scale))[np.ix_(kept, kept)] + 1e-9 * np.eye(kept.size)
    covered[np.ix_(kept, kept)] = np.linalg.pinv(inner)
    return np.asarray(covered / np.outer(scale, scale))


def _opened(parameter: Parameter, theta: Floats, spread: Floats, ends: Floats) -> Value:
    """Return a parameter, its interval open where a free number that it depends on ended at a bound.

    Beyond the bound nothing was tried, and what lies there may be as likely.

    Args:
        parameter: what is reported.
        theta: the term's free numbers.
        spread: their covariance.
        ends: 1 where a number is at its upper bound, -1 at its lower one, else 0.
    """
    value = _value(parameter, theta, spread)
    width = value.high - value.low
    for number in np.flatnonzero(ends):
        inside = theta.copy()
        inside[number] -= ends[number] * _INSIDE
        change = value.value - parameter.value(inside)
        if abs(change) < _SAME * min(abs(value.value), width):
            continue
        if change > 0:
            value = replace(value, high=parameter.limits[1])
        elif change < 0:
            value = replace(value, low=max(parameter.limits[0], 0.0 if parameter.positive else -inf))
    return value


def _slopes(parameter: Parameter, theta: Floats) -> Floats:
    """Return how a parameter changes with each free number."""
    here, slopes = parameter.value(theta), np.empty(theta.size)
    for number in range(theta.size):
        width = 1e-4 * max(abs(theta[number]), 1.0)
        slopes[number] = (parameter.value(_moved(theta, number, width)) - here) / width
    return slopes


def _value(parameter: Parameter, theta: Floats, spread: Floats) -> Value:
    here = parameter.value(theta)
    slopes = _slopes(parameter, theta)
    sd = sqrt(max(float(slopes @ spread @ slopes), 0.0))
    alone = np.flatnonzero(slopes)
    if alone.size == 1:  # the number's own ends, so that a share stays below 1
        reach = min(1.96 * sd / abs(float(slopes[alone[0]])), _FARTHEST)
        aside = theta.copy()
        aside[alone] = theta[alone] - reach
        one = parameter.value(aside)
        aside[alone] = theta[alone] + reach
        low, high = sorted((one, parameter.value(aside)))
        if parameter.positive:
            low, high = max(low, 0.0), high if high < here * exp(_FARTHEST - 1) else inf
        return Value(here, low, high, parameter.unit)
    if parameter.positive and here > 0:
        reach = min(1.96 * sd / here, _FARTHEST)
        high = exp(log(here) + reach) if reach < _FARTHEST else inf
        return Value(here, exp(log(here) - reach), high, parameter.unit)
    return Value(here, here - 1.96 * sd, here + 1.96 * sd, parameter.unit)
