"""What link, logger and clock do to readings: lose, repeat, hold, delay and stamp them."""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Interval
from numpy.random import Generator

from aemd.model.effect import Episodes, Readings
from aemd.model.term import Finite, Positive

__all__ = ["ClockError", "Latency", "MissingSamples", "ReplayedBlock", "StuckReadings", "TimestampJitter"]

Fraction = Annotated[float, Interval(gt=0, lt=1)]
MeanReadings = Annotated[float, Ge(1)]


@dataclass(frozen=True, slots=True, kw_only=True)
class MissingSamples:
    """Loses readings in runs of geometric length."""

    effect: Literal["missing_samples"] = "missing_samples"
    fraction: Fraction
    """Of the readings, lost in the long run."""
    mean_readings: MeanReadings = 1.0
    """Mean length of a run."""
    counted: bool = True
    """Whether the numbers of the others tell of it; false is a logger that numbers what it got."""

    def realise(self, rng: Generator) -> "MissingSamplesRealisation":
        """Return a history that draws from `rng`."""
        return MissingSamplesRealisation(self, rng)


class MissingSamplesRealisation:
    """Counts what was lost."""

    def __init__(self, missing: MissingSamples, rng: Generator) -> None:
        self._counted = missing.counted
        self._episodes = Episodes(rng, missing.fraction, missing.mean_readings)
        self._lost = 0

    def apply(self, readings: Readings) -> Readings:
        """Return the readings that are left."""
        kept = ~self._episodes.mask(readings.value_V.size)
        index = readings.index
        if not self._counted:
            lost = self._lost + np.cumsum(~kept)
            index = index - lost
            self._lost = int(lost[-1]) if lost.size else self._lost
        return replace(readings, index=index[kept], stamp_s=readings.stamp_s[kept], value_V=readings.value_V[kept])


@dataclass(frozen=True, slots=True, kw_only=True)
class StuckReadings:
    """Repeats the last good reading, in runs of geometric length."""

    effect: Literal["stuck_readings"] = "stuck_readings"
    fraction: Fraction
    """Of the readings, repeated in the long run."""
    mean_readings: MeanReadings
    """Mean length of a run."""

    def realise(self, rng: Generator) -> "StuckReadingsRealisation":
        """Return a history that draws from `rng`; its first reading is good."""
        return StuckReadingsRealisation(self, rng)


class StuckReadingsRealisation:
    """Remembers the last good reading."""

    def __init__(self, stuck: StuckReadings, rng: Generator) -> None:
        self._episodes = Episodes(rng, stuck.fraction, stuck.mean_readings)
        self._held_V: float | None = None

    def apply(self, readings: Readings) -> Readings:
        """Return the readings, the stuck ones with the value of the last good one."""
        values = readings.value_V
        if not values.size:
            return readings
        good = ~self._episodes.mask(values.size)
        held_V = float(values[0]) if self._held_V is None else self._held_V
        last = np.maximum.accumulate(np.where(good, np.arange(1, values.size + 1), 0))
        values = np.concatenate(([held_V], values))[last]
        self._held_V = float(values[-1])
        return replace(readings, value_V=values)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayedBlock:
    """Delivers one block of values a second time, in place of those that directly follow it."""

    effect: Literal["replayed_block"] = "replayed_block"
    first_index: Annotated[int, Ge(0)]
    """Number of the first reading of the original."""
    readings: Annotated[int, Ge(1)]
    """Length of the block."""

    def realise(self, rng: Generator) -> "ReplayedBlockRealisation":  # noqa: ARG002 - there is nothing to draw
        """Return a history that has not seen the block yet."""
        return ReplayedBlockRealisation(self)


class ReplayedBlockRealisation:
    """Keeps the block."""

    def __init__(self, block: ReplayedBlock) -> None:
        self._block = block
        self._original_V = np.zeros(block.readings)

    def apply(self, readings: Readings) -> Readings:
        """Return the readings, those after the block replaced by it."""
        place = readings.index - self._block.first_index
        original = (place >= 0) & (place < self._block.readings)
        self._original_V[place[original]] = readings.value_V[original]
        copy = (place >= self._block.readings) & (place < 2 * self._block.readings)
        values = readings.value_V.copy()
        values[copy] = self._original_V[place[copy] - self._block.readings]
        return replace(readings, value_V=values)


@dataclass(frozen=True, slots=True, kw_only=True)
class TimestampJitter:
    """Stamps with a random error, as a host's are; never before the stamp that went before."""

    effect: Literal["timestamp_jitter"] = "timestamp_jitter"
    sd_s: Positive
    """Standard deviation of the Gaussian error, before that rule, s."""

    def realise(self, rng: Generator) -> "TimestampJitterRealisation":
        """Return a history that draws from `rng`."""
        return TimestampJitterRealisation(self, rng)


class TimestampJitterRealisation:
    """Remembers the last stamp."""

    def __init__(self, jitter: TimestampJitter, rng: Generator) -> None:
        self._jitter = jitter
        self._rng = rng
        self._last_s = -np.inf

    def apply(self, readings: Readings) -> Readings:
        """Return the readings with their new stamps."""
        stamp_s = readings.stamp_s + self._jitter.sd_s * self._rng.standard_normal(readings.stamp_s.size)
        stamp_s = np.maximum.accumulate(np.concatenate(([self._last_s], stamp_s)))
        self._last_s = stamp_s[-1]
        return replace(readings, stamp_s=stamp_s[1:])


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockError:
    """Stamps by a clock that runs fast and drifts: stamp = t + error t + drift t^2 / 2."""

    effect: Literal["clock_error"] = "clock_error"
    error_ppm: Annotated[float, Interval(gt=-1e5, lt=1e5)]
    """How much the clock runs fast at t = 0, parts in a million."""
    drift_ppm_per_day: Finite = 0.0
    """How fast that grows."""

    def realise(self, rng: Generator) -> "ClockError":  # noqa: ARG002 - there is nothing to draw
        """Return itself."""
        return self

    def apply(self, readings: Readings) -> Readings:
        """Return the readings with that clock's stamps."""
        t = readings.stamp_s
        fast_s = 1e-6 * (self.error_ppm * t + self.drift_ppm_per_day / 86_400 * t**2 / 2)
        return replace(readings, stamp_s=t + fast_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Latency:
    """Stamps all readings late by the same time; it shows beside a witness, whose stamps are true."""

    effect: Literal["latency"] = "latency"
    lag_s: Finite
    """s; negative stamps early."""

    def realise(self, rng: Generator) -> "Latency":  # noqa: ARG002 - there is nothing to draw
        """Return itself."""
        return self

    def apply(self, readings: Readings) -> Readings:
        """Return the readings with their late stamps."""
        return replace(readings, stamp_s=readings.stamp_s + self.lag_s)
