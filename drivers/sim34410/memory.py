"""The reading memory: fixed size, oldest first; when it is full the oldest are overwritten, and that is counted."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["MEMORY_READINGS", "ReadingMemory"]

MEMORY_READINGS = 50_000
"""Of a 34410A (PRH page 1791)."""


class ReadingMemory:
    """Readings in V, ±9.9E+37 for an overload."""

    def __init__(self) -> None:
        self._value_V = np.zeros(MEMORY_READINGS)
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
        kept = value_V[-MEMORY_READINGS:]
        overwritten = max(self._stored + value_V.size - MEMORY_READINGS, 0)
        begin = self._oldest + self._stored + value_V.size - kept.size
        self._value_V[(begin + np.arange(kept.size)) % MEMORY_READINGS] = kept
        self._oldest = (self._oldest + overwritten) % MEMORY_READINGS
        self._stored += value_V.size - overwritten
        self.last_V = float(value_V[-1])
        return overwritten

    def peek(self) -> NDArray[np.float64]:
        """Return what is stored, oldest first, V, shape (len,)."""
        return self._value_V[(self._oldest + np.arange(self._stored)) % MEMORY_READINGS]

    def take(self, most: int) -> NDArray[np.float64]:
        """Remove and return up to `most` readings, oldest first, V."""
        taken = self.peek()[:most]
        self._oldest = (self._oldest + taken.size) % MEMORY_READINGS
        self._stored -= taken.size
        return taken

    def clear(self) -> None:
        """Forget everything."""
        self._oldest = self._stored = 0
        self.last_V = None
