"""Fits beside the most likely one, each with its weight, where one parabola does not tell what numbers may be.

Three things bend a likelihood. A slow term (a step, a warm-up, a temperature's share) is uncertain by what the drift
may have done meanwhile, and a record of a few turns of the drift says little of it: the most likely one is often too
small or too short, of which little is left at low frequencies. The width of a narrow band is known to a factor at best,
and what else is told of it goes with its width. And an instant or a lag is one of many, none of them much more likely
than its neighbours. So each of these is integrated out: what is given beside it is a normal law, and the interval is
that of the laws' mixture.
"""

from collections.abc import Sequence
from math import log, sqrt

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.drifts import LONG, drifts, is_slow
from aemd.diagnose.fit import Fit
from aemd.diagnose.mixture import Weighed
from aemd.diagnose.settled import UNLIKELY, Tried, information_at, log_volume, settled, weighted
from aemd.diagnose.terms.shapes import Step
from aemd.diagnose.terms.witnessed import Latency, delayed

__all__ = ["beside"]

Floats = NDArray[np.float64]

_CROOKED = ("resonance",)
"""Terms whose first free number is the logarithm of a width: the likelihood is no parabola along it."""
_STRIDE = 0.7
"""Deviations from one value of a crooked number to the next."""
_MOST_STRIDES = 9
_FLAT = 0.3
"""Nats of a stride from which on strides are longer."""
_NEAR = 12
"""Readings about a step's instant at which it may have been."""
_NEGLIGIBLE = 1e-3
"""Weight of an instant or a lag over that of the best, below which it is left out."""
_MOST_LAGS = 1_000


def beside(fit: Fit, number: int) -> Weighed | None:
    """Return the mixture of a term's free numbers, the one that bends its likelihood integrated out; None of others."""
    term = fit.terms[number]
    begin = sum(one.start.size for one in fit.terms[:number])
    own = slice(begin, begin + term.start.size)
    if is_slow(fit, number):
        tries = drifts(fit)
    elif term.cause in _CROOKED and fit.data.n <= LONG:
        tries = _along(fit, number, begin)
    else:
        return None
    tries, weights = weighted(tries)
    if not tries:
        return None
    mixed = Weighed(
        weights,
        np.array([one.theta[own] for one in tries]),
        np.array([one.within[own, own] for one in tries]),
    )
    if isinstance(term, Step):
        return _crossed(mixed, *_instants(fit, number, term))
    if isinstance(term, Latency):
        return _crossed(mixed, *_lags(fit, number, term))
    return mixed


def _along(fit: Fit, number: int, at: int) -> list[Tried]:
    """Return fits with the term's first number, free number `at` of all, held here and there on both sides.

    A value stands for half the way to each of its neighbours, and for all of it alike.
    """
    low, high = fit.terms[number].bounds[0]
    full = information_at(fit.terms, fit.theta, fit.data)[1]
    sd = sqrt(float(full[at, at])) or 1.0  # at a bound nothing is known of it yet
    places: list[tuple[float, float, Floats, Floats]] = []

    def settle(value: float, near: Floats) -> tuple[float, Floats]:
        begun = near.copy()
        begun[at] = value
        there = settled(fit.terms, begun, fit.data, held=(at,))
        places.append((value, *there))
        return there[0], there[1]

    best, middle = settle(float(fit.theta[at]), fit.theta)
    for direction in (1.0, -1.0):
        value, near, last, stride = float(fit.theta[at]), middle, best, _STRIDE * min(sd, 1.0)
        for _ in range(_MOST_STRIDES):
            if not low < value + direction * stride < high:
                stride = max(high - value if direction > 0 else value - low, 0.0)
                if stride < 1e-3:
                    break
            value += direction * stride
            now, near = settle(value, near)
            if now < best - UNLIKELY:
                break
            stride *= 1.6 if abs(last - now) < _FLAT else 1.0
            last = now
    places.sort(key=lambda place: place[0])
    values = np.array([place[0] for place in places])
    edges = np.concatenate((values[:1], 0.5 * (values[1:] + values[:-1]), values[-1:]))
    tried = []
    for (_, likely, theta, within), cell in zip(places, np.diff(edges), strict=True):
        own = within.copy()
        own[at, at] = cell**2 / 12
        weight = (
            likely + log(max(float(cell), 1e-12)) + log_volume(within, range(at + 1, at + fit.terms[number].start.size))
        )
        tried.append(Tried(weight, theta, own))
    return tried


