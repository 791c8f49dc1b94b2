"""What a stated model says was done to the readings after all noise, taken off again, the last first.

A smoothing, a bent scale, a gain or a pattern has an inverse, and the density of a reading is that of what it was made
from times the inverse's slope. Rounding, clipping and a dead band have none: they leave an interval in which the value
was, and the filter takes the probability of that.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from aemd import model
from aemd.diagnose.hypothesis import Data, Seen
from aemd.diagnose.terms.witnessed import lagged

__all__ = ["ABOUT_VALUES", "UNDONE", "doubtful", "taken_in", "undo", "wider_noise"]

Floats = NDArray[np.float64]

_LEAST_SLOPE = 0.05
"""Of a bent scale: what lies beyond was folded back, and cannot be unfolded."""
_FARTHEST = 3.5
"""Deviations that a noise is not expected beyond."""
_SAME = 1e-6
"""Of a width or a level: as near as a value must be to one to be it."""

UNDONE: TypeAlias = (
    model.Nonlinearity
    | model.SupplyCoupling
    | model.ReadingPattern
    | model.RangeSwitching
    | model.Smoothing
    | model.Saturation
    | model.DeadBand
    | model.Quantiser
)
"""Effects that are taken off, as long as no noise comes after them."""
ABOUT_VALUES = (*UNDONE.__args__, model.DifferenceNoise, model.HeavyTails, model.SignalDependentNoise)
"""Effects that change values; all others change what is known of their time, or lose some."""


def undo(seen: Seen, effects: Sequence[object], data: Data) -> Seen:
    """Return what was there before the effects.

    Args:
        seen: the readings.
        effects: in the order in which they met a reading.
        data: what goes with the readings.
    """
    low = seen.y if seen.low is None else seen.low
    high = seen.y if seen.high is None else seen.high
    y, low, high = (values * data.unit_V + data.origin_V for values in (seen.y, low, high))
    here = Seen(y, low, high, np.zeros(y.size))
    if seen.y is data.y:
        read = here
    else:  # a rival of the model was taken off first, and moved what was clipped away from the range's end
        bounds = (data.y if ends is None else ends for ends in (data.y, data.low, data.high))
        y, low, high = (values * data.unit_V + data.origin_V for values in bounds)
        read = Seen(y, low, high, 0.0)
    for effect in reversed(effects):
        moved = _without(effect, here, read, data)
        read = moved if read is here else _without(effect, read, read, data)
        here = moved
    assert here.low is not None  # noqa: S101 - by construction
    assert here.high is not None  # noqa: S101 - by construction
    y, low, high = ((values - data.origin_V) / data.unit_V for values in (here.y, here.low, here.high))
    # An interval has a probability and no density, so no slope of one.
    # What was bent before is told of a rounded reading by its middle, and of one that was held not at all.
    with np.errstate(invalid="ignore"):  # both ends may be open
        rounded = np.abs((high - y) - (y - low)) <= _SAME * np.abs(high - low)
    rounded &= np.isfinite(high - low)
    slope = np.where(data.used & ~(high > low), here.log_slope, 0.0)
    slope = np.where(rounded | ~(high > low), slope + seen.log_slope, 0.0)
    y = np.where(data.used, y, 0.0)
    if not np.any(high[data.used] > low[data.used]):
        return Seen(y, None, None, slope)
    return Seen(y, np.where(data.used, low, 0.0), np.where(data.used, high, 0.0), slope)


def wider_noise(effects: Sequence[object], data: Data) -> Floats:
    """Return the variance that the wider range's noise adds to each reading, V^2, shape (n,)."""
    for number, effect in enumerate(effects):
        if isinstance(effect, model.RangeSwitching):
            seen = undo(Seen(data.y, None, None, 0.0), effects[number + 1 :], data)
            y = seen.y * data.unit_V + data.origin_V
            wide, _, _ = taken_in(y, data.used, effect.threshold_V, effect.hysteresis_V, effect.offset_V)
            return np.asarray(wide * effect.sd_V**2)
    return np.zeros(data.y.size)


@njit(cache=True, error_model="numpy")
def taken_in(
    y: Floats, used: NDArray[np.bool_], threshold: float, hysteresis: float, offset: float
) -> tuple[Floats, Floats, Floats]:
    """Return 1 where a reading was taken in the wider range, and where it may be either, what it then was before.

    The input x, and not the reading, takes the range: |x| from the threshold on the wider one, a hysteresis below it
    the narrower one again. Readings x of the narrower range and x + offset of the wider one share the values within an
    offset of an edge on one side of zero. Of such a reading nothing is told but that x was within an offset of that
    edge, on whichever side: exactly the event of a shared value, so its probability is a likelihood without a choice
    that would lean to what was predicted.

    Args:
        y: readings, V, shape (n,).
        used: which of them count, shape (n,).
        threshold: magnitude from which the wider range is taken, V.
        hysteresis: how far below it that is left again, V.
        offset: of the wider range, V.

    Returns:
        The ranges, and the lowest and the highest x of the readings that either may be, V; of all others 0 and 0.
    """
    wide, least, most = np.zeros(y.size), np.zeros(y.size), np.zeros(y.size)
    before = 0  # the narrower range, the wider one, or 2 where that is not known
    for k in range(y.size):
        if not used[k]:
            before = before if hysteresis == 0.0 else 2
            continue
        # x stays in the narrower range below `up`, and in the wider one from `down` on.
        up = threshold - hysteresis if before == 1 else threshold
        down = threshold if before == 0 else threshold - hysteresis
        if abs(y[k]) < up and abs(y[k] - offset) >= down:
            side = -1.0 if offset > 0.0 else 1.0
            one, other = y[k], y[k] - offset  # beyond a hysteresis wider than the offset the range before would tell
            if y[k] * side >= 0.0:
                one, other = side * (down - abs(offset)), side * (up + abs(offset))
            least[k], most[k] = min(one, other), max(one, other)
            before = 2
        else:
            wide[k] = 0.0 if abs(y[k]) < up else 1.0
            before = int(wide[k])
    return wide, least, most


