"""One chunk of an MCAP file as arrays: decompressed, checked, and its messages found.

Where a message begins is what the chunk's MessageIndex records say, provided that they add up and that a message is
there; else the records are walked one by one, which is slow and needs no index. Messages of fixed width become arrays
without a copy of their own wherever they are equally spaced.

And the other way: rows packed into a chunk with its message indexes.
"""

import struct
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from mmap import mmap
from typing import Any

import numpy as np
import zstandard
from google.protobuf.message import DecodeError
from isal.isal_zlib import crc32
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex
from numpy.typing import NDArray

from aemd.record.cut import Messages, Piece
from aemd.record.rows import Rows, rows_at
from aemd.record.schema import COLUMNS, FILTERED, RAW, RECORDS, WITNESS, Layout, decode_event
from aemd.record.summary import encode, encode_index
from aemd.record.unpack import BadChunkError, Head, unpack
from aemd.record.walk import Record

__all__ = ["BadChunkError", "Contents", "FullIndexes", "MessageKind", "decode_chunk", "encode_chunk", "open_chunk"]

_FRAME = struct.Struct("<BQ")  # opcode, length of what follows
_DATA_LENGTH = struct.Struct("<Q")
_HEAD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("times", "<u8", 2)])
_INDEX = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
_SEQUENCES = 1 << 32
_INDEX_HEAD_BYTES = 6  # channel, and the length of what follows


@dataclass(frozen=True, slots=True)
class MessageKind:
    """What a channel's messages are."""

    topic: str
    schema: str
    layout: Layout | None
    """None for events, whose words have no fixed width."""


def decode_chunk(
    octets: mmap,
    chunk: Record,
    indexes: Sequence[Record],
    kinds: Mapping[int, MessageKind],
    wanted: Container[str],
    base: int,
) -> tuple[dict[str, Messages], int]:
    """Return the messages of the wanted topics, and the bytes that the chunk unpacks to.

    An index still lacks its upper bits: it is the 32-bit sequence number.

    Args:
        octets: the file.
        chunk: the Chunk record.
        indexes: the MessageIndex records that follow it; some may be missing.
        kinds: by channel number.
        wanted: topics whose messages to return.
        base: what all chunks before it unpacked to.

    Raises:
        BadChunkError: the chunk is damaged or not of its schema.
    """
    _, data = unpack(octets, chunk)
    messages = np.frombuffer(data, np.uint8)
    try:
        starts = _starts_by_turns(messages, kinds) or _starts_by_index(_bodies(octets, indexes), messages, kinds)
        return _decode(messages, starts, kinds, wanted, base), len(data)
    except (_Misplaced, DecodeError):
        pass  # the index is a hint: no CRC of its own covers it
    try:
        return _decode(messages, _starts_by_walking(data), kinds, wanted, base), len(data)
    except (_Misplaced, DecodeError) as error:
        raise BadChunkError("holds a message that is not of its schema") from error


@dataclass(frozen=True, slots=True)
class Contents:
    """All that a chunk holds."""

    head: Head
    """What the chunk says of them."""
    rows: Rows
    """Its messages as they are, in order."""
    piece: Piece
    """Those of the known channels, decoded; an index still lacks its upper bits."""

    @property
    def messages(self) -> dict[int, int]:
        """Messages by channel, the channels in order."""
        channels, counts = np.unique(self.rows.channel, return_counts=True)
        return dict(zip(channels.tolist(), counts.tolist(), strict=True))

    def index_records(self) -> dict[int, bytes]:
        """Return the MessageIndex records that belong behind the chunk, by channel, the channels in order."""
        return _index_records(self.rows)

    def chunk_index(self, offset: int, length: int, indexes_at: int) -> ChunkIndex:
        """Return the summary's record of the chunk.

        Args:
            offset: of the chunk in the file.
            length: of the chunk, its frame included.
            indexes_at: where in the file its message indexes are.
        """
        return _chunk_index(self.head, self.index_records(), offset, length, indexes_at)


def open_chunk(octets: mmap, chunk: Record, indexes: Sequence[Record], kinds: Mapping[int, MessageKind]) -> Contents:
    """Return all that the chunk holds, whatever its indexes say; arguments and errors as of `decode_chunk`."""
    head, data = unpack(octets, chunk)
    messages = np.frombuffer(data, np.uint8)
    topics = {kind.topic for kind in kinds.values()}
    try:
        starts = _starts_by_index(_bodies(octets, indexes), messages, kinds)
        piece = _decode(messages, starts, kinds, topics, 0)
    except (_Misplaced, DecodeError):
        try:
            starts = _starts_by_walking(data)
            piece = _decode(messages, starts, kinds, topics, 0)
        except (_Misplaced, DecodeError) as error:
            raise BadChunkError("holds a message that is not of its schema") from error
    begin = np.concatenate([np.empty(0, np.int64), *starts.values()])
    order = np.argsort(begin, kind="stable")
    channel = np.repeat(np.array(list(starts), np.uint16), [len(each) for each in starts.values()])
    log_time = _rows(messages, _HEAD, begin[order])["times"][:, 0].astype(np.int64)
    return Contents(head, Rows(messages, channel[order], log_time, begin[order]), piece)


