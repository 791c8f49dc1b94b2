"""Pulses that come back at even times: the residuals folded over every period."""

from math import ceil, log, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.signal import fftconvolve
from scipy.stats import norm

from aemd.diagnose.checks.shapes import settled_response
from aemd.diagnose.evidence import Evidence, bonferroni, two_sided
from aemd.diagnose.fit import Fit
from aemd.diagnose.kernels import whiten
from aemd.diagnose.terms.events import PeriodicGlitch
from aemd.diagnose.terms.lines import amplitude_cost

__all__ = ["check_periodic_glitch"]

Floats = NDArray[np.float64]

_WIDTHS = (1, 2, 4)
"""Readings that a pulse lasts."""
_SHORTEST = 20
"""Readings; shorter periods are lines with a few harmonics, or patterns."""
_LONGEST = 600
"""Readings of the longest period."""
_LEAST_PULSES = 3
_LOUDEST = 4.5
"""Deviations that one pulse counts at most: two large readings of another cause are no train of three."""
_WIDEST = 8
"""Readings of the widest pulse that a train is refined to."""
_PLACES = 24
"""Trains of whole readings that are refined."""
_FINER = 100.0
"""Independent looks that refining brings to each place: instants, periods and widths between those of whole readings;
some times as many as p on clean records shows."""
_LONG = 60_000
"""Readings that are folded; of a longer record, the first so many."""
_ACTED_ON = 0.003
"""The engine's family-wise level: of no p above it is the term ever asked for, and its place is costly to refine."""


