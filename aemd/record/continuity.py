"""Continuity: do the numbers of a recording's readings go on, is every loss told of, has each reading its estimate?"""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from aemd.block import Batch, Estimates
from aemd.record.counts import Counts
from aemd.record.description import read_parameters

__all__ = ["Continuity"]

_TURN = 1 << 32  # a message has so many numbers; nobody loses half of them, which is days, in a file that goes on


class Continuity:
    """Takes what the chunks hold in the file's order.

    Args:
        first_index: of the first reading.
        find: takes one finding.
    """

    def __init__(self, first_index: int, find: Callable[[str], None]) -> None:
        self.counts = Counts(first_index)
        self._find = find
        self._jumps: set[tuple[int, int]] = set()
        """First and last index of each loss that no event has told of yet."""
        self._told: set[tuple[int, int]] = set()
        self._readings = self._estimates = (-1, -1)
        """Index of the first one and of the last one."""
        self._turns = {"readings": 0, "estimates": 0}
        """Of 2^32 numbers, by which the full ones are too high because chunks are not in their order."""

    def add(self, place: str, batch: Batch, estimates: Estimates) -> None:
        """Take a chunk's; their numbers, made full, are turned back in place where the chunk is not in its own."""
        self._turn_back("readings", batch.readings["index"], self.counts.next_index)
        self._turn_back("estimates", estimates["index"], self._estimates[1])
        self._hold_readings(place, batch)
        self._hold_order(place, estimates)
        self.counts.add(batch, estimates)

    def hold_jumps(self) -> bool:
        """Say which losses no event tells of, and return whether there is none.

        An event may tell of a part, and another one of the rest.
        """
        spans, are_told = sorted(self._told), True
        for first, last in sorted(self._jumps):
            begin = first
            for told_first, told_last in spans:
                if told_first <= begin <= told_last:
                    begin = told_last + 1
            if begin <= last:
                are_told = False
                self._find(f"readings {begin} to {last} are missing, and no event tells of it")
        return are_told

    def hold_estimates(self, estimator: Mapping[str, str], close_reason: str | None) -> None:
        """Say whether each reading has an estimate; one that lags leaves the last ones to the next file.

        Args:
            estimator: as the recording describes it; empty if it has none.
            close_reason: of its closing note; None if it has none.
        """
        if not estimator:
            return
        counts = self.counts
        lag = _lag(estimator)
        # A reading may be the last of its chunk and its estimate the first of the next, which a crash took.
        is_cut = close_reason in {None, "recovered", "disk-full"}
        if abs(counts.readings - counts.estimates) > lag + is_cut:
            self._find(f"it has {counts.readings} readings and {counts.estimates} estimates")
        elif not lag and not is_cut and self._readings != self._estimates:
            self._find(
                f"its readings are {self._readings[0]} to {self._readings[1]}, and its estimates are of readings "
                f"{self._estimates[0]} to {self._estimates[1]}"
            )

    def _turn_back(self, of: str, index: NDArray[np.int64], before: int) -> None:
        """Take numbers that seem to be a turn ahead as what they are: a chunk's that is not in its place."""
        if len(index):
            index -= self._turns[of] * _TURN
            if before >= 0 and index[0] - before > _TURN // 2:
                self._turns[of] += 1
                index -= _TURN

    def _hold_readings(self, place: str, batch: Batch) -> None:
        self._told |= {(event.first_index, event.last_index) for event in batch.events if event.last_index >= 0}
        index = batch.readings["index"]
        if not len(index):
            return
        self._readings = _widen(self._readings, index)
        before = np.concatenate([[self.counts.next_index - 1], index[:-1]])
        steps = index - before
        if (steps < 1).any():
            self._find(
                f"{place} has reading {index[np.argmax(steps < 1)]} after reading {before[np.argmax(steps < 1)]}"
            )
        for at in np.flatnonzero(steps > 1).tolist():
            self._jumps.add((int(before[at]) + 1, int(index[at]) - 1))
        self._jumps -= self._told

    def _hold_order(self, place: str, estimates: Estimates) -> None:
        index = estimates["index"]
        if not len(index):
            return
        last = self._estimates[1]
        before = np.concatenate([[last], index[:-1]])
        if (index <= before)[0 if last >= 0 else 1 :].any():
            self._find(f"{place} has estimates out of order")
        self._estimates = _widen(self._estimates, index)


def _widen(ends: tuple[int, int], index: NDArray[np.int64]) -> tuple[int, int]:
    return (ends[0] if ends[0] >= 0 else int(index[0])), int(index[-1])


def _lag(estimator: Mapping[str, str]) -> int:
    try:
        return int(read_parameters(estimator)[1].get("lag", 0))
    except ValueError:
        return 0