def encode_chunk(
    rows: Rows, compressor: zstandard.ZstdCompressor | None, offset: int
) -> tuple[list[bytes], ChunkIndex, dict[int, int]]:
    """Return a chunk of these messages, at least one, with its message indexes; and what the summary wants to know.

    The bytes come in parts, to be written one after the other: joined, they would be copied once more.

    Args:
        rows: the messages.
        compressor: None to store them as they are.
        offset: where in the file the chunk will be.
    """
    octets = rows.octets.data  # a copy of its own would cost more than the checksum
    packed = compressor.compress(octets) if compressor else bytes(octets)
    head = Head(
        message_start_time=int(rows.log_time[0]),
        message_end_time=int(rows.log_time[-1]),
        uncompressed_size=len(octets),
        uncompressed_crc=crc32(octets),
        compression="zstd" if compressor else "",
        compressed_size=len(packed),
    )
    begin, indexes = _until_data(head), _index_records(rows)
    length = len(begin) + len(packed)
    index = _chunk_index(head, indexes, offset, length, offset + length)
    counts = {channel: len(rows.start[mine]) for channel, mine in rows.places().items()}
    return [begin, packed, *indexes.values()], index, counts


class FullIndexes:
    """Gives readings and estimates their indexes in full, chunk by chunk: a Message has the lower 32 bits only.

    Each lies less than one turn after the one before it. The first estimate may belong to a reading before the
    recording's first, if the estimator lags.
    """

    def __init__(self, first_index: int) -> None:
        self._last = {RAW: first_index - 1, FILTERED: first_index - _SEQUENCES // 2}

    def restore(self, piece: Piece) -> None:
        """Put the upper bits into what the next chunk holds."""
        for topic in self._last.keys() & piece.keys():
            sequence = piece[topic].values["index"]
            if len(sequence):
                first = self._last[topic] + (int(sequence[0]) - self._last[topic]) % _SEQUENCES
                if (sequence[1:] > sequence[:-1]).all():
                    sequence += first - int(sequence[0])
                else:
                    sequence[1:] = first + np.cumsum((sequence[1:] - sequence[:-1]) & (_SEQUENCES - 1))
                    sequence[0] = first
                self._last[topic] = int(sequence[-1])


class _Misplaced(Exception):  # noqa: N818 - never leaves this file
    """Where a message of this channel should begin there is none."""


def _until_data(head: Head) -> bytes:
    """Return the Chunk record up to its data, which the mcap package would copy three times."""
    empty = encode(
        Chunk(
            compression=head.compression,
            data=b"",
            message_start_time=head.message_start_time,
            message_end_time=head.message_end_time,
            uncompressed_crc=head.uncompressed_crc,
            uncompressed_size=head.uncompressed_size,
        )
    )
    length = len(empty) - _FRAME.size + head.compressed_size
    told = _DATA_LENGTH.pack(head.compressed_size)
    return _FRAME.pack(Opcode.CHUNK, length) + empty[_FRAME.size : -len(told)] + told


def _index_records(rows: Rows) -> dict[int, bytes]:
    return {
        channel: encode_index(channel, rows.log_time[mine], rows.start[mine]) for channel, mine in rows.places().items()
    }


def _chunk_index(head: Head, indexes: Mapping[int, bytes], offset: int, length: int, indexes_at: int) -> ChunkIndex:
    offsets, at = {}, indexes_at
    for channel, octets in indexes.items():
        offsets[channel] = at
        at += len(octets)
    return ChunkIndex(
        chunk_length=length,
        chunk_start_offset=offset,
        compression=head.compression,
        compressed_size=head.compressed_size,
        message_end_time=head.message_end_time,
        message_index_length=at - indexes_at,
        message_index_offsets=offsets,
        message_start_time=head.message_start_time,
        uncompressed_size=head.uncompressed_size,
    )


def _bodies(octets: mmap, indexes: Sequence[Record]) -> Iterator[bytes]:
    return (octets[index.begin : index.end] for index in indexes)


def _starts_by_turns(
    octets: NDArray[np.uint8], kinds: Mapping[int, MessageKind]
) -> dict[int, NDArray[np.int64]] | None:
    """Return where each channel's messages begin, if channels of fixed width take turns from first byte to last.

    A message of the right length where the one before it ends, up to the end: nothing is taken on trust, and the index,
    a third of most files, need not be read. None where a chunk is not like that.
    """
    begin: dict[int, int] = {}
    width = 0
    while width + _HEAD.itemsize <= len(octets):
        channel = int(octets[width + 9]) | int(octets[width + 10]) << 8
        kind = kinds.get(channel)
        if channel in begin or kind is None or kind.layout is None:
            break
        begin[channel] = width
        width += kind.layout.row.itemsize
    starts: dict[int, NDArray[np.int64]] = {}
    end = 0
    for channel, at in begin.items():
        layout = kinds[channel].layout
        assert layout is not None  # noqa: S101 - as was seen above
        length = layout.row.itemsize
        count = (len(octets) - at - length) // width + 1
        if count < 1 or not layout.are_heads(octets, at, width, count, channel):
            return None
        starts[channel] = np.arange(at, at + count * width, width)
        end += count * length
    return starts if starts and end == len(octets) else None


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
