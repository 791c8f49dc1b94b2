"""Readings and their estimates packed in turns: what nearly every chunk holds, at a fifth of what merging costs.

An estimator without lag gives each reading its estimate at the same instant, so the order is known without sorting:
reading, estimate, reading, estimate. The rows of both are views of one run of bytes with the stride of a whole turn,
and each column of readings and estimates goes straight to its place in it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from aemd.record.rows import Rows
from aemd.record.schema import Layout, fill_rows

__all__ = ["Seat", "Turn", "Turns", "take_turns", "turn_bytes"]

Turn = tuple[NDArray[np.void], ...]
"""Arrays of one length, one for each seat: the values that the channels bring in turns."""


@dataclass(frozen=True, slots=True)
class Seat:
    """One of the channels that take turns."""

    channel: int
    schema: str
    layout: Layout


def turn_bytes(seats: Sequence[Seat]) -> int:
    """Return what a message of each of them takes."""
    return sum(seat.layout.row.itemsize for seat in seats)


def take_turns(parts: Sequence[Turn]) -> bool:
    """Tell whether the channels have a value each at the same instants, and these rise from the first to the last.

    No part may be empty.
    """
    return all(
        bool((first["t_ns"][1:] > first["t_ns"][:-1]).all())
        and all(np.array_equal(other["t_ns"], first["t_ns"]) for other in others)
        for first, *others in parts
    ) and all(bool(before[0]["t_ns"][-1] < after[0]["t_ns"][0]) for before, after in pairwise(parts))


class Turns:
    """Packs what channels bring in turns, chunk after chunk into the same memory.

    What all rows of a channel have in common stands there already, and nothing has to be asked of the kernel: together
    a third of what packing costs. The rows that `pack` returns are good until it is called again.
    """

    def __init__(self, seats: Sequence[Seat]) -> None:
        """Seat the channels in the order of their turns."""
        self._seats = seats
        self._width = turn_bytes(seats)
        self._octets = np.empty(0, np.uint8)
        """A turn's length for what stands before, then whole turns."""
        self._start = np.empty(0, np.int64)
        """Where each message begins, from the first turn's beginning."""
        self._channel = np.empty(0, np.uint16)
        """Of each message."""

    def pack(self, parts: Sequence[Turn], before: Rows, not_before_ns: int) -> Rows:
        """Return the messages of `before`, and behind them those of the parts, which take turns.

        Args:
            parts: at least one, with at least one value.
            before: packed already, here or elsewhere; few, for they are copied.
            not_before_ns: log time of the last of these.
        """
        seats, at = self._seats, len(before.octets)
        count = sum(len(first) for first, *_ in parts)
        kept = before.octets.copy()  # may be the end of what is written over now
        self._make_room(count)
        log_time = np.concatenate([first["t_ns"] for first, *_ in parts])
        np.maximum(log_time, not_before_ns, out=log_time)
        begin = self._width
        for number, seat in enumerate(seats):
            rows = np.ndarray((count,), seat.layout.row, self._octets, offset=begin, strides=(self._width,))
            rows["log_time"] = log_time
            done = 0
            for part in parts:
                fill_rows(rows[done : done + len(part[number])], seat.schema, part[number])
                done += len(part[number])
            begin += seat.layout.row.itemsize
        octets = self._octets[: self._width + count * self._width]
        if at <= self._width:
            octets = octets[self._width - at :]
            octets[:at] = kept
        else:
            octets = np.concatenate([kept, octets[self._width :]])
        messages = count * len(seats)
        channels = [seat.channel for seat in seats]
        continues = (
            len(before.start) < len(seats) and before.channel.tolist() == channels[len(seats) - len(before.start) :]
        )
        return Rows(
            octets,
            np.concatenate([before.channel, self._channel[:messages]]),
            np.concatenate([before.log_time, np.repeat(log_time, len(seats))]),
            np.concatenate([before.start, self._start[:messages] + at]),
            turn=len(seats) if continues else 0,
        )

    def _make_room(self, count: int) -> None:
        """Have memory for so many turns at least, with what every row holds written in."""
        if len(self._octets) >= (count + 1) * self._width:
            return
        self._octets = np.empty((count + 1) * self._width, np.uint8)
        start = np.empty((count, len(self._seats)), np.int64)
        begin = 0
        for number, seat in enumerate(self._seats):
            strides, offset = (self._width,), self._width + begin
            seat.layout.mark(np.ndarray((count,), seat.layout.row, self._octets, offset, strides), seat.channel)
            start[:, number] = np.arange(begin, begin + count * self._width, self._width)
            begin += seat.layout.row.itemsize
        self._start = start.ravel()
        self._channel = np.tile(np.array([seat.channel for seat in self._seats], np.uint16), count)
