"""Fits beside the most likely one with other drifts, each with its weight: what a slow term leaves open."""

from dataclasses import dataclass
from itertools import pairwise
from math import exp, log, sqrt

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.fit import Fit
from aemd.diagnose.hypothesis import Base, Bounds, Data, Fixed, Parts, signal_and_drift
from aemd.diagnose.kernels import MARKOV
from aemd.diagnose.settled import UNLIKELY, Tried, information_at, log_volume, settled

__all__ = ["LONG", "drifts", "is_slow"]

Floats = NDArray[np.float64]

_SLOW = ("step", "warmup_drift", "thermal_drift", "latency")
"""What a drift can pass for, in part."""
LONG = 10_000
"""Readings beyond which the drift, and a width, is known well enough."""
_DRIFT_TAUS = (0.1, 0.4, 2.0)
"""Time constants of the drift that are tried, in spans of the record; what is longer looks the same."""
_LONGEST_STEP, _SHORTEST_STEP = log(2.5), 0.35
"""From one rate of the drift to the next, between which it is what the rate deviates by."""
_MOST_RATES = 12
"""Such steps, up or down: from a drift that is not seen to one that is all there is."""
_UNSEEN = 0.1
"""Of the deviation of an innovation: what the drift goes in the whole record, below which it is none."""
_FAST = 0.02
"""Of the record: the time constant below which a process is no drift that a slow term could be mistaken for."""
_WELL_KNOWN = 0.6
"""Of a step of the grid: a drift whose numbers deviate by less is a law of its own, and not one of the grid."""

_last: list[tuple[Fit, list[Tried]]] = []
"""The fit whose drifts were weighed last: its covariance is asked for first, and then each of its terms."""


def is_slow(fit: Fit, number: int) -> bool:
    """Return whether a term is one that the drift can pass for, where the drift is not known well enough."""
    slow = number > 0 and fit.terms[number].cause in _SLOW
    return slow and fit.data.n <= LONG and isinstance(fit.terms[0], Base)


def drifts(fit: Fit) -> list[Tried]:
    """Return fits with drifts that the readings allow.

    The weight is the likelihood, the terms' numbers integrated out by Laplace's approximation, under a prior that is
    even in the logarithm of the drift's time constant and even in how far it goes within the record, its rate times the
    root of the time constant or of the span, whichever is shorter: one that is even in the logarithm of that would put
    everything at no drift at all. Each fit stands for a cell of a grid. Where the most likely drift is known far better
    than to a cell, it is a law of its own. Where both processes of the base are fast, they share the signal, and the
    drift is a third beside them.
    """
    for known, found in _last[:1]:  # copied at once, so that another thread's fit does not come between
        if known is fit:
            return found
    base, span_s = fit.base, fit.data.span_s
    slow = signal_and_drift(fit.theta)[1]
    low, high = base.box[slow + 1]
    sd = sqrt(float(np.median(fit.variance[fit.data.used])))
    unseen = max(log(_UNSEEN * sd / sqrt(span_s)), low)
    tried: list[Tried] = []
    full = information_at(fit.terms, fit.theta, fit.data)[1]
    if low == high:  # it is stated
        return [Tried(0.0, fit.theta, full)]
    taus = [log(part * span_s) for part in _DRIFT_TAUS]
    spreads = np.sqrt(np.diag(full)[slow : slow + 2])
    begin, step = max(float(fit.theta[slow + 1]), unseen), _LONGEST_STEP
    if fit.theta[slow] < log(_FAST * span_s):
        slow, begin = -1, unseen
    elif (spreads > 0).all():
        step = float(np.clip(spreads[1], _SHORTEST_STEP, _LONGEST_STEP))
        if spreads[1] < _WELL_KNOWN * step and spreads[0] < _WELL_KNOWN:
            weight = fit.log_likelihood + _prior(fit, *fit.theta[slow : slow + 2]) + _volume(full, base, slow)
            tried.append(Tried(weight, fit.theta, full))
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
    tried: list[Tried],
) -> None:
    """Add fits with a drift of this time constant and of rates up and down from `begin`.

    It is in the place of the process that begins at number `slow` of the base, or beside both where that is negative.
    """
    base, best = fit.base, fit.log_likelihood

    def settle(rate: float, near: Floats) -> tuple[float, Floats]:
        if slow < 0:
            value, theta, within = settled([*fit.terms, _Beside(exp(tau), exp(rate))], near, fit.data)
        else:
            begun = near.copy()
            begun[slow : slow + 2] = tau, rate
            value, theta, within = settled(fit.terms, begun, fit.data, held=(slow, slow + 1))
        tried.append(Tried(value + _prior(fit, tau, rate) + log_cell + _volume(within, base, -1), theta, within))
        return value, theta

    here, middle = settle(begin, fit.theta)
    for direction in (1.0, -1.0):
        near, last = middle, here
        for count in range(1, _MOST_RATES + 1):
            rate = begin + direction * count * step
            if not reach[0] <= rate <= reach[1]:
                break
            now, near = settle(rate, near)
            if now < min(last, best - UNLIKELY):
                break
            last = now


@dataclass(frozen=True, slots=True)
class _Beside(Fixed):
    """A drift beside the base, without free numbers."""

    tau_s: float
    rate: float
    cause: str = "drift"
    cost_nats: float = 0.0

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:  # noqa: ARG002 - it has no free numbers
        parts.states.append((MARKOV, self.tau_s, 0.0, self.rate, self.rate * sqrt(self.tau_s / 2), 1.0))


def _prior(fit: Fit, log_tau: float, log_rate: float) -> float:
    return log_rate + 0.5 * min(log_tau, log(fit.data.span_s))


def _volume(within: Floats, base: Base, slow: int) -> float:
    """Return the logarithm of the volume of the terms' numbers, and of the drift's two where these are free."""
    at = [*([slow, slow + 1] if slow >= 0 else []), *range(base.start.size, within.shape[0])]
    return log_volume(within, at) + (log(2 * np.pi) if slow >= 0 else 0.0)
