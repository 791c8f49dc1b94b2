"""Stretches of Message records in any MCAP file: the contents of a chunk, or messages that stand in no chunk."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from mmap import mmap
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from aemd.errors import RecordingError
from aemd.record.rows import rows_at
from aemd.record.unpack import BadChunkError, unpack
from aemd.record.walk import FRAME, Record, walk

__all__ = ["HEAD", "Span", "spans"]

HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
"""A Message record up to its payload (MCAP specification, "Message"); its length does not count nine bytes."""

_INDEX = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
_INDEX_HEAD_BYTES = 6  # channel, and the length of what follows
_LOOSE_BYTES = 1 << 20  # of messages that stand in no chunk, in memory at a time


@dataclass(frozen=True, slots=True)
class Span:
    """Some messages, one after the other."""

    at: int
    """Where in the file they are, or the chunk that holds them."""
    octets: NDArray[np.uint8]
    """What holds them, unpacked."""
    starts: NDArray[np.int64]
    """Where each Message record begins in the octets, rising; shape (n,)."""
    declared: Sequence[tuple[int, bytes]] = ()
    """Opcode and body of each Schema and Channel record among them."""

    def heads(self) -> NDArray[np.void]:
        """Return the heads of the messages, shape (n,)."""
        return rows_at(self.octets, HEAD, self.starts)


def spans(octets: mmap, place: str) -> Iterator[Span]:
    """Yield the messages of a file, stretch by stretch, in their order.

    Args:
        octets: the file.
        place: its name, for errors.

    Raises:
        RecordingError: a chunk is damaged, or the file breaks off.
    """
    chunk: Record | None = None
    indexes, loose = list[Record](), list[Record]()
    for record in walk(octets):
        if record.opcode == Opcode.MESSAGE_INDEX:
            indexes.append(record)
            continue
        if chunk is not None:
            yield _in_chunk(octets, chunk, indexes, place)
        chunk, indexes = (record if record.opcode == Opcode.CHUNK else None), []
        if record.opcode == Opcode.MESSAGE:
            loose.append(record)
        if loose and (record.opcode != Opcode.MESSAGE or record.end - loose[0].at > _LOOSE_BYTES):
            yield _loose(octets, loose)
            loose = []
        if record.opcode == Opcode.FOOTER:
            return
    raise RecordingError(f"{place}: is damaged: its records break off before the footer")


def _loose(octets: mmap, messages: list[Record]) -> Span:
    first = messages[0].at
    whole = np.frombuffer(octets[first : messages[-1].end], np.uint8)
    return Span(first, whole, np.array([message.at - first for message in messages], np.int64))


def _in_chunk(octets: mmap, chunk: Record, indexes: Sequence[Record], place: str) -> Span:
    try:
        _, unpacked = unpack(octets, chunk)
        whole = np.frombuffer(unpacked, np.uint8)
        starts = _starts_by_index(whole, [octets[index.begin : index.end] for index in indexes])
        # Without an index, or with one that does not account for every byte: from record to record.
        found, declared = _walk(unpacked, len(unpacked) if starts is None else int(starts[0]))
        if starts is not None and found:
            starts = None
            found, declared = _walk(unpacked, len(unpacked))
    except BadChunkError as error:
        raise RecordingError(f"{place}: is damaged: its chunk at byte {chunk.at} {error}") from error
    return Span(chunk.at, whole, np.array(found, np.int64) if starts is None else starts, declared)


def _starts_by_index(octets: NDArray[np.uint8], bodies: Sequence[bytes]) -> NDArray[np.int64] | None:
    """Return where messages begin as the indexes say, if these messages fill all but the beginning of the chunk."""
    if any(len(body) < _INDEX_HEAD_BYTES or (len(body) - _INDEX_HEAD_BYTES) % _INDEX.itemsize for body in bodies):
        return None
    offsets: list[NDArray[Any]] = [np.frombuffer(body, _INDEX, offset=_INDEX_HEAD_BYTES)["offset"] for body in bodies]
    starts = np.sort(np.concatenate([np.empty(0, np.uint64), *offsets])).astype(np.int64)
    try:
        heads = rows_at(octets, HEAD, starts)
    except IndexError:
        return None
    ends = starts + heads["length"].astype(np.int64) + FRAME.size
    if not len(starts) or (heads["opcode"] != Opcode.MESSAGE).any() or ends[-1] != len(octets):
        return None
    return starts if (starts[1:] == ends[:-1]).all() else None


def _walk(octets: bytes, end: int) -> tuple[list[int], list[tuple[int, bytes]]]:
    """Go from record to record; return where messages begin, and what is declared among them."""
    starts, declared, at = list[int](), list[tuple[int, bytes]](), 0
    while at < end:
        opcode, length = FRAME.unpack_from(octets, at) if at + FRAME.size <= end else (0, end)
        body = at + FRAME.size
        if body + length > end:
            raise BadChunkError("ends inside a record")
        if opcode == Opcode.MESSAGE:
            if length < HEAD.itemsize - FRAME.size:
                raise BadChunkError("holds a message cut short")
            starts.append(at)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            declared.append((opcode, octets[body : body + length]))
        at = body + length
    return starts, declared
