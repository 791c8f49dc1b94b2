"""Survey: what is good in a file that a crash, a power cut or a bad disk has left, found without its end.

Every record is held against its own checksum, or against its own bytes where it has none. What is between two good
records is a damaged stretch; what is behind the last one is a torn tail.
"""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from mmap import mmap

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, McapRecord, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from aemd.block import Event
from aemd.record.chunk import BadChunkError, Contents, FullIndexes, MessageKind, open_chunk
from aemd.record.counts import Counts
from aemd.record.cut import make_batch
from aemd.record.kinds import is_ours, kind_of
from aemd.record.schema import RAW
from aemd.record.summary import Summary, encode
from aemd.record.walk import DAMAGED, FRAME, Record

__all__ = ["Survey", "survey"]

_KINDS: Mapping[int, type[McapRecord]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
}
_CHUNK_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("times", "<u8", 2),
        ("size", "<u8"),
        ("crc", "<u4"),
        ("words", "<u4"),  # bytes of the compression's name
    ]
)
_SEARCH_BYTES = 1 << 20  # searched at a time
_MOST_BYTES = 1 << 31  # a record that says it is longer is damaged


@dataclass(slots=True)
class Survey:
    """What a file holds, and what has to be changed so that it is a whole one."""

    channels: dict[str, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    kinds: dict[int, MessageKind] = field(default_factory=dict)
    counts: Counts = field(default_factory=lambda: Counts(0))
    summary: Summary = field(default_factory=lambda: Summary((), ()))
    chunks: int = 0
    stretches: list[tuple[int, int]] = field(default_factory=list)
    """Begin and end of each damaged stretch."""
    patches: list[tuple[int, bytes]] = field(default_factory=list)
    """What to write where, over damaged bytes only."""
    indexes_rebuilt: int = 0
    lost: list[Event] = field(default_factory=list)
    """Readings that damaged stretches have taken and of which no event in the file tells."""
    last_log_time_ns: int = 0
    end: int = len(MCAP0_MAGIC)
    """Where the file's end belongs: behind the last good record."""
    tail: bytes = b""
    """Message indexes of the last chunk, which were torn."""
    is_ended: bool = False
    """Whether the file's own end follows there."""


def survey(octets: mmap) -> Survey:
    """Look through the file; nothing is changed.

    Raises:
        ValueError: it holds no readings of ours; the message says what it lacks.
    """
    return _Surveyor(octets).run()


class _Surveyor:
    def __init__(self, octets: mmap) -> None:
        self._octets = octets
        self._found = Survey()
        self._full: FullIndexes | None = None
        self._told: set[tuple[int, int]] = set()
        """First and last index of every loss that an event tells of."""
        self._suspects: list[Event] = []
        self._is_interrupted = False
        """Whether a damaged stretch lies between the last chunk and what comes."""
        self._noted: list[tuple[McapRecord, int, int]] = []

    def run(self) -> Survey:
        found, at = self._found, len(MCAP0_MAGIC)
        while True:
            record = _frame(self._octets, at)
            if record is not None and record.opcode in {Opcode.DATA_END, Opcode.FOOTER}:
                found.is_ended = record.opcode == Opcode.DATA_END
                break
            end = None if record is None else self._take(record)
            if end is not None:
                at = found.end = end
                if found.tail:
                    break
                continue
            following = _next_chunk(self._octets, at + 1)
            while following is not None and not self._can_open(following):
                following = _next_chunk(self._octets, following.at + 1)
            if following is None:
                break
            self._pass_over(at, following.at)
            at = found.end = following.at
        if found.stretches and found.patches and found.stretches[-1] == (found.patches[-1][0], found.end):
            found.end = found.stretches.pop()[0]  # nothing good is behind it: it is part of the torn tail
            found.patches.pop()
        if not found.kinds:
            self._declare()
        found.lost = [event for event in self._suspects if (event.first_index, event.last_index) not in self._told]
        return found

    def _take(self, record: Record) -> int | None:
        """Take in a record and what belongs to it; return where the next one is, or None if it is damaged."""
        if record.opcode == Opcode.CHUNK:
            return self._take_chunk(record)
        if record.opcode == DAMAGED:
            self._found.stretches.append((record.at, record.end))
            self._is_interrupted = True
            return record.end
        if record.opcode == Opcode.MESSAGE_INDEX:  # of a chunk that is no more, or written behind the others
            return record.end
        kind = _KINDS.get(record.opcode)
        body = self._octets[record.at : record.end]
        parsed = None if kind is None else _parse(kind, body)
        if parsed is None:
            return None
        if isinstance(parsed, Schema):
            self._found.schemas.setdefault(parsed.id, parsed)
        elif isinstance(parsed, Channel):
            self._found.channels.setdefault(parsed.topic, parsed)
        elif isinstance(parsed, Metadata):
            self._found.metadata.setdefault(parsed.name, {}).update(parsed.metadata)
        self._note(parsed, record.at, record.end - record.at)
        return record.end

    def _note(self, record: McapRecord, offset: int, length: int) -> None:
        if self._found.kinds:
            self._found.summary.add(record, offset, length)
        else:
            self._noted.append((record, offset, length))

    def _declare(self) -> None:
        """Take schemas and channels as complete: from here on there are messages.

        Raises:
            ValueError: there are none for readings of ours.
        """
        found = self._found
        if RAW not in found.channels:
            topics = ", ".join(sorted(found.channels)) or "none"
            raise ValueError(f"has no topic {RAW}, which we need; its topics: {topics}")
        for topic, channel in found.channels.items():
            if is_ours(topic):
                found.kinds[channel.id] = kind_of(channel, found.schemas.get(channel.schema_id))
        found.summary = Summary(list(found.schemas.values()), list(found.channels.values()))
        for record, offset, length in self._noted:
            found.summary.add(record, offset, length)
        first_index = int(found.metadata.get("aemd.segment", {}).get("first_index", "0"))
        found.counts, self._full = Counts(first_index), FullIndexes(first_index)

    def _take_chunk(self, record: Record) -> int | None:
        if not self._found.kinds:
            self._declare()
        indexes = list(_indexes(self._octets, record.end))
        end = indexes[-1].end if indexes else record.end
        contents = self._open(record, indexes)
        if contents is None:
            if _frame(self._octets, end) is None:
                return None  # its length may be what is damaged, or it is the last
            self._pass_over(record.at, end)
            return end
        self._count(contents)
        found, indexes_at = self._found, record.end
        wanted = contents.index_records()
        if self._octets[record.end : end] != b"".join(wanted.values()):
            end = self._mend(record, end, wanted)
        found.summary.add_chunk(contents.chunk_index(record.at, record.end - record.at, indexes_at), contents.messages)
        found.chunks += 1
        return end

    def _mend(self, chunk: Record, end: int, wanted: Mapping[int, bytes]) -> int:
        """Put message indexes behind their chunk where damaged ones were; return where the next record is."""
        found, octets = self._found, b"".join(wanted.values())
        following = _frame(self._octets, chunk.end + len(octets))
        if following is not None:  # the indexes are wrong, and what is behind them is where it was
            end = chunk.end + len(octets)
        else:
            following = _frame(self._octets, end)
        if following is None:
            chunk_after = _next_chunk(self._octets, chunk.end)
            end = len(self._octets) if chunk_after is None else chunk_after.at
            following = chunk_after
        found.indexes_rebuilt += len(wanted)
        rest = end - chunk.end - len(octets)
        if following is None or following.opcode == Opcode.FOOTER:  # nothing good behind: the tail is torn anyway
            found.tail = octets
            return chunk.end
        if rest == 0:
            found.patches.append((chunk.end, octets))
        elif rest >= FRAME.size:
            found.patches.append((chunk.end, octets + FRAME.pack(DAMAGED, rest - FRAME.size)))
            found.stretches.append((end - rest, end))
            self._is_interrupted = True
        return end

    def _count(self, contents: Contents) -> None:
        assert self._full is not None  # noqa: S101 - `_declare` came before
        found = self._found
        self._full.restore(contents.piece)
        batch, estimates = make_batch(contents.piece)
        expected, t_ns = found.counts.next_index, found.counts.t1_ns
        interval_s = float(found.metadata.get("aemd.segment", {}).get("interval_s", "0"))
        if len(batch.readings) and self._is_interrupted:
            first = int(batch.readings["index"][0])
            if first > expected:
                message = f"{first - expected} readings lost: the stretch of the file that held them is damaged"
                t_ns = t_ns + round(interval_s * 1e9) if t_ns else int(batch.readings["t_ns"][0])
                self._suspects.append(Event(t_ns, "gap", message, expected, first - 1))
            self._is_interrupted = False
        self._told |= {(event.first_index, event.last_index) for event in batch.events if event.last_index >= 0}
        found.counts.add(batch, estimates)
        found.last_log_time_ns = max(found.last_log_time_ns, contents.head.message_end_time)

    def _open(self, record: Record, indexes: list[Record]) -> Contents | None:
        try:
            return open_chunk(self._octets, record, indexes, self._found.kinds)
        except BadChunkError:
            return None

    def _can_open(self, record: Record) -> bool:
        if not self._found.kinds:
            self._declare()
        return self._open(record, list(_indexes(self._octets, record.end))) is not None

    def _pass_over(self, begin: int, end: int) -> None:
        self._is_interrupted = True
        if self._found.stretches and self._found.stretches[-1][1] == begin:
            begin = self._found.stretches.pop()[0]
            if self._found.patches and self._found.patches[-1][0] == begin:
                self._found.patches.pop()
        self._found.stretches.append((begin, end))
        self._found.patches.append((begin, FRAME.pack(DAMAGED, end - begin - FRAME.size)))


def _parse(kind: type[McapRecord], octets: bytes) -> McapRecord | None:
    """Return the record if it is whole: written again, it gives the same bytes, checksum included."""
    try:
        parsed: McapRecord = kind.read(ReadDataStream(BytesIO(octets[FRAME.size :])))  # type: ignore[attr-defined] # every subclass has it
        return parsed if encode(parsed) == octets else None
    except (struct.error, EndOfFile, ValueError, OverflowError, MemoryError):
        return None


def _frame(octets: mmap, at: int) -> Record | None:
    """Return the record that seems to be at this byte."""
    if at + FRAME.size > len(octets):
        return None
    opcode, length = FRAME.unpack_from(octets, at)
    end = at + FRAME.size + length
    if not (0 < opcode <= Opcode.DATA_END or opcode == DAMAGED) or length > _MOST_BYTES or end > len(octets):
        return None
    return Record(opcode, at, at + FRAME.size, end)


def _indexes(octets: mmap, at: int) -> Iterator[Record]:
    """Yield the message indexes that are in a row from this byte on."""
    while (record := _frame(octets, at)) is not None and record.opcode == Opcode.MESSAGE_INDEX:
        yield record
        at = record.end


def _next_chunk(octets: mmap, begin: int) -> Record | None:
    """Return what looks like the next chunk: its lengths fit each other, and into the file."""
    overlap = _CHUNK_HEAD.itemsize + 16  # the name of the compression, at most, and the length of what it made
    while begin + overlap <= len(octets):
        piece = octets[begin : begin + _SEARCH_BYTES + overlap]
        for offset in np.flatnonzero(np.frombuffer(piece, np.uint8, len(piece) - overlap + 1) == Opcode.CHUNK).tolist():
            record = _frame(octets, begin + offset)
            if record is not None and _is_chunk(octets, record):
                return record
        begin += _SEARCH_BYTES
    return None


def _is_chunk(octets: mmap, record: Record) -> bool:
    words = int.from_bytes(octets[record.at + 37 : record.at + 41], "little")
    if words > 8:  # "zstd", "lz4" or none
        return False
    told = int.from_bytes(octets[record.at + 41 + words : record.at + 49 + words], "little")
    return told == record.end - record.at - 49 - words
