"""What a range brings with it: an offset and a noise of its own, wherever the reading before lay in it."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, log

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.hypothesis import Bounds, Data, Parameter, Parts

__all__ = ["RangeOffset", "RangeSwitching", "in_wide_range", "ranges_of"]

Floats = NDArray[np.float64]


def in_wide_range(data: Data, threshold: float, hysteresis: float) -> Floats:
    """Return 1 where the reading before was in the wider range, shape (n,).

    The reading before, and not the reading itself: a density may depend on what went before and on nothing else, and a
    meter that ranges by itself decides by it too. Magnitudes count from 0 V; both numbers in units of the readings.
    """
    magnitude = np.where(data.used, np.abs(data.y + data.origin_V / data.unit_V), np.nan)
    return np.concatenate(([0.0], ranges_of(magnitude, threshold, hysteresis)[:-1]))


def ranges_of(magnitude: Floats, threshold: float, hysteresis: float) -> Floats:
    """Return 1 where a magnitude is, or the last one that decided was, in the wider range; NaN decides nothing."""
    up = magnitude >= threshold
    decided = up | (magnitude < threshold - hysteresis)
    last = np.maximum.accumulate(np.where(decided, np.arange(1, up.size + 1), 0))
    return np.concatenate(([False], up))[last].astype(np.float64)


@dataclass(frozen=True, slots=True)
class RangeSwitching:
    """An offset and additional noise in the wider range; free numbers the offset and the logarithm of that noise.

    The threshold is where the check found most, and reported without interval.
    """

    threshold: float
    """Magnitude from which the wider range is taken, in units of the readings."""
    hysteresis: float
    offset: float
    sd: float
    cost_nats: float
    cause: str = "range_switching"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([self.offset, log(self.sd)])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """The offset is free."""
        return [(-1e9, 1e9), (log(1e-6), log(1e6))]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Add the offset to the mean and the noise to the noise."""
        wide = in_wide_range(data, self.threshold, self.hysteresis)
        parts.mean += theta[0] * wide
        parts.noise_var = parts.noise_var + exp(2 * theta[1]) * wide

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the threshold, the offset and the additional noise."""
        unit = data.unit_V
        return [
            Parameter("level_V", "V", lambda _: self.threshold * unit),
            Parameter("offset_V", "V", lambda v: v[0] * unit, positive=False),
            Parameter("sd_V", "V", lambda v: exp(v[1]) * unit),
        ]


@dataclass(frozen=True, slots=True)
class RangeOffset:
    """An offset from a level on that leaves a hole in the readings; free number the part of the hole that it is.

    No reading lies within the hole, so the reading itself says which range it was taken in, and taking the offset off
    is a change of variable of slope 1: the density stays one.
    """

    low: float
    """Readings up to here were taken in the lower range, in units of the readings from the origin."""
    high: float
    """Readings from here on were taken in the upper range."""
    upwards: bool
    """Whether the upper range is the wider one: its readings are farther from 0 V."""
    cost_nats: float
    cause: str = "range_switching"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([0.9])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """From nothing to the hole."""
        return [(0.0, 1.0)]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Move the wider range's readings back."""
        hole = theta[0] * (self.high - self.low)
        parts.mean += hole * (data.y >= self.high) if self.upwards else -hole * (data.y <= self.low)

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the magnitude from which the wider range is taken, and its offset."""
        edge, sign = (self.low, 1.0) if self.upwards else (self.high, -1.0)
        level_V = abs(edge * data.unit_V + data.origin_V)
        width_V = (self.high - self.low) * data.unit_V
        return [
            Parameter("level_V", "V", lambda _: level_V),
            Parameter("offset_V", "V", lambda v: sign * v[0] * width_V, positive=False),
        ]
