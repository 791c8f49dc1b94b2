"""One chunk of an MCAP file as arrays: decompressed, checked, and its messages found.

Where a message begins is what the chunk's MessageIndex records say, provided that they add up and that a message is
there; else the records are walked one by one, which is slow and needs no index. Messages of fixed width become arrays
without a copy of their own wherever they are equally spaced.
"""

import struct
import zlib
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
import zstandard
from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Chunk
from numpy.typing import NDArray

from aemd.record.cut import Messages
from aemd.record.rows import rows_at
from aemd.record.schema import COLUMNS, RECORDS, WITNESS, Layout, decode_event

__all__ = ["BadChunkError", "MessageKind", "decode_chunk"]

_FRAME = struct.Struct("<BQ")  # opcode, length of what follows
_HEAD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("times", "<u8", 2)])
_INDEX = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
_INDEX_HEAD_BYTES = 6  # channel, and the length of what follows
_MOST_BYTES = 1 << 30  # a chunk that says it is longer is damaged, or nothing that this machine should unpack


class BadChunkError(Exception):
    """The chunk is damaged, or holds what its schema does not allow; the message says which, without the place."""


@dataclass(frozen=True, slots=True)
class MessageKind:
    """What a channel's messages are."""

    topic: str
    schema: str
    layout: Layout | None
    """None for events, whose words have no fixed width."""


def decode_chunk(
    record: bytes, indexes: Iterable[bytes], kinds: Mapping[int, MessageKind], wanted: Container[str], base: int
) -> tuple[dict[str, Messages], int]:
    """Return the messages of the wanted topics, and the bytes that the chunk unpacks to.

    An index still lacks its upper bits: it is the 32-bit sequence number.

    Args:
        record: the body of the Chunk record.
        indexes: bodies of the MessageIndex records that follow it; some may be missing.
        kinds: by channel number.
        wanted: topics whose messages to return.
        base: what all chunks before it unpacked to.

    Raises:
        BadChunkError: the chunk is damaged or not of its schema.
    """
    data = _unpack(record)
    octets = np.frombuffer(data, np.uint8)
    try:
        starts = _starts_by_index(indexes, octets, kinds)
        return _decode(octets, starts, kinds, wanted, base), len(data)
    except _Misplaced:
        pass  # the index is a hint: no CRC of its own covers it
    try:
        return _decode(octets, _starts_by_walking(data), kinds, wanted, base), len(data)
    except (_Misplaced, DecodeError) as error:
        raise BadChunkError("holds a message that is not of its schema") from error


class _Misplaced(Exception):  # noqa: N818 - never leaves this file
    """Where a message of this channel should begin there is none."""


def _unpack(record: bytes) -> bytes:
    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(record)))
    except (struct.error, UnicodeDecodeError, EndOfFile) as error:
        raise BadChunkError("has a damaged header") from error
    if chunk.uncompressed_size > _MOST_BYTES:
        raise BadChunkError(f"claims to unpack to {chunk.uncompressed_size} bytes")
    data: bytes = chunk.data
    if chunk.compression == "zstd":
        try:
            data = zstandard.ZstdDecompressor().decompress(data, max_output_size=chunk.uncompressed_size)
        except zstandard.ZstdError as error:
            raise BadChunkError("cannot be unpacked") from error
    elif chunk.compression:
        raise BadChunkError(f"is compressed with {chunk.compression!r}, of which we read zstd only")
    if len(data) != chunk.uncompressed_size:
        raise BadChunkError(f"unpacks to {len(data)} bytes instead of {chunk.uncompressed_size}")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise BadChunkError("has a wrong CRC")
    return data


def _starts_by_index(
    indexes: Iterable[bytes], octets: NDArray[np.uint8], kinds: Mapping[int, MessageKind]
) -> dict[int, NDArray[np.int64]]:
    """Return where each channel's messages begin as the index says, if that accounts for every byte of the chunk."""
    starts: dict[int, NDArray[np.int64]] = {}
    length = 0
    for body in indexes:
        if len(body) < _INDEX_HEAD_BYTES or (len(body) - _INDEX_HEAD_BYTES) % _INDEX.itemsize:
            raise _Misplaced
        channel = int.from_bytes(body[:2], "little")
        begin = np.frombuffer(body, _INDEX, offset=_INDEX_HEAD_BYTES)["offset"].astype(np.int64)
        if channel in starts or channel not in kinds or (begin[1:] <= begin[:-1]).any():
            raise _Misplaced
        starts[channel] = begin
        layout = kinds[channel].layout
        if layout is None:
            length += sum(_FRAME.size + size for size in _rows(octets, _HEAD, begin)["length"].tolist())
        else:
            length += len(begin) * layout.row.itemsize
    if length != len(octets):
        raise _Misplaced
    return starts


def _starts_by_walking(data: bytes) -> dict[int, NDArray[np.int64]]:
    """Return where each channel's messages begin, going from record to record."""
    starts: dict[int, list[int]] = {}
    at = 0
    while at < len(data):
        opcode, length = _FRAME.unpack_from(data, at) if at + _FRAME.size <= len(data) else (0, len(data))
        if at + _FRAME.size + length > len(data):
            raise BadChunkError("ends inside a record")
        if opcode == Opcode.MESSAGE:
            starts.setdefault(int.from_bytes(data[at + 9 : at + 11], "little"), []).append(at)
        at += _FRAME.size + length
    return {channel: np.array(begin, np.int64) for channel, begin in starts.items()}


def _decode(
    octets: NDArray[np.uint8],
    starts: Mapping[int, NDArray[np.int64]],
    kinds: Mapping[int, MessageKind],
    wanted: Container[str],
    base: int,
) -> dict[str, Messages]:
    return {
        kinds[channel].topic: Messages(begin + base, _decode_channel(octets, begin, channel, kinds[channel]))
        for channel, begin in starts.items()
        if channel in kinds and kinds[channel].topic in wanted
    }


def _decode_channel(
    octets: NDArray[np.uint8], begin: NDArray[np.int64], channel: int, kind: MessageKind
) -> NDArray[Any]:
    if kind.layout is None:
        return _decode_events(octets, begin, channel)
    rows = _rows(octets, kind.layout.row, begin)
    if not kind.layout.are_rows(rows, channel):
        raise _Misplaced
    values = np.empty(len(rows), RECORDS[kind.schema])
    values["t_ns"] = rows["publish_time"]
    if kind.schema != WITNESS:
        values["index"] = rows["sequence"]
    for field, column in COLUMNS[kind.schema].items():
        values[column] = rows[field]
    return values


def _decode_events(octets: NDArray[np.uint8], begin: NDArray[np.int64], channel: int) -> NDArray[np.object_]:
    events = np.empty(len(begin), object)
    for number, (at, head) in enumerate(zip(begin.tolist(), _rows(octets, _HEAD, begin), strict=True)):
        end = at + _FRAME.size + int(head["length"])
        if head["opcode"] != Opcode.MESSAGE or head["channel"] != channel or end > len(octets):
            raise _Misplaced
        events[number] = decode_event(octets[at + _HEAD.itemsize : end].tobytes(), int(head["times"][1]))
    return events


def _rows(octets: NDArray[np.uint8], row: np.dtype[np.void], begin: NDArray[np.int64]) -> NDArray[np.void]:
    try:
        return rows_at(octets, row, begin)
    except IndexError as error:
        raise _Misplaced from error
