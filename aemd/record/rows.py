"""Messages of several channels put into one run of bytes, in the order of their instants.

Rows of different length follow each other without padding. A view of every position at which a row could start, with a
stride of one byte, makes both directions one assignment: `view[offsets] = rows` and `rows = view[offsets]`.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from aemd.record.schema import HEADER_BYTES

__all__ = ["EMPTY", "Rows", "Track", "concatenate", "merge", "rows_at"]

_MESSAGE_HEADER = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_FRAME_BYTES = 9  # opcode and length, which the length does not count


@dataclass(frozen=True, slots=True)
class Track:
    """Messages of one channel, in order."""

    channel: int
    t_ns: NDArray[np.int64]
    """Instant of each, shape (n,)."""
    messages: NDArray[np.void] | Sequence[bytes]
    """Rows of fixed width with all but their log times filled in, shape (n,); or n payloads of any length."""

    def lengths(self) -> NDArray[np.int64]:
        """Return the bytes that each record takes, shape (n,)."""
        if isinstance(self.messages, np.ndarray):
            return np.full(len(self.messages), self.messages.dtype.itemsize, np.int64)
        return np.array([HEADER_BYTES + len(payload) for payload in self.messages], np.int64)


@dataclass(frozen=True, slots=True)
class Rows:
    """Message records one after the other."""

    octets: NDArray[np.uint8]
    """The records, shape (bytes,)."""
    channel: NDArray[np.uint16]
    """Channel of each, shape (n,)."""
    log_time: NDArray[np.int64]
    """Log time of each, never falling, shape (n,), ns."""
    start: NDArray[np.int64]
    """Where each begins in `octets`, shape (n,)."""
    turn: int = 0
    """Messages after which the channels come again in the same order, each once; 0 where they come in any."""

    def places(self) -> dict[int, slice | NDArray[np.intp]]:
        """Return which of the messages are each channel's, the channels in order."""
        if self.turn:
            first = self.channel[: self.turn].tolist()
            return {channel: slice(first.index(channel), None, self.turn) for channel in sorted(first)}
        held = np.flatnonzero(np.bincount(self.channel)).tolist()
        return {channel: np.flatnonzero(self.channel == channel) for channel in held}

    def split(self, row: int) -> tuple["Rows", "Rows"]:
        """Return the rows before this one, and those from it on."""
        at = int(self.start[row]) if row < len(self.start) else len(self.octets)
        head = Rows(self.octets[:at], self.channel[:row], self.log_time[:row], self.start[:row], self.turn)
        tail = Rows(self.octets[at:], self.channel[row:], self.log_time[row:], self.start[row:] - at, self.turn)
        return head, tail

    def join(self, after: "Rows") -> "Rows":
        """Return these rows and then those."""
        return Rows(
            np.concatenate([self.octets, after.octets]),
            np.concatenate([self.channel, after.channel]),
            np.concatenate([self.log_time, after.log_time]),
            np.concatenate([self.start, after.start + len(self.octets)]),
        )


EMPTY = Rows(np.empty(0, np.uint8), np.empty(0, np.uint16), np.empty(0, np.int64), np.empty(0, np.int64))


def merge(tracks: Sequence[Track], not_before_ns: int) -> Rows:
    """Put the messages of all tracks in the order of their instants; at equal instants, earlier tracks come first.

    Within a track the order stays, and the log time is the running maximum of the instants: neither an estimate that
    comes later than the reading it belongs to, nor a clock whose fit steps back, puts a message before another one or
    lets the log time fall.

    Args:
        tracks: at least one.
        not_before_ns: log time of what was written before.
    """
    instants = np.concatenate([np.maximum.accumulate(track.t_ns) for track in tracks])
    lengths = np.concatenate([track.lengths() for track in tracks])
    channels = np.repeat(
        np.array([track.channel for track in tracks], np.uint16), [len(track.messages) for track in tracks]
    )
    order = np.argsort(instants, kind="stable")
    log_time = np.maximum.accumulate(np.maximum(instants[order], not_before_ns))
    ends = np.cumsum(lengths[order])
    # The same by track, which is how the messages come.
    start_of, log_time_of = np.empty_like(lengths), np.empty_like(instants)
    start_of[order], log_time_of[order] = ends - lengths[order], log_time

    octets = np.empty(int(lengths.sum()), np.uint8)
    done = 0
    for track in tracks:
        mine = slice(done, done + len(track.messages))
        done = mine.stop
        if isinstance(track.messages, np.ndarray):
            track.messages["log_time"] = log_time_of[mine]
            _every_position(octets, track.messages.dtype)[start_of[mine]] = _as_bytes(track.messages)
            continue
        for payload, start, log, t_ns in zip(
            track.messages, start_of[mine].tolist(), log_time_of[mine].tolist(), track.t_ns.tolist(), strict=True
        ):
            length = HEADER_BYTES - _FRAME_BYTES + len(payload)
            record = _MESSAGE_HEADER.pack(Opcode.MESSAGE, length, track.channel, 0, log, t_ns) + payload
            octets[start : start + len(record)] = np.frombuffer(record, np.uint8)
    return Rows(octets, channels[order], log_time, ends - lengths[order])


def rows_at(octets: NDArray[np.uint8], row: np.dtype[np.void], starts: NDArray[np.int64]) -> NDArray[np.void]:
    """Return the rows of this type that begin at these positions, shape (n,).

    Equally spaced rows, which is what one or two regular channels give, are a view; others are copied together.

    Raises:
        IndexError: a row would not lie inside the octets.
    """
    if len(starts) == 0:
        return np.empty(0, row)
    if starts.min() < 0 or starts.max() + row.itemsize > len(octets):
        raise IndexError(f"a row of {row.itemsize} bytes begins outside {len(octets)} bytes")
    steps = np.diff(starts)
    if len(steps) and (steps == steps[0]).all() and steps[0] > 0:
        return np.ndarray((len(starts),), row, octets, offset=int(starts[0]), strides=(int(steps[0]),))
    return _every_position(octets, row)[starts].view(row)


def concatenate(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return the elements of these arrays of one type, one array after the other; one alone is not copied."""
    if len(arrays) == 1:
        return arrays[0]
    if arrays[0].dtype.names is None:
        return np.concatenate(arrays)
    return np.concatenate([_as_bytes(array) for array in arrays]).view(arrays[0].dtype)


def _every_position(octets: NDArray[np.uint8], row: np.dtype[np.void]) -> NDArray[np.void]:
    return np.ndarray((max(len(octets) - row.itemsize + 1, 0),), f"V{row.itemsize}", octets, strides=(1,))


def _as_bytes(rows: NDArray[np.void]) -> NDArray[np.void]:
    """Return the same rows without their fields: numpy copies fields one by one, which takes twenty times as long."""
    return np.ascontiguousarray(rows).view(f"V{rows.dtype.itemsize}")
