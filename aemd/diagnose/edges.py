"""Intervals of what a scan found and no fit moves: instants, and levels that are an edge among the readings.

The likelihood has a step wherever such an edge passes a reading, so no derivative tells how well it is known. Each is
weighed at the readings about the best one instead, every place alike beforehand, the other numbers at their best; the
interval holds the middle 95 %. Where an edge lies between two readings nothing tells, so the step before the first
reading behind it is part of the interval, and of that reading the aperture, through which an edge may have passed.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from aemd.diagnose.checks.shapes import settled_response
from aemd.diagnose.climb import densities
from aemd.diagnose.fit import Fit
from aemd.diagnose.terms.events import PeriodicGlitch
from aemd.diagnose.terms.noise import ChangingNoise
from aemd.diagnose.terms.ranges import RangeOffset, RangeOverlap, RangeSwitching
from aemd.diagnose.terms.shapes import Step

__all__ = ["ends_of_places"]

Floats = NDArray[np.float64]
Ends = tuple[float, float]

_TAIL = 0.025
"""Probability beyond each end."""
_DRAWS = 4_000
"""Of two edges, for the stretch between them."""
_SIDE = 24
"""Places that are tried on either side, as far apart as it takes."""
_OUT = 1e-3
"""Of the best one's probability: what is less likely there is looked for no farther."""
_COARSER = 4
_LONGEST_PULSE = 2_000
"""Readings of a pulse whose response is kept."""


def ends_of_places(fit: Fit, number: int) -> Mapping[str, Ends]:
    """Return the 95 % intervals of those parameters of a term that a scan found, by their names; of most terms none."""
    match fit.terms[number]:
        case ChangingNoise() as term:
            return _stretch(fit, number, term)
        case Step() as term:
            return {"time_s": _instant(fit, number, term)}
        case PeriodicGlitch() as term:
            return _pulses(fit, number, term)
        case RangeSwitching() as term:
            return {"level_V": _threshold(fit, number, term)}
        case RangeOffset() as term:
            return {"level_V": _in_the_hole(fit, number, term)}
        case RangeOverlap() as term:
            return _overlap(fit, number, term)
        case _:
            return {}


def _stretch(fit: Fit, number: int, term: ChangingNoise) -> dict[str, Ends]:
    """Return when noise is another one, and for how long.

    A filter forgets within some readings how noisy those before were, so a reading's density is that of a record as
    noisy all along.
    """
    data, step_s = fit.data, fit.data.interval_s
    first, last = (int(np.searchsorted(data.t_s, at_s - 1e-9)) for at_s in (term.begin_s, term.end_s))
    within, without = (
        densities(
            [*fit.terms[:number], replace(term, end_s=end_s, begin_s=0.0), *fit.terms[number + 1 :]], fit.theta, data
        )
        for end_s in (np.inf, 0.0)
    )
    if within.size != data.y.size:  # the filter is run over some of the readings only
        return {"time_s": (term.begin_s - step_s, term.begin_s + step_s)}
    more = np.concatenate(([0.0], np.cumsum(np.where(data.used, within - without, 0.0))))
    places = np.append(data.t_s, data.t_s[-1] + step_s)  # the last: it does not end within the record
    begins, ends = places[: max(last, 1)], places[first + 1 :]
    here = -more[: begins.size], more[first + 1 :]
    rng = np.random.default_rng(0)
    begun_s, ended_s = (_drawn(at, likely, step_s, rng) for at, likely in zip((begins, ends), here, strict=True))
    begun, lasted = (_middle(begins, here[0]), np.quantile(ended_s - begun_s, (_TAIL, 1 - _TAIL)))
    dwell_s = term.end_s - term.begin_s
    return {
        "time_s": (
            max(min(begun[0], term.begin_s) - step_s, 0.0),
            max(begun[1], term.begin_s) + data.aperture_s,
        ),
        "dwell_s": (
            max(min(float(lasted[0]), dwell_s - step_s), 0.0),
            max(float(lasted[1]), dwell_s + step_s),
        ),
    }


