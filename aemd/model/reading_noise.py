"""Noise that belongs to a reading and not to the input: it does not average out over a longer aperture."""

from dataclasses import dataclass, replace
from math import sqrt
from typing import Annotated, Literal

import numpy as np
from annotated_types import Gt
from numpy.random import Generator

from aemd.model.effect import Readings
from aemd.model.term import Positive

__all__ = ["DifferenceNoise", "HeavyTails", "SignalDependentNoise"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DifferenceNoise:
    """Each reading gains w[k] - w[k-1]: noise of a zero, or an edge, that two neighbours share with opposite signs."""

    effect: Literal["difference_noise"] = "difference_noise"
    sd_V: Positive
    """Standard deviation of w, V; of the difference, that times the root of 2."""

    def realise(self, rng: Generator) -> "DifferenceNoiseRealisation":
        """Return a history whose first reading already has a predecessor."""
        return DifferenceNoiseRealisation(self, rng)


class DifferenceNoiseRealisation:
    """Remembers the last w."""

    def __init__(self, noise: DifferenceNoise, rng: Generator) -> None:
        self._noise = noise
        self._rng = rng
        self._last_V = noise.sd_V * rng.standard_normal()

    def apply(self, readings: Readings) -> Readings:
        """Return the readings with the difference added."""
        w = self._noise.sd_V * self._rng.standard_normal(readings.value_V.size)
        difference = np.diff(w, prepend=self._last_V)
        self._last_V = w[-1] if w.size else self._last_V
        return replace(readings, value_V=readings.value_V + difference)


@dataclass(frozen=True, slots=True, kw_only=True)
class HeavyTails:
    """Each reading gains a Student-t number of its own, as interference from switching gives."""

    effect: Literal["heavy_tails"] = "heavy_tails"
    sd_V: Positive
    """Standard deviation of what is added, V."""
    dof: Annotated[float, Gt(2)]
    """Degrees of freedom; above 2, so that there is a standard deviation."""

    def realise(self, rng: Generator) -> "HeavyTailsRealisation":
        """Return a history that draws from `rng`."""
        return HeavyTailsRealisation(self, rng)


class HeavyTailsRealisation:
    """Independent from reading to reading."""

    def __init__(self, tails: HeavyTails, rng: Generator) -> None:
        self._dof = tails.dof
        self._scale_V = tails.sd_V * sqrt((tails.dof - 2) / tails.dof)
        self._rng = rng

    def apply(self, readings: Readings) -> Readings:
        """Return the readings with the noise added."""
        return replace(
            readings, value_V=readings.value_V + self._scale_V * self._rng.standard_t(self._dof, readings.value_V.size)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalDependentNoise:
    """A gain that flickers from reading to reading, y (1 + fraction n): noise in proportion to the reading."""

    effect: Literal["signal_dependent_noise"] = "signal_dependent_noise"
    fraction: Positive
    """Standard deviation of the gain."""

    def realise(self, rng: Generator) -> "SignalDependentNoiseRealisation":
        """Return a history that draws from `rng`."""
        return SignalDependentNoiseRealisation(self, rng)


class SignalDependentNoiseRealisation:
    """Independent from reading to reading."""

    def __init__(self, noise: SignalDependentNoise, rng: Generator) -> None:
        self._noise = noise
        self._rng = rng

    def apply(self, readings: Readings) -> Readings:
        """Return the readings times their gain."""
        gain = 1 + self._noise.fraction * self._rng.standard_normal(readings.value_V.size)
        return replace(readings, value_V=readings.value_V * gain)
