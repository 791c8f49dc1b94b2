"""What a stated model says was done to the readings after all noise, taken off again, the last first.

A smoothing, a bent scale, a gain or a pattern has an inverse, and the density of a reading is that of what it was made
from times the inverse's slope. Rounding, clipping and a dead band have none: they leave an interval in which the value
was, and the filter takes the probability of that.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from aemd import model
from aemd.diagnose.hypothesis import Data, Seen
from aemd.diagnose.terms.ranges import ranges_of
from aemd.diagnose.terms.witnessed import lagged

__all__ = ["ABOUT_VALUES", "UNDONE", "undo", "wider_noise"]

Floats = NDArray[np.float64]

_LEAST_SLOPE = 0.05
"""Of a bent scale: what lies beyond was folded back, and cannot be unfolded."""
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
    for effect in reversed(effects):
        here = _without(effect, here, data)
    assert here.low is not None  # noqa: S101 - by construction
    assert here.high is not None  # noqa: S101 - by construction
    y, low, high = ((values - data.origin_V) / data.unit_V for values in (here.y, here.low, here.high))
    # An interval has a probability and no density, so no slope of one.
    slope = np.where(data.used & ~(high > low), here.log_slope, 0.0) + seen.log_slope
    y = np.where(data.used, y, 0.0)
    if not np.any(high[data.used] > low[data.used]):
        return Seen(y, None, None, slope)
    return Seen(y, np.where(data.used, low, 0.0), np.where(data.used, high, 0.0), slope)


def wider_noise(effects: Sequence[object], data: Data) -> Floats:
    """Return the variance that the wider range's noise adds to each reading, V^2, shape (n,)."""
    for number, effect in enumerate(effects):
        if isinstance(effect, model.RangeSwitching):
            seen = undo(Seen(data.y, None, None, 0.0), effects[number + 1 :], data)
            wide = ranges_of(np.abs(seen.y * data.unit_V + data.origin_V), effect.threshold_V, effect.hysteresis_V)
            return np.asarray(wide * effect.sd_V**2)
    return np.zeros(data.y.size)


def _without(effect: object, seen: Seen, data: Data) -> Seen:
    """Take one effect off; values in V."""
    y, low, high = seen.y, seen.low, seen.high
    assert low is not None  # noqa: S101 - by construction
    assert high is not None  # noqa: S101 - by construction
    match effect:
        case model.Quantiser(step_V=step):
            return replace(seen, low=low - step / 2, high=high + step / 2)
        case model.Saturation(low_V=bottom, high_V=top):
            near = _SAME * (top - bottom)
            return replace(
                seen, low=np.where(low <= bottom + near, -np.inf, low), high=np.where(high >= top - near, np.inf, high)
            )
        case model.DeadBand(width_V=width, level_V=level):
            held = (low <= level + _SAME * width) & (high >= level - _SAME * width)
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
            lifted = offset * ranges_of(np.abs(y), threshold, hysteresis)
            return replace(seen, y=y - lifted, low=low - lifted, high=high - lifted)
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