def _instant(fit: Fit, number: int, term: Step) -> Ends:
    """Return between what a step's instant lies, by what a step there explains, of any size, and of any level."""
    data, size = fit.data, float(fit.parts_of(number)[0])
    level = fit.whitened(np.ones(data.y.size))
    level /= max(float(np.sqrt(level @ level)), 1e-300)

    def seen(at: int) -> Floats:
        told = fit.whitened((np.arange(data.y.size) >= at).astype(np.float64))
        return np.asarray(told - level * float(level @ told))

    middle = int(np.searchsorted(data.t_s, term.time_s - 1e-9))
    bare = fit.z + size * fit.whitened((np.arange(data.y.size) >= middle).astype(np.float64))
    bare = bare - level * float(level @ bare)
    apart = 1
    while True:
        places = np.unique(np.clip(middle + apart * np.arange(-_SIDE, _SIDE + 1), 1, data.y.size - 1))
        shapes = [seen(int(at)) for at in places]
        explained = np.array([0.5 * float(one @ bare) ** 2 / max(float(one @ one), 1e-300) for one in shapes])
        odds = np.exp(explained - explained.max())
        if max(odds[0], odds[-1]) < _OUT or apart * _SIDE > data.y.size:
            break
        apart *= _COARSER
    each = np.arange(places[0], places[-1] + 1)
    low, high = _middle(data.t_s[each], np.interp(each, places, explained))
    return min(low, term.time_s) - data.interval_s, max(high, term.time_s) + data.aperture_s


