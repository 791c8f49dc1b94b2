"""What a converter does to a reading: it bends, sticks, switches ranges, alternates, smooths, clips and rounds."""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Interval, Len
from numpy.random import Generator
from scipy.signal import lfilter

from aemd.model.effect import Readings
from aemd.model.term import Finite, NonNegative, Positive, Volts

__all__ = ["DeadBand", "Nonlinearity", "Quantiser", "RangeSwitching", "ReadingPattern", "Saturation", "Smoothing"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantiser:
    """Rounds to the nearest level offset + k step, half to even k."""

    effect: Literal["quantiser"] = "quantiser"
    step_V: Positive
    """V."""
    offset_V: Finite = 0.0
    """V."""

    def realise(self, rng: Generator) -> "Quantiser":  # noqa: ARG002 - there is nothing to draw
        """Return itself."""
        return self

    def apply(self, readings: Readings) -> Readings:
        """Return the rounded readings."""
        steps = np.rint((readings.value_V - self.offset_V) / self.step_V)
        return replace(readings, value_V=self.offset_V + self.step_V * steps)


@dataclass(frozen=True, slots=True, kw_only=True)
class Saturation:
    """Clips at the ends of a range, silently; a meter that says so gives an overload instead."""

    effect: Literal["saturation"] = "saturation"
    low_V: Finite
    """V."""
    high_V: Finite
    """V."""

    def __post_init__(self) -> None:
        if not self.low_V < self.high_V:
            raise ValueError(f"low_V = {self.low_V}: must be below high_V = {self.high_V}")

    def realise(self, rng: Generator) -> "Saturation":  # noqa: ARG002 - there is nothing to draw
        """Return itself."""
        return self

    def apply(self, readings: Readings) -> Readings:
        """Return the clipped readings."""
        return replace(readings, value_V=np.clip(readings.value_V, self.low_V, self.high_V))


@dataclass(frozen=True, slots=True, kw_only=True)
class Nonlinearity:
    """Bends the scale, y = x + b (x - centre)^2: an even error, which turns vibration into an offset."""

    effect: Literal["nonlinearity"] = "nonlinearity"
    coefficient_per_V: Finite
    """b, 1/V."""
    centre_V: Finite = 0.0
    """Where the scale is straight, V."""

    def realise(self, rng: Generator) -> "Nonlinearity":  # noqa: ARG002 - there is nothing to draw
        """Return itself."""
        return self

    def apply(self, readings: Readings) -> Readings:
        """Return the bent readings."""
        bend = self.coefficient_per_V * (readings.value_V - self.centre_V) ** 2
        return replace(readings, value_V=readings.value_V + bend)


@dataclass(frozen=True, slots=True, kw_only=True)
class DeadBand:
    """Reads the level wherever the value is within half a width of it: crossover distortion, or stiction."""

    effect: Literal["dead_band"] = "dead_band"
    width_V: Positive
    """V."""
    level_V: Finite = 0.0
    """V."""

    def realise(self, rng: Generator) -> "DeadBand":  # noqa: ARG002 - there is nothing to draw
        """Return itself."""
        return self

    def apply(self, readings: Readings) -> Readings:
        """Return the readings, the band's replaced by its level."""
        inside = np.abs(readings.value_V - self.level_V) < self.width_V / 2
        return replace(readings, value_V=np.where(inside, self.level_V, readings.value_V))


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeSwitching:
    """Takes the wider range from a threshold on, and leaves it a hysteresis below: offset and noise change with it."""

    effect: Literal["range_switching"] = "range_switching"
    threshold_V: Positive
    """Magnitude from which the wider range is taken, V."""
    hysteresis_V: NonNegative = 0.0
    """How far below the threshold it is left again, V."""
    offset_V: Finite = 0.0
    """Added in the wider range, V."""
    sd_V: NonNegative = 0.0
    """Standard deviation of the wider range's additional noise, V."""

    def realise(self, rng: Generator) -> "RangeSwitchingRealisation":
        """Return a history that begins in the narrower range."""
        return RangeSwitchingRealisation(self, rng)


class RangeSwitchingRealisation:
    """Remembers the range."""

    def __init__(self, switching: RangeSwitching, rng: Generator) -> None:
        self._switching = switching
        self._rng = rng
        self._wide = False

    def apply(self, readings: Readings) -> Readings:
        """Return the readings, those of the wider range with its offset and noise."""
        wide = self._ranges(np.abs(readings.value_V))
        noise = self._switching.sd_V * self._rng.standard_normal(wide.size)
        return replace(readings, value_V=readings.value_V + np.where(wide, self._switching.offset_V + noise, 0.0))

    def _ranges(self, magnitude_V: Volts) -> Volts:
        """Return which readings are in the wider range: what the last one beyond either threshold decided."""
        up = magnitude_V >= self._switching.threshold_V
        decided = up | (magnitude_V < self._switching.threshold_V - self._switching.hysteresis_V)
        last = np.maximum.accumulate(np.where(decided, np.arange(1, up.size + 1), 0))
        wide = np.concatenate(([self._wide], up))[last]
        self._wide = bool(wide[-1]) if wide.size else self._wide
        return np.asarray(wide)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadingPattern:
    """Adds offsets that repeat with the number of the reading, such as an alternating zero's."""

    effect: Literal["reading_pattern"] = "reading_pattern"
    offsets_V: Annotated[tuple[Finite, ...], Len(2)]
    """Of the readings whose number leaves 0, 1, ... when divided by how many there are, V."""
    first: Annotated[int, Ge(0)] = 0
    """Which of them the reading with the number 0 gets."""

    def realise(self, rng: Generator) -> "ReadingPattern":  # noqa: ARG002 - there is nothing to draw
        """Return itself."""
        return self

    def apply(self, readings: Readings) -> Readings:
        """Return the readings with their offsets."""
        turn = (readings.index + self.first) % len(self.offsets_V)
        return replace(readings, value_V=readings.value_V + np.array(self.offsets_V)[turn])


@dataclass(frozen=True, slots=True, kw_only=True)
class Smoothing:
    """Filters as a meter's digital filter does, y[k] = kept y[k-1] + (1 - kept) x[k]; settled on the first reading."""

    effect: Literal["smoothing"] = "smoothing"
    kept: Annotated[float, Interval(gt=0, lt=1)]
    """Share of the last output in the next one; its time constant is -interval/ln(kept)."""

    def realise(self, rng: Generator) -> "SmoothingRealisation":  # noqa: ARG002 - there is nothing to draw
        """Return a history that has not begun."""
        return SmoothingRealisation(self)


class SmoothingRealisation:
    """Remembers the last output."""

    def __init__(self, smoothing: Smoothing) -> None:
        self._kept = smoothing.kept
        self._last_V: float | None = None

    def apply(self, readings: Readings) -> Readings:
        """Return the filter's output."""
        if not readings.value_V.size:
            return readings
        last_V = float(readings.value_V[0]) if self._last_V is None else self._last_V
        smoothed, _ = lfilter([1 - self._kept], [1, -self._kept], readings.value_V, zi=[self._kept * last_V])
        self._last_V = float(smoothed[-1])
        return replace(readings, value_V=smoothed)
