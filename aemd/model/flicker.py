"""Flicker noise as a sum of Gauss-Markov processes whose time constants are equally spaced on a logarithmic scale."""

from dataclasses import dataclass
from math import ceil, log, pi
from typing import Literal

import numpy as np
from numpy.random import Generator

from aemd.model.gauss_markov import GaussMarkov
from aemd.model.term import Positive, Role, Times, Volts

__all__ = ["FlickerNoise"]

_PER_E_FOLD = 1.0
"""Processes per factor e in time constant: the density then ripples about 1/f by 0.02 %, with one a decade by 6 %."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlickerNoise:
    """Noise of the one-sided power density amplitude^2 / f between two frequencies.

    A Gauss-Markov process of variance s^2 has the density 4 s^2 tau / (1 + (2 pi f tau)^2); the integral of that over
    d ln(tau) is s^2/f. So each of the processes, d ln(tau) apart, has the variance amplitude^2 d ln(tau). Below the
    lower frequency the density is flat, above the upper it falls with 1/f^2.
    """

    term: Literal["flicker_noise"] = "flicker_noise"
    role: Role = "internal"
    amplitude_V: Positive
    """Root of the one-sided power density at 1 Hz (were 1 Hz in the band), V/sqrt(Hz), times the root of 1 Hz."""
    low_hz: Positive
    """Hz."""
    high_hz: Positive
    """Hz."""

    def __post_init__(self) -> None:
        if not self.low_hz < self.high_hz:
            raise ValueError(f"low_hz = {self.low_hz}: must be below high_hz = {self.high_hz}")

    @property
    def processes(self) -> tuple[GaussMarkov, ...]:
        """The processes that it is the sum of."""
        e_folds = log(self.high_hz / self.low_hz)
        count = ceil(e_folds * _PER_E_FOLD)
        sd_V = self.amplitude_V * (e_folds / count) ** 0.5
        corners_hz = self.low_hz * np.exp((np.arange(count) + 0.5) * e_folds / count)
        return tuple(GaussMarkov.from_sd(sd_V, 1 / (2 * pi * float(corner)), self.role) for corner in corners_hz)

    def realise(self, rng: Generator) -> "FlickerNoiseRealisation":
        """Return a history; each process draws from a stream of its own."""
        return FlickerNoiseRealisation(self, rng)


class FlickerNoiseRealisation:
    """The sum of its processes' histories."""

    def __init__(self, noise: FlickerNoise, rng: Generator) -> None:
        processes = noise.processes
        self._histories = [
            process.realise(own) for process, own in zip(processes, rng.spawn(len(processes)), strict=True)
        ]

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return the mean over each aperture, V, shape (n,)."""
        return np.asarray(sum((history.average(start_s, aperture_s) for history in self._histories), np.zeros(1)))