def doubtful(effects: Sequence[object], data: Data) -> float:
    """Return the share of the readings whose range is in doubt beside a noise that the wider one adds.

    Without that noise the range is one of two at most; with it a reading of the wider range may be anywhere, and one
    near an edge is the likelier the farther its input was on the one side.
    """
    for number, effect in enumerate(effects):
        if isinstance(effect, model.RangeSwitching) and effect.sd_V > 0:
            seen = undo(Seen(data.y, None, None, 0.0), effects[number + 1 :], data)
            y = seen.y[data.used] * data.unit_V + data.origin_V
            reach, edge = _FARTHEST * effect.sd_V, effect.threshold_V - effect.hysteresis_V
            narrow, before = np.abs(y) < effect.threshold_V, np.abs(y - effect.offset_V)
            return float(np.mean(np.where(narrow, before >= edge - reach, before < edge + reach)))
    return 0.0


def _without(effect: object, seen: Seen, read: Seen, data: Data) -> Seen:
    """Take one effect off; values in V.

    Args:
        effect: what was done last.
        seen: what it left.
        read: the same, but for what was taken off before it that is no part of the model: it tells what was held.
        data: what goes with the readings.
    """
    y, low, high = seen.y, seen.low, seen.high
    assert low is not None  # noqa: S101 - by construction
    assert high is not None  # noqa: S101 - by construction
    assert read.low is not None  # noqa: S101 - by construction
    assert read.high is not None  # noqa: S101 - by construction
    match effect:
        case model.Quantiser(step_V=step):
            return replace(seen, low=low - step / 2, high=high + step / 2)
        case model.Saturation(low_V=bottom, high_V=top):
            near = _SAME * (top - bottom)
            return replace(
                seen,
                low=np.where(read.low <= bottom + near, -np.inf, low),
                high=np.where(read.high >= top - near, np.inf, high),
            )
        case model.DeadBand(width_V=width, level_V=level):
            held = (read.low <= level + _SAME * width) & (read.high >= level - _SAME * width)
            return replace(
                seen,
                low=np.where(held, np.minimum(low, level - width / 2), low),
                high=np.where(held, np.maximum(high, level + width / 2), high),
            )
        case model.Nonlinearity(coefficient_per_V=bend, centre_V=centre):
            slope = np.sqrt(np.maximum(1 + 4 * bend * (y - centre), _LEAST_SLOPE**2))

            def straight(values: Floats) -> Floats:
                root = np.sqrt(np.maximum(1 + 4 * bend * (values - centre), _LEAST_SLOPE**2))
                return np.asarray(centre + (root - 1) / (2 * bend))

            return Seen(straight(y), straight(low), straight(high), seen.log_slope - np.log(slope)) if bend else seen
        case model.SupplyCoupling(witness=witness, coefficient_per_V=coefficient, mean_V=mean):
            if witness not in data.witnesses:
                return seen
            apart = data.witnesses[witness] - mean
            gain = np.maximum(1 + coefficient * apart, _LEAST_SLOPE)
            through = effect.coefficient_V_per_V * lagged(apart, data.step_s, effect.lag_s)
            y, low, high = ((values - through) / gain for values in (y, low, high))
            return Seen(y, low, high, seen.log_slope - np.log(gain))
        case model.ReadingPattern(offsets_V=offsets, first=first):
            offset = np.array(offsets)[(data.slot + first) % len(offsets)]
            return replace(seen, y=y - offset, low=low - offset, high=high - offset)
        case model.RangeSwitching(threshold_V=threshold, hysteresis_V=hysteresis, offset_V=offset):
            wide, least, most = taken_in(read.y, data.used, threshold, hysteresis, offset)
            either, rounding = most > least, high - low
            y, low, high = (values - wide * offset for values in (y, low, high))
            low = np.where(either, least - rounding / 2, low)
            return replace(seen, y=y, low=low, high=np.where(either, most + rounding / 2, high))
        case model.Smoothing(kept=kept):
            direct = data.used.copy()
            direct[0] = False
            direct[1:] &= data.used[:-1] & (np.diff(data.slot) == 1)
            before = np.concatenate(([0.0], y[:-1]))
            y, low, high = (
                np.where(direct, (values - kept * before) / (1 - kept), values) for values in (y, low, high)
            )
            return Seen(y, low, high, seen.log_slope - direct * np.log1p(-kept))
    return seen
