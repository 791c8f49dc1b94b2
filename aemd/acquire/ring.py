"""A lossless ring of readings between one writer and one reader.

What a full ring does: nothing. The writer asks `free` before it takes readings out of the instrument and leaves the
rest there, so the instrument's memory is the second buffer and no reading is ever overwritten here.

The two counters only grow, so full and empty differ (equal counters: empty; a capacity apart: full) and no lock is
needed: the writer fills rows and then moves its counter, the reader copies rows and then moves its own. Each counter
has one owner, and CPython makes the store of an int attribute atomic.
"""

import numpy as np

from aemd.block import READING, Block

__all__ = ["Ring"]


class Ring:
    """Fixed memory for `capacity` readings, first in, first out.

    Args:
        capacity: readings it holds; a power of two, so that a position is a counter's low bits.

    Raises:
        ValueError: the capacity is not a power of two.
    """

    def __init__(self, capacity: int) -> None:
        if capacity < 1 or capacity & (capacity - 1):
            raise ValueError(f"ring of {capacity} readings: must be a power of two")
        self._rows = np.zeros(capacity, dtype=READING)
        self._mask = capacity - 1
        self._pushed = 0
        self._popped = 0

    @property
    def capacity(self) -> int:
        """Readings it holds."""
        return self._rows.size

    @property
    def pushed(self) -> int:
        """Readings that ever came in."""
        return self._pushed

    @property
    def popped(self) -> int:
        """Readings that ever went out."""
        return self._popped

    @property
    def waiting(self) -> int:
        """Readings inside."""
        return self._pushed - self._popped

    @property
    def free(self) -> int:
        """Readings that still fit; asked by the writer, it can only grow until the writer's next push."""
        return self.capacity - self.waiting

    def push(self, block: Block) -> None:
        """Copy the block in; all of it or nothing.

        Raises:
            ValueError: it does not fit.
        """
        if block.size > self.free:
            raise ValueError(f"block of {block.size} readings into a ring with room for {self.free}: ask `free` first")
        start = self._pushed & self._mask
        head = min(block.size, self.capacity - start)
        self._rows[start : start + head] = block[:head]
        self._rows[: block.size - head] = block[head:]
        self._pushed += block.size  # publishes the rows, so it comes last

    def pop(self, most: int) -> Block:
        """Take out up to `most` readings, oldest first, as a copy that stays true when the ring moves on."""
        count = min(most, self.waiting)
        start = self._popped & self._mask
        head = min(count, self.capacity - start)
        block = np.concatenate((self._rows[start : start + head], self._rows[: count - head]))
        self._popped += count  # gives the rows back, so it comes last
        return block
