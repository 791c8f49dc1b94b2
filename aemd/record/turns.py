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

__all__ = ["Seat", "Turn", "pack_turns", "take_turns", "turn_bytes"]

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


def pack_turns(seats: Sequence[Seat], parts: Sequence[Turn], before: Rows, not_before_ns: int) -> Rows:
    """Return the messages of `before`, and behind them those of the parts, which take turns.

    Args:
        seats: the channels, in the order of their turns.
        parts: at least one, with at least one value.
        before: packed already; few, for they are copied.
        not_before_ns: log time of the last of these.
    """
    count, width, at = sum(len(first) for first, *_ in parts), turn_bytes(seats), len(before.octets)
    octets = np.empty(at + count * width, np.uint8)
    octets[:at] = before.octets
    log_time = np.concatenate([first["t_ns"] for first, *_ in parts])
    np.maximum(log_time, not_before_ns, out=log_time)
    start = np.empty((count, len(seats)), np.int64)
    for number, seat in enumerate(seats):
        rows = np.ndarray((count,), seat.layout.row, octets, offset=at, strides=(width,))
        seat.layout.mark(rows, seat.channel)
        rows["log_time"] = log_time
        done = 0
        for part in parts:
            fill_rows(rows[done : done + len(part[number])], seat.schema, part[number])
            done += len(part[number])
        start[:, number] = np.arange(at, at + count * width, width)
        at += seat.layout.row.itemsize
    channels = [seat.channel for seat in seats]
    continues = len(before.start) < len(seats) and before.channel.tolist() == channels[len(seats) - len(before.start) :]
    return Rows(
        octets,
        np.concatenate([before.channel, np.tile(np.array(channels, np.uint16), count)]),
        np.concatenate([before.log_time, np.repeat(log_time, len(seats))]),
        np.concatenate([before.start, start.ravel()]),
        turn=len(seats) if continues else 0,
    )
