"""Fits beside the most likely one, each with its weight, where one parabola does not tell what numbers may be.

Three things bend a likelihood. A slow term (a step, a warm-up, a temperature's share) is uncertain by what the drift
may have done meanwhile, and a record of a few turns of the drift says little of it: the most likely one is often too
small or too short, of which little is left at low frequencies. The width of a narrow band is known to a factor at best,
and what else is told of it goes with its width. And an instant or a lag is one of many, none of them much more likely
than its neighbours. So each of these is integrated out: what is given beside it is a normal law, and the interval is
that of the laws' mixture.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import exp, log, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

from aemd.diagnose.climb import densities, readings_scores
from aemd.diagnose.fit import Fit
from aemd.diagnose.hypothesis import Base, Bounds, Data, Parameter, Parts, Term
from aemd.diagnose.kernels import MARKOV
from aemd.diagnose.terms.shapes import Step
from aemd.diagnose.terms.witnessed import Latency, delayed

__all__ = ["Held", "Weighed", "beside", "drifts", "information_at", "is_slow", "likelihood_at", "slopes_of"]

Floats = NDArray[np.float64]

_SLOW = ("step", "warmup_drift", "thermal_drift", "latency")
"""What a drift can pass for, in part."""
_CROOKED = ("resonance",)
"""Terms whose first free number is the logarithm of a width: the likelihood is no parabola along it."""
_LONG = 10_000
"""Readings beyond which the drift, and a width, is known well enough."""
_DRIFT_TAUS = (0.1, 0.4, 2.0)
"""Time constants of the drift that are tried, in spans of the record; what is longer looks the same."""
_LONGEST_STEP, _SHORTEST_STEP = log(2.5), 0.35
"""From one rate of the drift to the next, between which it is what the rate deviates by."""
_MOST_RATES = 12
"""Such steps, up or down: from a drift that is not seen to one that is all there is."""
_UNLIKELY = 4.0
"""Nats below the best from which nothing more is tried."""
_UNSEEN = 0.1
"""Of the deviation of an innovation: what the drift goes in the whole record, below which it is none."""
_FAST = 0.02
"""Of the record: the time constant below which a process is no drift that a slow term could be mistaken for."""
_WELL_KNOWN = 0.6
"""Of a step of the grid: a drift whose numbers deviate by less is a law of its own, and not one of the grid."""
_STRIDE = 0.7
"""Deviations from one value of a crooked number to the next."""
_MOST_STRIDES = 9
_FLAT = 0.3
"""Nats of a stride from which on strides are longer."""
_STEPS = 2
"""Of Newton from one fit to its neighbour."""
_DAMPINGS = (0.01, 0.3)
"""Of such a step, and of a second try at it: two processes that share the signal can change places at no cost."""
_ENOUGH = 0.02
"""Nats that are not worth another one."""
_NEAR = 12
"""Readings about a step's instant at which it may have been."""
_NEGLIGIBLE = 1e-3
"""Weight of an instant or a lag over that of the best, below which it is left out."""
_FARTHEST = 50.0
"""Of a free number, most of which are logarithms, that an end lies from the middle at most."""
_MOST_LAGS = 1_000


@dataclass(frozen=True, slots=True)
class Weighed:
    """A mixture of normal laws of a term's free numbers; shapes (m,), (m, k), (m, k, k)."""

    weights: Floats
    thetas: Floats
    within: Floats

    def ends(self, parameter: Parameter, share: float, wider: tuple[float, float] = (1.0, 1.0)) -> tuple[float, float]:
        """Return between what a parameter lies but for this share of the probability at each end.

        Of one number's, the ends are as many times as far from the middle as `wider` says, below and above.
        """
        slopes = [slopes_of(parameter, theta) for theta in self.thetas]
        alone = {int(at) for slope in slopes for at in np.flatnonzero(slope)}
        values = np.array([parameter.value(theta) for theta in self.thetas])
        sds = np.array([sqrt(max(float(s @ c @ s), 0.0)) for s, c in zip(slopes, self.within, strict=True)])
        if len(alone) == 1:  # the number's own scale, so that a share stays below 1
            at = alone.pop()
            low, high = self._quantiles(self.thetas[:, at], np.sqrt(self.within[:, at, at]), share)
            middle = float(self.weights @ self.thetas[:, at])
            low = middle - min(wider[0] * (middle - low), _FARTHEST)
            high = middle + min(wider[1] * (high - middle), _FARTHEST)
            below, above = self.thetas[0].copy(), self.thetas[0].copy()
            below[at], above[at] = low, high
            first, second = sorted((parameter.value(below), parameter.value(above)))
            return first, second
        if parameter.positive and (values > 0).all():
            low, high = np.exp(self._quantiles(np.log(values), sds / values, share))
            return float(low), float(high)
        return self._quantiles(values, sds, share)

    def _quantiles(self, centres: Floats, sds: Floats, share: float) -> tuple[float, float]:
        sds = np.maximum(sds, 1e-9 * max(float(np.abs(centres).max()), 1e-30))
        least, most = float((centres - 9 * sds).min()), float((centres + 9 * sds).max())

        def above(x: float, part: float) -> float:
            return float(self.weights @ ndtr((x - centres) / sds)) - part

        low, high = (brentq(above, least, most, args=(part,)) for part in (share, 1 - share))
        return float(low), float(high)


