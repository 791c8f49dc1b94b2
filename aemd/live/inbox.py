"""The live view's end of the pipeline: a sink that can only append, and never waits."""

from collections import deque

from aemd.block import Batch, Estimates

__all__ = ["Inbox"]

MOST_ROWS = 1 << 18  # readings and estimates that may wait: 13 s at 10,000 readings/s, some 15 MB


class Inbox:
    """A bounded queue between the pipeline's thread and the live view's, without a lock.

    It holds references, so a batch costs the same whatever its length. Each counter has one owner, and CPython's deque
    appends and pops atomically. When the live view is too slow, batches are left out of it and counted in `skipped`;
    the recording has them.
    """

    def __init__(self, most_rows: int = MOST_ROWS) -> None:
        self._most_rows = most_rows
        self._queue: deque[tuple[Batch, Estimates]] = deque()
        self._came = 0
        self._went = 0
        self._skipped = 0

    @property
    def skipped(self) -> int:
        """Readings that the live view never saw."""
        return self._skipped

    def write(self, batch: Batch, estimates: Estimates) -> None:
        """Take one batch, or leave it out if too much is waiting."""
        rows = len(batch.readings) + len(estimates) + 1  # the 1 bounds the number of empty ones too
        if self._came - self._went + rows > self._most_rows:
            self._skipped += len(batch.readings)
            return
        self._queue.append((batch, estimates))
        self._came += rows

    def take(self) -> list[tuple[Batch, Estimates]]:
        """Return what waits, oldest first."""
        taken = [self._queue.popleft() for _ in range(len(self._queue))]
        self._went += sum(len(batch.readings) + len(estimates) + 1 for batch, estimates in taken)
        return taken
