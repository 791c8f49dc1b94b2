"""Intervals of the reported parameters: by the delta method from the readings' own scores, or by what bends them.

What one parabola does not tell is a mixture's (weighed.py); what ends at a bound is the likelihood's own law from the
bound inwards; and what is no smooth function of its numbers is drawn.
"""

from collections.abc import Mapping
from dataclasses import replace
from math import exp, inf, log, sqrt

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.drifts import drifts, is_slow
from aemd.diagnose.edges import ends_of_places
from aemd.diagnose.fit import Fit, climb
from aemd.diagnose.hypothesis import Parameter
from aemd.diagnose.instants import rings
from aemd.diagnose.mixture import Weighed, slopes_of
from aemd.diagnose.result import Value
from aemd.diagnose.settled import information_at, likelihood_at, weighted
from aemd.diagnose.weighed import beside

__all__ = ["covariance", "describe"]

Floats = NDArray[np.float64]

_INSIDE = 0.1
"""Step away from a bound that shows what depends on it; free numbers are logarithms or of order 1."""
_SAME = 1e-3
"""Change of what does not, in parts of it or of its interval."""
_FARTHEST = 50.0
"""Natural logarithms, up to which an interval reaches that is not open."""
_TAIL = 0.025
"""Probability beyond each end."""
_SOUGHT = (1.0, 4.0)
"""Nats below the bound's between which the likelihood is looked at to tell its slope and its bend."""
_TRIES = 5
_PROFILED = ("smoothing", "warmup_drift", "thermal_drift", "popcorn_noise")
"""What another process of the base can pass for, by a change of places, and what decays: on their logarithms' scale
the likelihood is no parabola. And that of a level that jumps, whose histories the filter merges, is often flatter than
the readings' scores would have it."""
_CLIMB = 3
"""Steps of what is beside a number that is held."""
_FALLEN = 1.96**2 / 2
"""Nats that a profile has fallen at the ends of a 95 % interval."""
_FARTHER = 2.5
"""Times its parabola's reach that an end is sought, at most. Nor is it nearer than the parabola's: what a few steps of
a climb have not yet regained makes a profile look steeper than it is."""
_DRAWS = 1_000
"""Of what is no smooth function of its numbers."""


def covariance(fit: Fit) -> Floats:
    """Return the covariance of the free numbers about their most likely values, shape (k, k)."""
    slow = any(is_slow(fit, number) for number in range(1, len(fit.terms)))
    tries, weights = weighted(drifts(fit) if slow else [])
    if not tries:
        return information_at(fit.terms, fit.theta, fit.data)[1]
    total = np.zeros((fit.theta.size, fit.theta.size))
    for weight, one in zip(weights, tries, strict=True):
        apart = one.theta - fit.theta
        total += weight * (one.within + np.outer(apart, apart))
    return total


def describe(fit: Fit, number: int, spread: Floats) -> Mapping[str, Value]:
    """Return the reported parameters of one term with 95 % intervals.

    Args:
        fit: at its top.
        number: of the term.
        spread: covariance of all free numbers.
    """
    rung = _rung(fit, number, spread)
    if rung is not None:
        return rung
    begin = sum(term.start.size for term in fit.terms[:number])
    term, theta = fit.terms[number], fit.parts_of(number)
    own = spread[begin : begin + theta.size, begin : begin + theta.size]
    low, high = np.array(term.bounds, np.float64).reshape(-1, 2).T
    ends = np.where(theta >= high, 1.0, np.where(theta <= low, -1.0, 0.0))
    mixed = beside(fit, number) if number else None
    scanned = ends_of_places(fit, number)
    return {
        parameter.name: _within_limits(
            parameter,
            _interval(
                replace(parameter, ends=scanned.get(parameter.name, parameter.ends)), fit, number, own, ends, mixed
            ),
        )
        for parameter in term.parameters(fit.data)
    }


def _rung(fit: Fit, number: int, spread: Floats) -> dict[str, Value] | None:
    """Return what is told of a wave after shocks at unknown instants: the middles of draws, and their ends."""
    drawn = rings(fit, number, spread)
    if drawn is None:
        return None
    told = {}
    for parameter in fit.terms[number].parameters(fit.data):
        low, middle, high = np.quantile(drawn[parameter.name], (_TAIL, 0.5, 1 - _TAIL))
        told[parameter.name] = Value(float(middle), float(low), float(high), parameter.unit)
    return told


