"""The reading memory: fixed size, oldest first; when it is full the oldest are overwritten, and that is counted."""

from collections import deque
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

__all__ = ["Fate", "Fates", "ReadingMemory"]


class Fate(IntEnum):
    """What became of a reading."""

    STORED = 0
    """It is in the memory."""
    TAKEN = 1
    """A client's command took it out; whether the answer arrived is another matter."""
    OVERWRITTEN = 2
    """The memory was full."""
    CLEARED = 3
    """INITiate, *RST, a change of the measurement, or the loss of power."""


class Fates:
    """What became of every reading that has left the memory, in the order in which they came: runs of equal fates.

    A memory that is first in, first out needs no more: its readings leave in the order in which they came.
    """

    MOST = 100_000  # runs; older ones are forgotten

    def __init__(self) -> None:
        self._runs: deque[tuple[int, Fate]] = deque(maxlen=self.MOST)
        """Each run's end, as a count of readings from the first one ever, and its fate."""

    @property
    def left(self) -> int:
        """How many readings have left the memory."""
        return self._runs[-1][0] if self._runs else 0

    def leave(self, count: int, fate: Fate) -> None:
        """Note that so many more have left."""
        if not count:
            return
        end = self.left + count
        if self._runs and self._runs[-1][1] == fate:
            self._runs.pop()
        self._runs.append((end, fate))

    def of(self, first: int, last: int) -> NDArray[np.uint8]:
        """Return the fates of the readings number `first` to `last` (exclusive), counted from the first one ever."""
        ends = np.fromiter((end for end, _ in self._runs), np.int64, len(self._runs))
        fates = np.fromiter((*(fate for _, fate in self._runs), Fate.STORED), np.uint8, len(self._runs) + 1)
        return fates[np.searchsorted(ends, np.arange(first, last), side="right")]


class ReadingMemory:
    """Readings in V, ±9.9E+37 for an overload."""

    def __init__(self, size: int = 50_000) -> None:
        """Hold up to `size` readings."""
        self.size = size
        self.fates = Fates()
        self._value_V = np.zeros(size)
        self._oldest = 0
        self._stored = 0
        self.last_V: float | None = None
        """The last reading taken, whether or not it has been read out."""

    def __len__(self) -> int:
        return self._stored

    def append(self, value_V: NDArray[np.float64]) -> int:
        """Store readings, shape (n,); return how many were overwritten."""
        if not value_V.size:
            return 0
        kept = value_V[-self.size :]
        overwritten = max(self._stored + value_V.size - self.size, 0)
        begin = self._oldest + self._stored + value_V.size - kept.size
        self._value_V[(begin + np.arange(kept.size)) % self.size] = kept
        self._oldest = (self._oldest + overwritten) % self.size
        self._stored += value_V.size - overwritten
        self.last_V = float(value_V[-1])
        self.fates.leave(overwritten, Fate.OVERWRITTEN)
        return overwritten

    def peek(self) -> NDArray[np.float64]:
        """Return what is stored, oldest first, V, shape (len,)."""
        return self._value_V[(self._oldest + np.arange(self._stored)) % self.size]

    def take(self, most: int) -> NDArray[np.float64]:
        """Remove and return up to `most` readings, oldest first, V."""
        taken = self._value_V[(self._oldest + np.arange(min(most, self._stored))) % self.size]
        self._oldest = (self._oldest + taken.size) % self.size
        self._stored -= taken.size
        self.fates.leave(taken.size, Fate.TAKEN)
        return taken

    def clear(self) -> None:
        """Forget everything."""
        self.fates.leave(self._stored, Fate.CLEARED)
        self._oldest = self._stored = 0
        self.last_V = None
