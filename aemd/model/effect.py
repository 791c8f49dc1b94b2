"""What an effect is: something that the meter, its clock or its link does to readings after the aperture.

Terms add up before the aperture, so their order does not matter; effects follow one another, so theirs does. A new one
is a frozen dataclass with an `effect` tag and `realise`, and its name in catalogue.py.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from aemd.model.term import Times, Volts

__all__ = ["EffectRealisation", "Episodes", "Readings", "Witness"]


@dataclass(frozen=True, slots=True)
class Witness:
    """A further quantity beside the readings, such as a temperature."""

    time_s: Times
    """Shape (m,)."""
    value: NDArray[np.float64]
    """Shape (m,), in the unit that `Model.witnesses` tells."""


@dataclass(frozen=True, slots=True)
class Readings:
    """Consecutive readings on their way into a recording."""

    index: NDArray[np.int64]
    """Number since the start, shape (n,); it jumps where readings are counted as lost."""
    stamp_s: Times
    """What the recording will say of their time, s, shape (n,); truly the middle of the aperture."""
    value_V: Volts
    """Shape (n,)."""
    witnesses: Mapping[str, Witness] = field(default_factory=dict)
    """By name."""


class EffectRealisation(Protocol):
    """One history of an effect; how the stream is cut into blocks does not change it."""

    def apply(self, readings: Readings) -> Readings:
        """Return what becomes of these readings; called with consecutive blocks."""


class Episodes:
    """A history of readings that are hit in runs: independent episodes of geometric length."""

    def __init__(self, rng: Generator, fraction: float, mean_readings: float) -> None:
        """Take the long-run fraction of hit readings, in (0, 1), and the mean length of an episode, >= 1.

        The waits are geometric from 0, so that episodes may touch; their mean makes the fraction come out.
        """
        self._rng = rng
        self._begin_odds = fraction / (fraction + (1 - fraction) * mean_readings)
        self._end_odds = 1 / mean_readings
        self._left = self._wait()
        self._hit = False

    def mask(self, count: int) -> NDArray[np.bool_]:
        """Return which of the next `count` readings are hit, shape (count,)."""
        hit = np.zeros(count, dtype=np.bool_)
        at = 0
        while at < count:
            until = min(count, at + self._left)
            hit[at:until] = self._hit
            self._left -= until - at
            at = until
            while self._left == 0:
                self._hit = not self._hit
                self._left = int(self._rng.geometric(self._end_odds)) if self._hit else self._wait()
        return hit

    def _wait(self) -> int:
        return int(self._rng.geometric(self._begin_odds)) - 1
