"""Terms without chance: a level, a sine, a burst of a square wave. Each is its own realisation."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.random import Generator

from aemd.model.term import Finite, NonNegative, Positive, Role, Times, Volts

__all__ = ["Level", "Sine", "SquareBurst"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """A constant voltage."""

    term: Literal["level"] = "level"
    role: Role = "signal"
    level_V: Finite
    """V."""

    def realise(self, rng: Generator) -> "Level":  # noqa: ARG002 - there is nothing to draw
        """Return itself."""
        return self

    def average(self, start_s: Times, aperture_s: float) -> Volts:  # noqa: ARG002 - the same for every aperture
        """Return the level, shape (n,)."""
        return np.full(start_s.shape, self.level_V)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sine:
    """A V sin(2 pi f t + phase): a test signal, or the mains as an external disturbance."""

    term: Literal["sine"] = "sine"
    role: Role = "signal"
    amplitude_V: NonNegative
    """Peak, V."""
    frequency_hz: Positive
    """Hz."""
    phase_rad: Finite = 0.0
    """At t = 0, rad."""

    def realise(self, rng: Generator) -> "Sine":  # noqa: ARG002 - there is nothing to draw
        """Return itself."""
        return self

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return A sin(2 pi f (t + T/2) + phase) sin(pi f T) / (pi f T), the exact mean over an aperture T."""
        middle_rad = 2 * np.pi * self.frequency_hz * (start_s + aperture_s / 2) + self.phase_rad
        return np.asarray(self.amplitude_V * np.sinc(self.frequency_hz * aperture_s) * np.sin(middle_rad))


@dataclass(frozen=True, slots=True, kw_only=True)
class SquareBurst:
    """A square wave of duty 50 % that begins with its positive half, lasts a while and is zero before and after."""

    term: Literal["square_burst"] = "square_burst"
    role: Role = "external"
    amplitude_V: Finite
    """Of the first half period; the second is its negative. V."""
    frequency_hz: Positive
    """Hz."""
    start_s: NonNegative
    """s."""
    duration_s: Positive
    """s."""

    def realise(self, rng: Generator) -> "SquareBurst":  # noqa: ARG002 - there is nothing to draw
        """Return itself."""
        return self

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return the exact mean: the difference of the wave's integral, a triangle, at the aperture's two ends."""
        begin = np.clip(start_s - self.start_s, 0, self.duration_s)
        end = np.clip(start_s + aperture_s - self.start_s, 0, self.duration_s)
        return np.asarray((self._integral(end) - self._integral(begin)) / aperture_s)

    def _integral(self, elapsed_s: Times) -> Volts:
        periods = elapsed_s * self.frequency_hz
        fraction = periods - np.floor(periods)  # whole periods integrate to zero
        return np.asarray(self.amplitude_V / self.frequency_hz * np.minimum(fraction, 1 - fraction))
