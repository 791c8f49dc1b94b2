"""White noise at the input; the longer the aperture, the less of it is left in a reading."""

from dataclasses import dataclass
from math import inf, sqrt
from typing import Literal

import numpy as np
from numpy.random import Generator

from aemd.model.term import NonNegative, Positive, PositiveOrInfinite, Role, Times, Volts

__all__ = ["WhiteNoise"]


@dataclass(frozen=True, slots=True, kw_only=True)
class WhiteNoise:
    """Gaussian noise of constant one-sided density; with a beginning and an end, a burst of it."""

    term: Literal["white_noise"] = "white_noise"
    role: Role = "noise"
    density_V_per_rt_hz: Positive
    """Square root of the one-sided power spectral density, V/sqrt(Hz)."""
    start_s: NonNegative = 0.0
    """s."""
    duration_s: PositiveOrInfinite = inf
    """s."""

    @classmethod
    def from_sd(cls, sd_V: float, aperture_s: float) -> "WhiteNoise":
        """Return the noise whose mean over `aperture_s`, s, has the standard deviation `sd_V`, V."""
        return cls(density_V_per_rt_hz=sd_V * sqrt(2 * aperture_s))

    def sd(self, aperture_s: float) -> float:
        """Return the standard deviation of the mean over an aperture T, density / sqrt(2 T), V."""
        return self.density_V_per_rt_hz / sqrt(2 * aperture_s)

    def realise(self, rng: Generator) -> "WhiteNoiseRealisation":
        """Return a history that draws from `rng`."""
        return WhiteNoiseRealisation(self, rng)


class WhiteNoiseRealisation:
    """Independent from aperture to aperture, since they do not overlap."""

    def __init__(self, noise: WhiteNoise, rng: Generator) -> None:
        self._noise = noise
        self._rng = rng

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return the mean over each aperture, V, shape (n,).

        Where a burst fills a part p of an aperture T, the mean has the variance density^2 p / (2 T).
        """
        means = self._noise.sd(aperture_s) * self._rng.standard_normal(start_s.size)
        if self._noise.start_s > 0 or self._noise.duration_s < inf:
            begin = np.maximum(start_s, self._noise.start_s)
            end = np.minimum(start_s + aperture_s, self._noise.start_s + self._noise.duration_s)
            means *= np.sqrt(np.clip((end - begin) / aperture_s, 0, 1))
        return np.asarray(means)