def check_periodic_glitch(fit: Fit, line_nats: float = 0.0) -> Evidence:
    """Fold what a pulse of each width leaves in the residuals, over every period to a reading per record.

    The response to a pulse is short beside the periods, so what is summed is independent and normal.

    Args:
        fit: what is explained so far.
        line_nats: what the strongest line explains. A train is a comb of lines and explains more than any one of them,
            so of one that explains less than half of it the instants, which are costly, are not sought.
    """
    data = fit.data
    even = np.zeros(int(data.slot[-1]) + 1)
    even[data.slot[data.used]] = fit.z[data.used]
    even = even[:_LONG]
    longest = min(_LONGEST, even.size // _LEAST_PULSES)
    matched, sizes = _matched(even, settled_response(fit, min(even.size, 4 * _LONGEST)))
    places, trials = list[tuple[float, float, float, float]](), 1.0
    for width in _WIDTHS:
        alone = np.clip(matched[width - 1] / sizes[width - 1], -_LOUDEST, _LOUDEST)
        for period in range(_SHORTEST, longest):
            summed, shift, phase, rows = _fold(alone, period)
            score = abs(summed) / sqrt(ceil(even.size / period))
            places.append((score, period + shift / max(rows - 1, 1), float(phase), float(width)))
        trials += _FINER * float(even.size) * max(longest - _SHORTEST, 0)
    places.sort(reverse=True)
    tries = [_finer(matched, sizes, _LOUDEST, *place[1:]) for place in places[:_PLACES]]
    best, *train = max(tries, key=lambda one: abs(one[0]), default=(0.0, 0.0, 0.0, 1.0))
    p_value = bonferroni(two_sided(best), trials)
    terms: tuple[PeriodicGlitch, ...] = ()
    if p_value < _ACTED_ON and best**2 > line_nats:
        cost = amplitude_cost(1, data.n) + log(trials)
        period_s, since_s, width_s = (readings * data.interval_s for readings in train)
        # An instant just before the first reading that a pulse strikes, which rounding must not lose.
        terms = (_refined(fit, period_s, float(data.t_s[0]) + since_s - 0.01 * data.interval_s, width_s, cost),)
    return Evidence(
        check="strongest train of pulses in the folded residuals: score in deviations",
        p_value=p_value,
        observed=abs(best),
        low=float(norm.isf(0.5 * (1 - 0.025 ** (1 / trials)))) - 1,
        high=float(norm.isf(0.0125 / trials)),
        terms=terms,
    )


def _matched(even: Floats, step: Floats) -> tuple[Floats, Floats]:
    """Return what pulses of 1, 2, ... readings have in the residuals, and what they would have at unit height.

    Shapes (_WIDEST, n), the sum over each pulse's response, and (_WIDEST,), its deviation.
    """
    matched, sizes = np.empty((_WIDEST, even.size)), np.empty(_WIDEST)
    for width in range(1, _WIDEST + 1):
        pulse = (step - np.concatenate((np.zeros(width), step[:-width])))[:_SHORTEST]
        matched[width - 1] = fftconvolve(even, pulse[::-1])[pulse.size - 1 :][: even.size]
        sizes[width - 1] = sqrt(float(np.sum(pulse**2)))
    return matched, sizes


@njit(cache=True)
def _finer(
    matched: Floats, sizes: Floats, loudest: float, period: float, phase: float, width: float
) -> tuple[float, float, float, float]:
    """Return the best score near a train, and its period, first instant and width, in readings and parts of them.

    A reading is struck while its instant is within a pulse, so pulses of a width between whole readings strike now one
    more and now one less, which a train of whole readings cannot follow.
    """
    n = matched.shape[1]
    best = (0.0, period, phase, width)
    pulses = max(n / period, 1.0)
    for d_period in range(-8, 9):
        p = period + d_period / 4 / pulses
        for d_phase in range(-9, 10):
            begin = phase + d_phase / 4 - d_period / 8
            for d_width in range(-4, 9):
                w = width + d_width / 4
                if w < 0.5 or w > _WIDEST - 1:
                    continue
                along, size, at = 0.0, 0.0, begin
                while at < n:
                    first, last = int(np.ceil(at)), int(np.ceil(at + w))
                    if first >= 0 and first < n and last > first:
                        scale = sizes[last - first - 1]
                        along += min(max(matched[last - first - 1, first], -loudest * scale), loudest * scale)
                        size += scale * scale
                    at += p
                if size > 0.0 and abs(along) > abs(best[0]) * np.sqrt(size):
                    best = (along / np.sqrt(size), p, begin, w)
    return best


@njit(cache=True)
def _fold(x: Floats, period: int) -> tuple[float, int, int, int]:
    """Return the largest sum over rows, its shift over all of them, its phase, and the number of rows.

    Staelin's fast folding (Proc. IEEE 57, 724, 1969): rows of one period each are added in pairs, pairs of pairs and so
    on, the lower half shifted by half the shift, so that all shifts up to one per row cost as much as a sort.
    """
    rows = 1
    while rows * period < x.size:
        rows *= 2
    table, other = np.zeros((rows, period)), np.zeros((rows, period))
    for k in range(x.size):
        table[k // period, k % period] = x[k]
    size = 2
    while size <= rows:
        half = size // 2
        for begin in range(0, rows, size):
            for shift in range(size):
                turn = ((shift + 1) // 2) % period
                top, bottom = table[begin + shift // 2], table[begin + half + shift // 2]
                out = other[begin + shift]
                for k in range(period - turn):
                    out[k] = top[k] + bottom[k + turn]
                for k in range(period - turn, period):
                    out[k] = top[k] + bottom[k + turn - period]
        table, other = other, table
        size *= 2
    best, at_shift, at_phase = 0.0, 0, 0
    for shift in range(rows):
        for k in range(period):
            if abs(table[shift, k]) > abs(best):
                best, at_shift, at_phase = table[shift, k], shift, k
    return best, at_shift, at_phase, rows


def _refined(fit: Fit, period_s: float, begin_s: float, width_s: float, cost: float) -> PeriodicGlitch:
    """Return the train near this one that explains most; its instants are not fitted again.

    First on the readings that were folded; of a longer record then on twice as many again and again, each time as the
    period alone has to become that much sharper.
    """
    interval = fit.data.interval_s
    count = min(fit.data.y.size, _LONG)
    here = (period_s, begin_s, width_s)
    pulses = float(fit.data.t_s[count - 1]) / period_s
    top, size = _worth(fit, here, cost, count)
    for reach in (1.0, 0.5, 0.25):
        for _ in range(2):
            middle = here
            for d_period in (-1.0, -0.5, 0.0, 0.5, 1.0):
                for d_begin in (-1.0, -0.5, 0.0, 0.5, 1.0):
                    for d_width in (-1.0, 0.0, 1.0):
                        trial = (
                            here[0] + reach * d_period * interval / pulses,
                            here[1] + reach * (d_begin - d_period / 2) * interval,
                            max(here[2] + reach * d_width * interval, 0.5 * interval),
                        )
                        if trial == here:
                            continue
                        value, amplitude = _worth(fit, trial, cost, count)
                        if value > top:
                            here, top, size = trial, value, amplitude
            if here == middle:  # the same places would be tried again
                break
    while count < fit.data.y.size:
        count = min(2 * count, fit.data.y.size)
        pulses = float(fit.data.t_s[count - 1]) / period_s
        trials = [
            (here[0] + slip * interval / pulses, here[1] - slip / 4 * interval, here[2])
            for slip in (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0)
        ]
        worths = [_worth(fit, trial, cost, count) for trial in trials]
        best = max(range(len(trials)), key=lambda at: worths[at][0])
        here, size = trials[best], worths[best][1]
    return PeriodicGlitch(*here, size, cost)


def _worth(fit: Fit, train: tuple[float, float, float], cost: float, count: int) -> tuple[float, float]:
    """Return twice the nats that a train explains of the first readings, and its amplitude."""
    some = fit.data.first(count)
    shape = np.ascontiguousarray(PeriodicGlitch(*train, 1.0, cost).shape(some))
    left = whiten(shape, some.step_s, fit.states, fit.gains, some.used)
    left = np.where(some.used, left / np.sqrt(fit.variance[:count]), 0.0)
    size, along = float(left @ left), float(left @ fit.z[:count])
    return (0.0, 0.0) if size == 0 else (along**2 / size, along / size)
