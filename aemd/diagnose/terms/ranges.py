"""What a range brings with it: an offset and a noise of its own, wherever the reading before lay in it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import exp, log

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.hypothesis import Bounds, Data, Fixed, Parameter, Parts, Seen

__all__ = ["RangeOffset", "RangeOverlap", "RangeSwitching", "in_wide_range", "ranges_of"]

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

    The threshold is where the check found most, and its interval is a scan's.
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
            Parameter("offset_V", "V", lambda v: sign * v[0] * width_V, positive=False, limits=(-width_V, width_V)),
        ]

    def room(self, part: Floats) -> Floats:
        """Return how far the threshold may lie, in holes: as far as the offset leaves of it.

        The threshold is anywhere between the last reading of the lower range and the first of the upper one, less the
        offset. An offset as wide as the hole would leave it no place at all.
        """
        return 1.0 - part


@dataclass(frozen=True, slots=True)
class RangeOverlap(Fixed):
    """An offset towards the other range, so that two readings of the input share a value; without free numbers.

    Between `low` and `high` a reading y was taken in the lower range, or in the upper one and moved down by their
    distance d. Its density is the sum of those of both, never below that of y + d/2 times 2 e^(-d^2/8s), s being the
    variance of the innovation: the mean of two logarithms, neither more curved than 1/s. That bound is taken, so the
    readings have at most a density; it is close where d is small beside what the past leaves open.

    Edges and offset are those the check found, as the likelihood has a step wherever an edge passes a reading.
    """

    low: float
    """From here on readings of both ranges are seen, in units of the readings from the origin."""
    high: float
    """From here on readings of the upper range alone are."""
    upwards: bool
    """Whether the upper range is the wider one: its readings are farther from 0 V."""
    variance: float
    """Of the innovation, in squared units of the readings."""
    cost_nats: float
    cause: str = "range_switching"

    def apart(self, y: Floats) -> Floats:
        """Return how far each reading is moved, shape (n,)."""
        moved = 0.5 * (self.high - self.low) * ((y >= self.low).astype(np.float64) + (y >= self.high))
        return moved if self.upwards else moved - (self.high - self.low)

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:  # noqa: ARG002 - it has no free numbers
        """Move the ranges apart before anything else is undone."""
        after = parts.undo

        def undo(seen: Seen) -> Seen:
            shared = data.used & (seen.y >= self.low) & (seen.y < self.high)
            gained = np.where(shared, log(2) - (self.high - self.low) ** 2 / (8 * self.variance), 0.0)
            parted = replace(seen, y=seen.y + self.apart(seen.y), log_slope=seen.log_slope + gained)
            return parted if after is None else after(parted)

        parts.undo = undo

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the magnitude from which the wider range is taken, and its offset."""
        edge, sign = (self.high, -1.0) if self.upwards else (self.low, 1.0)
        level_V, width_V = abs(edge * data.unit_V + data.origin_V), (self.high - self.low) * data.unit_V
        return [
            Parameter("level_V", "V", lambda _: level_V),
            Parameter("offset_V", "V", lambda _: sign * width_V, positive=False),
        ]