@dataclass(frozen=True, slots=True)
class _Tried:
    """A fit with some numbers held: its weight, all its free numbers, and their covariance."""

    log_weight: float
    theta: Floats
    within: Floats


_last: list[tuple[Fit, list[_Tried]]] = []
"""The fit whose drifts were weighed last: its covariance is asked for first, and then each of its terms."""


def is_slow(fit: Fit, number: int) -> bool:
    """Return whether a term is one that the drift can pass for, where the drift is not known well enough."""
    slow = number > 0 and fit.terms[number].cause in _SLOW
    return slow and fit.data.n <= _LONG and isinstance(fit.terms[0], Base)


def beside(fit: Fit, number: int) -> Weighed | None:
    """Return the mixture of a term's free numbers, the one that bends its likelihood integrated out; None of others."""
    term = fit.terms[number]
    begin = sum(one.start.size for one in fit.terms[:number])
    own = slice(begin, begin + term.start.size)
    if is_slow(fit, number):
        tries = drifts(fit)
    elif term.cause in _CROOKED and fit.data.n <= _LONG:
        tries = _along(fit, number, begin)
    else:
        return None
    tries = [one for one in tries if np.isfinite(one.log_weight) and np.isfinite(one.within).all()]
    if not tries:
        return None
    weights = np.exp(np.array([one.log_weight for one in tries]) - max(one.log_weight for one in tries))
    mixed = Weighed(
        weights / weights.sum(),
        np.array([one.theta[own] for one in tries]),
        np.array([one.within[own, own] for one in tries]),
    )
    if isinstance(term, Step):
        return _crossed(mixed, *_instants(fit, number, term))
    if isinstance(term, Latency):
        return _crossed(mixed, *_lags(fit, number, term))
    return mixed


def slopes_of(parameter: Parameter, theta: Floats) -> Floats:
    """Return how a parameter changes with each free number."""
    here, slopes = parameter.value(theta), np.empty(theta.size)
    for number in range(theta.size):
        width = 1e-4 * max(abs(theta[number]), 1.0)
        aside = theta.copy()
        aside[number] += width
        slopes[number] = (parameter.value(aside) - here) / width
    return slopes


# --- the drift -------------------------------------------------------------------------------------------------------


def drifts(fit: Fit) -> list[_Tried]:
    """Return fits with drifts that the readings allow.

    The weight is the likelihood, the terms' numbers integrated out by Laplace's approximation, under a prior that is
    even in the logarithm of the drift's time constant and even in how far it goes within the record, its rate times the
    root of the time constant or of the span, whichever is shorter: one that is even in the logarithm of that would put
    everything at no drift at all. Each fit stands for a cell of a grid. Where the most likely drift is known far better
    than to a cell, it is a law of its own. Where both processes of the base are fast, they share the signal, and the
    drift is a third beside them.
    """
    if _last and _last[0][0] is fit:
        return _last[0][1]
    base, span_s = fit.base, fit.data.span_s
    slow = 2 if fit.theta[2] >= fit.theta[0] else 0
    low, high = base.box[slow + 1]
    sd = sqrt(float(np.median(fit.variance[fit.data.used])))
    unseen = max(log(_UNSEEN * sd / sqrt(span_s)), low)
    tried: list[_Tried] = []
    full = information_at(fit.terms, fit.theta, fit.data)[1]
    if low == high:  # it is stated
        return [_Tried(0.0, fit.theta, full)]
    taus = [log(part * span_s) for part in _DRIFT_TAUS]
    spreads = np.sqrt(np.diag(full)[slow : slow + 2])
    begin, step = max(float(fit.theta[slow + 1]), unseen), _LONGEST_STEP
    if fit.theta[slow] < log(_FAST * span_s):
        slow, begin = -1, unseen
    elif (spreads > 0).all():
        step = float(np.clip(spreads[1], _SHORTEST_STEP, _LONGEST_STEP))
        if spreads[1] < _WELL_KNOWN * step and spreads[0] < _WELL_KNOWN:
            weight = fit.log_likelihood + _prior(fit, *fit.theta[slow : slow + 2]) + _volume(full, base, slow)
            tried.append(_Tried(weight, fit.theta, full))
        elif fit.theta[slow] < taus[0]:
            taus = [float(fit.theta[slow]), *taus]
    edges = [taus[0] - 0.5, *(0.5 * (one + other) for one, other in pairwise(taus)), taus[-1] + 0.5]
    for tau, cell in zip(taus, np.diff(edges), strict=True):
        _rates(fit, slow, tau, begin, step, (unseen, high), log(cell * step), tried)
    _last[:] = [(fit, tried)]
    return tried