def _crossed(mixed: Weighed, weights: Floats, shifts: Floats, within: Floats) -> Weighed:
    """Return a mixture whose laws are each shifted in as many ways, by `shifts`, shape (j, k), with that weight."""
    size, count = shifts.shape[1], weights.size * mixed.weights.size
    return Weighed(
        np.outer(mixed.weights, weights).ravel(),
        (mixed.thetas[:, None, :] + shifts[None, :, :]).reshape(count, size),
        (mixed.within[:, None] + within[None, :]).reshape(count, size, size),
    )


def _instants(fit: Fit, number: int, term: Step) -> tuple[Floats, Floats, Floats]:
    """Return weight, shift of the size and further covariance, of the instants at which a step may have been."""
    times = fit.data.t_s[fit.data.used]
    at = int(np.argmin(np.abs(times - term.time_s)))
    near = times[max(at - _NEAR, 1) : at + _NEAR + 1]

    def shape_of(time_s: float) -> Floats:
        return (fit.data.t_s >= time_s - 1e-9).astype(np.float64)

    gains, sizes = _explained(fit, number, shape_of(term.time_s), [shape_of(float(time)) for time in near])
    return _kept(gains, sizes[:, None] - fit.parts_of(number)[None, :], np.zeros(1))


def _lags(fit: Fit, number: int, term: Latency) -> tuple[Floats, Floats, Floats]:
    """Return weight, shifts of coefficient and lag, and further covariance, of the lags that a witness may be late by.

    A witness that wanders from reading to reading makes a likelihood with a top at every few of them.
    """
    data, theta = fit.data, fit.parts_of(number)
    values = data.witnesses[term.witness]
    low, high = (term.lag_s * (1 + bound) for bound in term.bounds[1])
    low, high = min(low, high), max(low, high)
    step_s = max(data.interval_s / 2, (high - low) / _MOST_LAGS)  # whole readings and halves, where the tops are
    lags = np.arange(np.ceil(low / step_s), np.floor(high / step_s) + 1) * step_s
    now = values if term.known else values.mean()

    def shape_of(lag_s: float) -> Floats:
        return delayed(values, data.t_s, lag_s) - now

    here = shape_of(term.lag_s * (1 + float(theta[1])))
    gains, sizes = _explained(fit, number, here, [shape_of(float(lag)) for lag in lags])
    numbers = lags / term.lag_s - 1
    shifts = np.column_stack((sizes - theta[0], numbers - theta[1]))
    weights, kept, within = _kept(gains, shifts, np.array([0.0, (step_s / term.lag_s) ** 2 / 12]))
    return weights, kept, within


def _kept(gains: Floats, shifts: Floats, variances: Floats) -> tuple[Floats, Floats, Floats]:
    weights = np.exp(gains - gains.max())
    kept = weights > _NEGLIGIBLE
    weights = weights[kept] / weights[kept].sum()
    return weights, shifts[kept], np.tile(np.diag(variances), (weights.size, 1, 1))


def _explained(fit: Fit, number: int, told: Floats, shapes: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Return the nats that each of these shapes explains in the place of what the term has, and its size.

    The level is beside it.
    """
    level = fit.whitened(np.ones(fit.data.y.size))
    level /= max(sqrt(float(level @ level)), 1e-300)
    bare = fit.z + float(fit.parts_of(number)[0]) * fit.whitened(told)  # and not a filter without, which sees a shock
    left = bare - level * float(level @ bare)
    gains, sizes = np.zeros(len(shapes)), np.zeros(len(shapes))
    for at, shape in enumerate(shapes):
        seen = fit.whitened(shape)
        seen = seen - level * float(level @ seen)
        size = max(float(seen @ seen), 1e-300)
        sizes[at] = float(seen @ left) / size
        gains[at] = 0.5 * sizes[at] ** 2 * size
    return gains, sizes
