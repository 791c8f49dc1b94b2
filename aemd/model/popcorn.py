"""Popcorn noise: a level that jumps between two values at random."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.random import Generator

from aemd.model.term import Finite, Positive, Role, Times, Volts

__all__ = ["PopcornNoise"]

_BLOCK = 64
"""Stays drawn at a time. A fixed number, so that the draws do not depend on how the stream is asked for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PopcornNoise:
    """A two-state Markov process: 0, or the step, each for exponentially distributed times."""

    term: Literal["popcorn_noise"] = "popcorn_noise"
    role: Role = "internal"
    step_V: Finite
    """The upper state less the lower one, V."""
    dwell_low_s: Positive
    """Mean stay at 0, s."""
    dwell_high_s: Positive
    """Mean stay at the step, s."""

    def realise(self, rng: Generator) -> "PopcornNoiseRealisation":
        """Return a history whose first state comes from the stationary law."""
        return PopcornNoiseRealisation(self, rng)


class PopcornNoiseRealisation:
    """Knows the times of the jumps and how long it was high before each, from the last that it was asked about on."""

    def __init__(self, noise: PopcornNoise, rng: Generator) -> None:
        self._noise = noise
        self._rng = rng
        self._high = rng.random() * (noise.dwell_low_s + noise.dwell_high_s) < noise.dwell_high_s  # of the next stay
        self._jump_s = np.zeros(1)
        self._high_s = np.zeros(1)

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return the step times the part of each aperture that is in the upper state."""
        if not start_s.size:
            return np.empty(0)
        self._draw_past(float(start_s[-1]) + aperture_s)
        begin, end = (np.interp(t, self._jump_s, self._high_s) for t in (start_s, start_s + aperture_s))
        first = max(int(np.searchsorted(self._jump_s, start_s[-1], side="right")) - 1, 0)
        self._jump_s, self._high_s = self._jump_s[first:], self._high_s[first:]
        return np.asarray(self._noise.step_V * (end - begin) / aperture_s)

    def _draw_past(self, end_s: float) -> None:
        while self._jump_s[-1] <= end_s:
            high = (np.arange(_BLOCK) % 2 == 0) == self._high  # _BLOCK is even, so each begins in the same state
            mean_s = np.where(high, self._noise.dwell_high_s, self._noise.dwell_low_s)
            stay_s = mean_s * self._rng.standard_exponential(_BLOCK)
            jump_s = np.cumsum(np.concatenate((self._jump_s[-1:], stay_s)))
            high_s = np.cumsum(np.concatenate((self._high_s[-1:], np.where(high, stay_s, 0.0))))
            self._jump_s = np.concatenate((self._jump_s, jump_s[1:]))
            self._high_s = np.concatenate((self._high_s, high_s[1:]))