def _rates(
    fit: Fit,
    slow: int,
    tau: float,
    begin: float,
    step: float,
    reach: Bounds,
    log_cell: float,
    tried: list[_Tried],
) -> None:
    """Add fits with a drift of this time constant and of rates up and down from `begin`.

    It is in the place of the process that begins at number `slow` of the base, or beside both where that is negative.
    """
    base, best = fit.base, fit.log_likelihood

    def settle(rate: float, near: Floats) -> tuple[float, Floats]:
        if slow < 0:
            terms: list[Term] = [*fit.terms, _Beside(exp(tau), exp(rate))]
        else:
            pinned = {slow: (tau, tau), slow + 1: (rate, rate)}
            box = tuple(pinned.get(number, bound) for number, bound in enumerate(base.box))
            terms = [Base(base.start, base.shocks, box), *fit.terms[1:]]
        value, theta, within = _settled(terms, near, fit.data)
        tried.append(_Tried(value + _prior(fit, tau, rate) + log_cell + _volume(within, base, -1), theta, within))
        return value, theta

    here, middle = settle(begin, fit.theta)
    for direction in (1.0, -1.0):
        near, last = middle, here
        for count in range(1, _MOST_RATES + 1):
            rate = begin + direction * count * step
            if not reach[0] <= rate <= reach[1]:
                break
            now, near = settle(rate, near)
            if now < min(last, best - _UNLIKELY):
                break
            last = now


@dataclass(frozen=True, slots=True)
class _Beside:
    """A drift beside the base, without free numbers."""

    tau_s: float
    rate: float
    cause: str = "drift"
    cost_nats: float = 0.0

    @property
    def start(self) -> Floats:
        return np.empty(0)

    @property
    def bounds(self) -> Sequence[Bounds]:
        return []

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:  # noqa: ARG002 - it has no free numbers
        parts.states.append((MARKOV, self.tau_s, 0.0, self.rate, self.rate * sqrt(self.tau_s / 2), 1.0))

    def parameters(self, data: Data) -> Sequence[Parameter]:  # noqa: ARG002 - it reports nothing
        return []


def _prior(fit: Fit, log_tau: float, log_rate: float) -> float:
    return log_rate + 0.5 * min(log_tau, log(fit.data.span_s))


def _volume(within: Floats, base: Base, slow: int) -> float:
    """Return the logarithm of the volume of the terms' numbers, and of the drift's two where these are free."""
    at = [*([slow, slow + 1] if slow >= 0 else []), *range(base.start.size, within.shape[0])]
    own = within[np.ix_(at, at)]
    certain = np.diag(own) <= 0  # on a bound
    _, volume = np.linalg.slogdet(own + np.diag(np.where(certain, 1.0, 1e-9 * np.diag(own))))
    return 0.5 * float(volume) + (log(2 * np.pi) if slow >= 0 else 0.0)


# --- a crooked number ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Held:
    """A term one of whose free numbers is held where it is."""

    term: Term
    at: int
    value: float

    @property
    def cause(self) -> str:
        """Id of what it stands for."""
        return self.term.cause

    @property
    def cost_nats(self) -> float:
        """The term's."""
        return self.term.cost_nats

    @property
    def start(self) -> Floats:
        """The term's."""
        return self.term.start

    @property
    def bounds(self) -> Sequence[Bounds]:
        """The term's, but for what is held."""
        return [(self.value, self.value) if at == self.at else bound for at, bound in enumerate(self.term.bounds)]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Add the term."""
        self.term.add(theta, data, parts)

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the term's."""
        return self.term.parameters(data)