def _interval(parameter: Parameter, fit: Fit, number: int, own: Floats, ends: Floats, mixed: Weighed | None) -> Value:
    """Return a parameter with its interval, by the way that its numbers ask for.

    Args:
        parameter: what is reported.
        fit: at its top.
        number: of the term.
        own: covariance of the term's free numbers.
        ends: 1 where a number is at its upper bound, -1 at its lower one, else 0.
        mixed: the law of the term's numbers where it is none of one parabola.
    """
    theta = fit.parts_of(number)
    alone = np.flatnonzero(slopes_of(parameter, theta))
    value = _value(parameter, theta, own)
    if parameter.ends is not None:
        return replace(value, low=parameter.ends[0], high=parameter.ends[1])
    if alone.size == 0:
        return value
    if parameter.drawn:
        return _drawn(parameter, theta, own)
    opened = _opened(parameter, value, theta, ends)
    if alone.size == 1 and ends[alone[0]]:
        at = int(alone[0])
        pair = [parameter.value(_moved(theta, at, by)) for by in _from_the_bound(fit, number, at, -float(ends[at]))]
        return replace(opened, low=min(opened.low, *pair), high=max(opened.high, *pair))
    wider = (1.0, 1.0)
    if alone.size == 1 and parameter.positive and fit.terms[number].cause in _PROFILED:
        wider = _over_the_parabola(fit, number, int(alone[0]))
    if mixed is not None:
        least, most = mixed.ends(parameter, _TAIL, wider)
    elif wider != (1.0, 1.0):
        sd = sqrt(float(own[alone[0], alone[0]]))
        one, other = (parameter.value(_moved(theta, int(alone[0]), 1.96 * sd * by)) for by in (-wider[0], wider[1]))
        least, most = min(one, other), max(one, other)
    else:
        return opened
    return replace(
        opened,
        low=opened.low if opened.low < value.low else min(least, value.value),
        high=opened.high if opened.high > value.high else max(most, value.value),
    )


def _within_limits(parameter: Parameter, value: Value) -> Value:
    least, most = parameter.limits
    return replace(value, low=max(value.low, least), high=min(value.high, most))


def _over_the_parabola(fit: Fit, number: int, at: int) -> tuple[float, float]:
    """Return how many times as far as its parabola's a number's ends are, where the profile has fallen far enough."""
    index = sum(term.start.size for term in fit.terms[:number]) + at
    low, high = fit.terms[number].bounds[at]
    spread = information_at(fit.terms, fit.theta, fit.data)[1]
    parabola = 1.96 * sqrt(float(spread[index, index]))
    if parabola == 0.0:
        return 1.0, 1.0
    along = spread[:, index] / spread[index, index]
    found = []
    for side in (-1.0, 1.0):
        reach = parabola
        for _ in range(2):
            moved = float(np.clip(fit.theta[index] + side * reach, low, high) - fit.theta[index])
            begun = fit.theta + along * moved
            fallen = fit.log_likelihood - climb(fit.terms, begun, fit.data, _CLIMB, held=(index,))[1]
            further = abs(moved) * sqrt(_FALLEN / max(fallen, 1e-3))
            reach = float(np.clip(further, parabola, parabola * _FARTHER))
        found.append(reach / parabola)
    return found[0], found[1]


