"""What a recording holds, counted the same way by who writes it and by who reads it."""

from dataclasses import asdict, dataclass

import numpy as np

from aemd.block import Batch, Estimates

__all__ = ["Counts"]


@dataclass(slots=True)
class Counts:
    """Readings, estimates and losses so far."""

    first_index: int
    """Index that the first reading has if none was lost."""
    readings: int = 0
    estimates: int = 0
    gaps: int = 0
    """Places where readings are missing."""
    t0_ns: int = 0
    """Instant of the first reading; 0 while there is none."""
    t1_ns: int = 0
    """Instant of the last."""
    next_index: int = -1
    """Index that comes next if no further reading is lost; -1 for `first_index`."""
    _ends_in_gap: bool = False
    """Whether the last that was counted is a loss: one that follows it directly is no further place."""

    def __post_init__(self) -> None:
        if self.next_index < 0:
            self.next_index = self.first_index

    @property
    def lost(self) -> int:
        """Readings that the index counts and the recording lacks."""
        return self.next_index - self.first_index - self.readings

    def add(self, batch: Batch, estimates: Estimates) -> None:
        """Count one more batch and what was estimated with it."""
        block = batch.readings
        self.estimates += len(estimates)
        if len(block):
            index = np.ascontiguousarray(block["index"])  # else each of them is fetched twice, past all its columns
            self.gaps += int(index[0] > self.next_index and not self._ends_in_gap)
            self.gaps += int(np.count_nonzero(index[1:] - index[:-1] > 1))
            self._ends_in_gap = False
            self.t0_ns = self.t0_ns if self.readings else int(block["t_ns"][0])
            self.t1_ns = int(block["t_ns"][-1])
            self.readings += len(block)
            self.next_index = int(index[-1]) + 1
        # A gap that no reading has followed yet shows in its event only.
        for event in batch.events:
            if event.last_index >= self.next_index:
                self.gaps += not self._ends_in_gap
                self._ends_in_gap = True
                self.next_index = event.last_index + 1

    def to_text(self) -> dict[str, str]:
        """Return every field, and the loss, as metadata."""
        told = {name: str(value) for name, value in asdict(self).items() if not name.startswith("_")}
        return told | {"lost": str(self.lost)}
