"""Terms without chance, each its own realisation: level, step, warm-up, sine, square burst, periodic pulse."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.random import Generator

from aemd.model.term import Finite, NonNegative, Positive, Role, Times, Volts

__all__ = ["Level", "PeriodicPulse", "Sine", "SquareBurst", "Step", "WarmUp"]


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
class Step:
    """A change of level that stays, as a slipping connector or a self-calibration leaves."""

    term: Literal["step"] = "step"
    role: Role = "internal"
    time_s: NonNegative
    """When, s."""
    step_V: Finite
    """After less before, V."""

    def realise(self, rng: Generator) -> "Step":  # noqa: ARG002 - there is nothing to draw
        """Return itself."""
        return self

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return the step times the part of each aperture that is after it."""
        return np.asarray(self.step_V * np.clip((start_s + aperture_s - self.time_s) / aperture_s, 0, 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class WarmUp:
    """A drift that dies out and one that does not, A exp(-t/tau) + B t: warm-up and ageing."""

    term: Literal["warm_up"] = "warm_up"
    role: Role = "internal"
    amplitude_V: Finite
    """A, V; at t = 0 the reading is so much beyond where it settles."""
    tau_s: Positive
    """s."""
    slope_V_per_s: Finite = 0.0
    """B, V/s."""

    def realise(self, rng: Generator) -> "WarmUp":  # noqa: ARG002 - there is nothing to draw
        """Return itself."""
        return self

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return A exp(-t/tau) (1 - exp(-T/tau)) tau/T + B (t + T/2), the exact mean over an aperture T."""
        faded = -self.tau_s / aperture_s * np.expm1(-aperture_s / self.tau_s)
        exponential = self.amplitude_V * faded * np.exp(-start_s / self.tau_s)
        return np.asarray(exponential + self.slope_V_per_s * (start_s + aperture_s / 2))


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


@dataclass(frozen=True, slots=True, kw_only=True)
class PeriodicPulse:
    """A rectangular pulse at start + m period: what a compressor, or a logger that flushes, couples in."""

    term: Literal["periodic_pulse"] = "periodic_pulse"
    role: Role = "external"
    amplitude_V: Finite
    """V."""
    period_s: Positive
    """s."""
    width_s: Positive
    """s, at most the period."""
    start_s: NonNegative = 0.0
    """Beginning of the first pulse, s."""

    def __post_init__(self) -> None:
        if self.width_s > self.period_s:
            raise ValueError(f"width_s = {self.width_s}: must be at most period_s = {self.period_s}")

    def realise(self, rng: Generator) -> "PeriodicPulse":  # noqa: ARG002 - there is nothing to draw
        """Return itself."""
        return self

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return the amplitude times the part of each aperture that is within pulses."""
        inside_s = self._inside(start_s + aperture_s - self.start_s) - self._inside(start_s - self.start_s)
        return np.asarray(self.amplitude_V * inside_s / aperture_s)

    def _inside(self, elapsed_s: Times) -> Times:
        """Return how much of the time since the first pulse began was within pulses, s."""
        elapsed_s = np.maximum(elapsed_s, 0.0)
        whole = np.floor(elapsed_s / self.period_s)
        return np.asarray(whole * self.width_s + np.minimum(elapsed_s - whole * self.period_s, self.width_s))