def _from_the_bound(fit: Fit, number: int, at: int, side: float) -> tuple[float, float]:
    """Return between what a number at its bound may lie from there, by the likelihood as its law.

    From a bound the likelihood falls along a line, a parabola, or between them; both are told by two places. A term
    may say how much room each value leaves to what it does not fit (`room`), and the law is in proportion to that.

    Returns:
        Two steps from the bound; the first is 0 unless the room at the bound is.
    """
    index = sum(term.start.size for term in fit.terms[:number]) + at
    low, high = fit.terms[number].bounds[at]
    farthest, reach = high - low, min(_INSIDE, high - low)
    place = float(fit.theta[index])

    def fallen(by: float) -> float:
        return max(fit.log_likelihood - likelihood_at(fit, index, place + side * by), 0.0)

    for _ in range(_TRIES):
        down = fallen(reach)
        if _SOUGHT[0] < down < _SOUGHT[1] or (reach == farthest and down < _SOUGHT[0]):
            break
        reach = min(reach * float(np.clip(2.0 / max(down, 1e-6), 0.05, 5.0)), farthest)
    down, near = fallen(reach), 0.4 * reach
    bend = max((down / reach - fallen(near) / near) / (reach - near), 0.0)
    slope = max(down / reach - bend * reach, 0.0)
    steps = np.linspace(0.0, min(farthest, 20 * reach), 4_000)
    room = getattr(fit.terms[number], "room", None)
    law = np.exp(-slope * steps - bend * steps**2) * (1.0 if room is None else room(place + side * steps))
    share = np.cumsum(law) / law.sum()
    first = float(steps[np.searchsorted(share, _TAIL)]) if room is not None else 0.0
    return side * first, side * float(steps[np.searchsorted(share, 1 - _TAIL)])


def _moved(theta: Floats, at: int, by: float) -> Floats:
    """Return free numbers, one of them moved."""
    aside = theta.copy()
    aside[at] += by
    return aside


def _opened(parameter: Parameter, value: Value, theta: Floats, ends: Floats) -> Value:
    """Return a parameter, its interval open where a free number that it depends on ended at a bound.

    Beyond the bound nothing was tried, and what lies there may be as likely.
    """
    width = value.high - value.low
    for number in np.flatnonzero(ends):
        change = value.value - parameter.value(_moved(theta, int(number), -ends[number] * _INSIDE))
        if abs(change) < _SAME * min(abs(value.value), width):
            continue
        if change > 0:
            value = replace(value, high=parameter.limits[1])
        elif change < 0:
            value = replace(value, low=max(parameter.limits[0], 0.0 if parameter.positive else -inf))
    return value


def _drawn(parameter: Parameter, theta: Floats, own: Floats) -> Value:
    """Return a parameter that is no smooth function of its numbers, such as the largest of some differences.

    The largest of what is uncertain is too large on average. Its law about the truth is taken for that of draws about
    the estimate, and turned over: where those are too large by so much, the estimate is, too (the basic bootstrap of
    Davison and Hinkley 1997, section 2.4, its draws those of the numbers' normal law).
    """
    here = parameter.value(theta)
    sizes, directions = np.linalg.eigh(own)
    normal = np.random.default_rng(0).standard_normal((_DRAWS, theta.size))
    draws = theta + normal * np.sqrt(np.maximum(sizes, 0.0)) @ directions.T
    low, high = np.quantile([parameter.value(draw) for draw in draws], (_TAIL, 1 - _TAIL))
    ends = (2 * here - float(high), 2 * here - float(low))
    least = 0.0 if parameter.positive else -inf
    return Value(here, max(min(ends[0], here), least), max(ends[1], here), parameter.unit)


def _value(parameter: Parameter, theta: Floats, spread: Floats) -> Value:
    """Return a parameter with its interval by the delta method."""
    here = parameter.value(theta)
    slopes = slopes_of(parameter, theta)
    sd = sqrt(max(float(slopes @ spread @ slopes), 0.0))
    alone = np.flatnonzero(slopes)
    if alone.size == 1:  # the number's own ends, so that a share stays below 1
        reach = min(1.96 * sd / abs(float(slopes[alone[0]])), _FARTHEST)
        at = int(alone[0])
        low, high = sorted((parameter.value(_moved(theta, at, -reach)), parameter.value(_moved(theta, at, reach))))
        if parameter.positive:
            low, high = max(low, 0.0), high if high < here * exp(_FARTHEST - 1) else inf
        return Value(here, low, high, parameter.unit)
    if parameter.positive and here > 0:
        reach = min(1.96 * sd / here, _FARTHEST)
        high = exp(log(here) + reach) if reach < _FARTHEST else inf
        return Value(here, exp(log(here) - reach), high, parameter.unit)
    return Value(here, here - 1.96 * sd, here + 1.96 * sd, parameter.unit)