def _along(fit: Fit, number: int, at: int) -> list[_Tried]:
    """Return fits with the term's first number, free number `at` of all, held here and there on both sides.

    A value stands for half the way to each of its neighbours, and for all of it alike.
    """
    low, high = fit.terms[number].bounds[0]
    full = information_at(fit.terms, fit.theta, fit.data)[1]
    sd = sqrt(float(full[at, at])) or 1.0  # at a bound nothing is known of it yet
    places: list[tuple[float, float, Floats, Floats]] = []

    def settle(value: float, near: Floats) -> tuple[float, Floats]:
        terms = [*fit.terms]
        terms[number] = Held(fit.terms[number], 0, value)
        begun = near.copy()
        begun[at] = value
        there = _settled(terms, begun, fit.data)
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
            if now < best - _UNLIKELY:
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
        weight = likely + log(max(float(cell), 1e-12)) + _volume_of(within, at, fit.terms[number].start.size)
        tried.append(_Tried(weight, theta, own))
    return tried


def _volume_of(within: Floats, at: int, size: int) -> float:
    """Return the logarithm of the volume of a term's numbers but the first."""
    own = within[at + 1 : at + size, at + 1 : at + size]
    if not own.size:
        return 0.0
    certain = np.diag(own) <= 0  # on a bound
    return 0.5 * float(np.linalg.slogdet(own + np.diag(np.where(certain, 1.0, 1e-9 * np.diag(own))))[1])


# --- an instant, a lag -----------------------------------------------------------------------------------------------


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


# --- one fit ---------------------------------------------------------------------------------------------------------


def information_at(terms: Sequence[Term], theta: Floats, data: Data) -> tuple[Floats, Floats]:
    """Return the gradient and the covariance at some free numbers: the inverse of the outer product of scores."""
    low, high = _box(terms)
    scores = readings_scores(terms, theta, data, densities(terms, theta, data), high)
    return scores.sum(axis=0), _inverse(scores, (theta > low) & (theta < high))


def likelihood_at(fit: Fit, index: int, value: float) -> float:
    """Return the likelihood with a free number of some term held elsewhere, near the top."""
    begins = np.cumsum([0, *(term.start.size for term in fit.terms)])
    number = int(np.searchsorted(begins, index, side="right")) - 1
    terms, near = [*fit.terms], fit.theta.copy()
    terms[number] = Held(fit.terms[number], index - int(begins[number]), value)
    near[index] = value
    return _settled(terms, near, fit.data)[0]


def _settled(terms: Sequence[Term], near: Floats, data: Data) -> tuple[float, Floats, Floats]:
    """Return likelihood, free numbers and covariance a step or two of Newton from a neighbour."""
    low, high = _box(terms)
    theta = np.clip(near, low, high)
    here = densities(terms, theta, data)
    value, within = float(here.sum()), np.zeros((theta.size, theta.size))
    for _ in range(_STEPS):
        scores = readings_scores(terms, theta, data, here, high)
        gradient = scores.sum(axis=0)
        inside = (theta > low) & (theta < high)
        within = _inverse(scores, inside)
        free = inside | ((low < high) & _inwards(theta, low, high, gradient))
        gained = 0.0
        for damping in _DAMPINGS:
            step = _inverse(scores, free, damping) @ gradient
            if float(gradient @ step) < _ENOUGH:
                break
            trial = np.clip(theta + np.clip(step, -1.5, 1.5), low, high)
            there = densities(terms, trial, data)
            if float(there.sum()) > value:
                gained, theta, here, value = float(there.sum()) - value, trial, there, float(there.sum())
                break
        if gained < _ENOUGH:
            break
    return value, theta, within


def _inwards(theta: Floats, low: Floats, high: Floats, gradient: Floats) -> NDArray[np.bool_]:
    return np.asarray(((theta <= low) & (gradient > 0)) | ((theta >= high) & (gradient < 0)))


def _box(terms: Sequence[Term]) -> Floats:
    return np.array([bound for term in terms for bound in term.bounds], np.float64).reshape(-1, 2).T


def _inverse(scores: Floats, free: NDArray[np.bool_], damping: float = 1e-9) -> Floats:
    """Return the inverse of the outer product of scores among what is free; what is not is not uncertain by it.

    The damping is a part of each number's own information, as Levenberg and Marquardt have it.
    """
    information = np.einsum("nk,nl->kl", scores, scores)
    covered = np.zeros(information.shape)
    scale = np.sqrt(np.maximum(np.diag(information), 1e-12))
    kept = np.flatnonzero(free)
    inner = (information / np.outer(scale, scale))[np.ix_(kept, kept)] + damping * np.eye(kept.size)
    covered[np.ix_(kept, kept)] = np.linalg.pinv(inner)
    return np.asarray(covered / np.outer(scale, scale))