def _pulses(fit: Fit, number: int, term: PeriodicGlitch) -> dict[str, Ends]:
    """Return what a pulse's instants, period and length may be: what pulses there explain, on a grid of the three.

    A pulse is short, so that what it explains is the sum of what its readings do. Period and instant are told apart in
    the middle of the record.
    """
    data, interval_s = fit.data, fit.data.interval_s
    n, length = data.y.size, min(_LONGEST_PULSE, data.y.size)
    step = settled_response(fit, length)
    pulse = np.diff(step, prepend=0.0)
    bare = fit.z + float(fit.parts_of(number)[0]) * fit.whitened(term.shape(data))
    told = np.concatenate(([0.0], np.cumsum(fftconvolve(bare, pulse[::-1])[length - 1 :][:n])))
    most = min(int(term.width_s / interval_s) + 4, length - 1)
    energy = np.array([0.0] + [float(np.sum((step - _later(step, m)) ** 2)) for m in range(1, most + 1)])
    count = max(int((data.span_s - term.begin_s) / term.period_s) + 1, 1)
    turns = np.arange(-1, count + 1)
    periods = term.period_s + interval_s / max(count - 1, 1) * np.linspace(-3, 3, 49)
    middles = interval_s * np.linspace(-2, 2, 33)
    widths = np.unique(np.maximum(term.width_s + interval_s * np.linspace(-2, 2, 17), interval_s / 8))
    shape = (periods.size, middles.size, widths.size)
    explained = np.empty(shape)
    for row, period_s in enumerate(periods):
        begin_s = term.begin_s + middles[:, None] + (turns - count / 2) * period_s + count / 2 * term.period_s
        from_at = np.clip(np.ceil(begin_s / interval_s - 1e-9).astype(np.int64), 0, n)
        for column, width_s in enumerate(widths):
            to_at = np.clip(np.ceil((begin_s + width_s) / interval_s - 1e-9).astype(np.int64), 0, n)
            found = np.sum(told[to_at] - told[from_at], axis=1)
            size = np.sum(energy[np.minimum(to_at - from_at, most)], axis=1)
            explained[row, :, column] = 0.5 * found**2 / np.maximum(size, 1e-300)
    explained = np.where(np.isfinite(explained), explained, -np.inf)
    odds = np.exp(explained - explained.max())
    some = np.random.default_rng(0).choice(odds.size, _DRAWS, p=(odds / odds.sum()).ravel())
    at = np.unravel_index(some, shape)
    period_s, width_s = periods[at[0]], widths[at[2]]
    first_s = term.begin_s + middles[at[1]] - count / 2 * (period_s - term.period_s)
    period = _about(period_s, term.period_s, interval_s / (2 * max(count - 1, 1)))
    time_s, whole = _about(first_s, term.begin_s, interval_s), term.period_s * (term.begin_s // term.period_s)
    dwell = _about(width_s, term.width_s, interval_s)
    return {
        "period_s": period,
        "period_readings": (period[0] / interval_s, period[1] / interval_s),
        "time_s": (time_s[0] - whole, time_s[1] - whole + data.aperture_s),
        "dwell_s": (max(dwell[0], 0.0), dwell[1]),
    }


def _threshold(fit: Fit, number: int, term: RangeSwitching) -> Ends:
    """Return between what the threshold between two ranges lies, by the readings' density with another one."""
    data = fit.data
    sizes = np.sort(np.abs(data.y + data.origin_V / data.unit_V)[data.used])
    middle, apart = int(np.searchsorted(sizes, term.threshold)), 1
    while True:
        places = np.unique(np.clip(middle + apart * np.arange(-_SIDE // 2, _SIDE // 2 + 1), 0, sizes.size - 1))
        tried = [replace(term, threshold=float(sizes[at])) for at in places]
        likely = np.array(
            [
                float(densities([*fit.terms[:number], one, *fit.terms[number + 1 :]], fit.theta, data).sum())
                for one in tried
            ]
        )
        odds = np.exp(likely - likely.max())
        if max(odds[0], odds[-1]) < _OUT or apart * _SIDE > sizes.size:
            break
        apart *= _COARSER
    low, high = (int(places[at]) for at in _between(likely))
    low, high = max(low - apart, 0), min(high + apart - 1, sizes.size - 1)
    return (
        min(float(sizes[low]), term.threshold) * data.unit_V,
        max(float(sizes[high]), term.threshold) * data.unit_V,
    )


def _in_the_hole(fit: Fit, number: int, term: RangeOffset) -> Ends:
    """Return where the threshold may be: in the hole that no reading is in, as far as the offset leaves of it."""
    level_V, offset_V = (abs(item.value(fit.parts_of(number))) for item in term.parameters(fit.data))
    free_V = max((term.high - term.low) * fit.data.unit_V - offset_V, 0.0)
    return max(level_V - free_V / 2, 0.0), level_V + free_V


def _overlap(fit: Fit, number: int, term: RangeOverlap) -> dict[str, Ends]:
    """Return level and offset between two ranges whose readings overlap, by the readings' density with other edges.

    Both edges are tried at once, since where one of them lies moves the readings beyond the other, too.
    """
    data = fit.data
    values = np.unique(data.y[data.used])
    moved = float(term.apart(data.y)[data.used].mean())

    def likely(low: float, high: float) -> float:
        tried, theta = replace(term, low=low, high=high), fit.theta.copy()
        theta[5] += float(tried.apart(data.y)[data.used].mean()) - moved  # the level goes with what is moved
        return float(densities([*fit.terms[:number], tried, *fit.terms[number + 1 :]], theta, data).sum())

    middle, apart = np.searchsorted(values, (term.low, term.high)), 1
    turns = np.arange(-_SIDE // 4, _SIDE // 4 + 1)
    while True:
        low, high = (values[np.unique(np.clip(at + apart * turns, 0, values.size - 1))] for at in middle)
        nats = np.array([[likely(one, other) if one < other else -np.inf for other in high] for one in low])
        odds = np.exp(nats - nats.max())
        border = max(odds[0].max(), odds[-1].max(), odds[:, 0].max(), odds[:, -1].max())
        if border < _OUT or apart * _SIDE > values.size:
            break
        apart *= _COARSER
    some = np.random.default_rng(0).choice(odds.size, _DRAWS, p=(odds / odds.sum()).ravel())
    at = np.unravel_index(some, odds.shape)
    rng = np.random.default_rng(1)
    # Anywhere between two of the places: nothing was tried there.
    lows, highs = (
        np.interp(which + rng.uniform(-0.5, 0.5, _DRAWS), np.arange(edges.size), edges)
        for which, edges in zip(at, (low, high), strict=True)
    )
    sign, level = (-1.0, highs) if term.upwards else (1.0, lows)
    drawn = {"level_V": np.abs(level * data.unit_V + data.origin_V), "offset_V": sign * (highs - lows) * data.unit_V}
    return {item.name: _about(drawn[item.name], item.value(np.empty(0)), 0.0) for item in term.parameters(data)}


def _between(log_odds: Floats) -> tuple[int, int]:
    """Return the places between which the middle of the probability lies."""
    share = np.cumsum(np.exp(log_odds - log_odds.max()))
    low, high = np.searchsorted(share / share[-1], (_TAIL, 1 - _TAIL))
    return int(low), min(int(high), log_odds.size - 1)


def _middle(places: Floats, log_odds: Floats) -> Ends:
    low, high = _between(log_odds)
    return float(places[low]), float(places[high])


def _drawn(places: Floats, log_odds: Floats, step_s: float, rng: np.random.Generator) -> Floats:
    """Return draws of an edge, anywhere in the step before the first reading behind it."""
    odds = np.exp(log_odds - log_odds.max())
    return np.asarray(rng.choice(places, _DRAWS, p=odds / odds.sum()) - step_s * rng.random(_DRAWS))


def _about(draws: Floats, value: float, least: float) -> Ends:
    """Return the middle of some draws, at least so far on either side of what is reported."""
    low, high = np.quantile(draws, (_TAIL, 1 - _TAIL))
    return min(float(low), value - least), max(float(high), value + least)


def _later(step: Floats, readings: int) -> Floats:
    return np.concatenate((np.zeros(readings), step[:-readings]))
