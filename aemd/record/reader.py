"""Recording: a recording read back as the batches that were written, in constant memory.

The records are walked from the beginning over a memory map, so a file that was never finished, or is still being
written, reads as far as it goes. The summary at the end is not needed.
"""

import mmap
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

from isal.isal_zlib import crc32
from mcap import records
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Footer, McapRecord, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from aemd.block import Batch, Estimates
from aemd.errors import RecordingError
from aemd.record.chunk import BadChunkError, FullIndexes, MessageKind, decode_chunk
from aemd.record.counts import Counts
from aemd.record.cut import Piece, cut, make_batch
from aemd.record.description import Description
from aemd.record.kinds import is_ours, kind_of
from aemd.record.schema import FILTERED, RAW, SCHEMAS, WITNESS_PREFIX
from aemd.record.walk import Record, has_end, parse, walk

__all__ = ["Recording", "Statistics", "open_map"]

_CRC_BYTES = 4
_CRC_PIECE_BYTES = 4 << 20  # at a time, and more than the kernel maps around a byte that is read


@dataclass(frozen=True, slots=True)
class Statistics:
    """What a recording holds, in a few figures."""

    readings: int
    estimates: int
    lost: int
    gaps: int
    t0_ns: int
    """Instant of the first reading; 0 if there is none."""
    t1_ns: int
    """Instant of the last."""
    topics: Mapping[str, int]
    """Messages by topic."""


_AnyRecord = TypeVar("_AnyRecord", bound=McapRecord)


class Recording:
    """A recording, open for reading; a context manager."""

    def __init__(self, path: Path, *, allow_unfinished: bool = False) -> None:
        """Open the file and read all but its messages.

        Args:
            path: a .mcap file, or the .mcap.active of a recording that was not finished.
            allow_unfinished: read what has no end as far as it goes, instead of refusing it.

        Raises:
            RecordingError: it cannot be read, is no MCAP file, has no end, or is none of our recordings.
        """
        self.path = path
        self._map = open_map(path)
        self.metadata: dict[str, dict[str, str]] = {}
        """Every Metadata record by its name; one that comes twice adds to the first."""
        self.channels: dict[str, Channel] = {}
        """By topic."""
        self._attachments: dict[str, bytes] = {}
        self._counted: records.Statistics | None = None
        self._read_bytes = 0
        try:
            self.is_finished = has_end(self._map)
            """Whether the file was closed in order."""
            self.kinds = self._scan(allow_unfinished=allow_unfinished)
            """What the messages of our channels are, by channel number."""
            self.description = self._describe()
        except BaseException:
            self.close()
            raise

    @property
    def size_bytes(self) -> int:
        """Length of the file."""
        return len(self._map)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file. Twice is fine."""
        self._map.close()

    def attachment(self, name: str) -> bytes:
        """Return what is attached under that name.

        Raises:
            RecordingError: nothing is.
        """
        if name not in self._attachments:
            held = ", ".join(sorted(self._attachments)) or "none"
            raise RecordingError(f"{self.path}: has no attachment {name!r}; attached: {held}")
        return self._attachments[name]

    def batches(self, batch_readings: int | None = None) -> Iterator[Batch]:
        """Yield the readings in order; events and witness values come with the first reading after them in the file.

        Args:
            batch_readings: readings in each batch but the last; None for as many as each chunk holds.

        Raises:
            RecordingError: the file is damaged.
        """
        topics = [topic for topic in self.channels if topic != FILTERED]
        for piece in cut(self._pieces(topics), batch_readings):
            yield make_batch(piece)[0]

    def batches_with_estimates(self, batch_readings: int | None = None) -> Iterator[tuple[Batch, Estimates]]:
        """Yield the same, each with the recorded estimates that its readings made ready.

        Those of an estimator that lags belong to earlier readings; pair them by index.

        Raises:
            RecordingError: the file is damaged.
        """
        for piece in cut(self._pieces(self.channels), batch_readings):
            yield make_batch(piece)

    def verify(self) -> None:
        """Hold the file's own checksums and counts against what it holds outside its chunks, whose own are always held.

        Raises:
            RecordingError: they do not fit; the message says which.
        """
        if not self.is_finished:
            return
        end = next((record for record in self._walk() if record.opcode == Opcode.DATA_END), None)
        if end is not None:
            summed = self._parse(DataEnd, end).data_section_crc
            if summed and self._crc(0, end.at) != summed:
                raise RecordingError(f"{self.path}: is damaged: its {end.at} bytes of data do not have their checksum")
        footer = next((record for record in self._walk() if record.opcode == Opcode.FOOTER), None)
        if footer is not None:
            told = self._parse(Footer, footer)
            begin, summed_to = told.summary_start or footer.at, footer.end - _CRC_BYTES
            if told.summary_crc and self._crc(begin, summed_to) != told.summary_crc:
                raise RecordingError(f"{self.path}: is damaged: its summary does not have its checksum")

    def statistics(self) -> Statistics:
        """Return what the recording holds: as it was counted at its end or, if that is missing, by reading it all.

        Raises:
            RecordingError: the file is damaged.
        """
        close = self.metadata.get("aemd.close", {})
        if self.is_finished and self._counted is not None and close:
            counts = self._counted.channel_message_counts
            topics = {topic: counts.get(channel.id, 0) for topic, channel in self.channels.items()}
            try:
                figures = {
                    name: int(close[name]) for name in ("readings", "estimates", "lost", "gaps", "t0_ns", "t1_ns")
                }
            except (KeyError, ValueError):
                pass  # closed by another program
            else:
                for name, topic in (("readings", RAW), ("estimates", FILTERED)):
                    told, held = figures[name], topics.get(topic, 0)
                    if told != held:
                        raise RecordingError(
                            f"{self.path}: is damaged: it tells of {told} {name}, and of {held} messages on {topic}"
                        )
                return Statistics(topics=topics, **figures)
        return self._count()

    def _crc(self, begin: int, end: int) -> int:
        """Return the CRC32 of a stretch of the file."""
        crc = 0
        for at in range(begin, end, _CRC_PIECE_BYTES):
            crc = crc32(self._map[at : min(at + _CRC_PIECE_BYTES, end)], crc)
            # What lies behind is given back to the kernel: else the whole file would count as this program's memory.
            behind = max(at - _CRC_PIECE_BYTES, 0) // mmap.PAGESIZE * mmap.PAGESIZE
            self._map.madvise(mmap.MADV_DONTNEED, behind, at - at % mmap.PAGESIZE - behind)
        return crc

    def _count(self) -> Statistics:
        counted, topics = Counts(self.description.first_index), dict.fromkeys(self.channels, 0)
        for piece in cut(self._pieces(self.channels), None):
            counted.add(*make_batch(piece))
            for topic, messages in piece.items():
                topics[topic] += len(messages.at)
        return Statistics(
            readings=counted.readings,
            estimates=counted.estimates,
            lost=counted.lost,
            gaps=counted.gaps,
            t0_ns=counted.t0_ns,
            t1_ns=counted.t1_ns,
            topics=topics,
        )

    # What stands around the messages.

    def _scan(self, *, allow_unfinished: bool) -> dict[int, MessageKind]:
        """Take in every record that is not a message, and return what the messages of each channel are."""
        if not (self.is_finished or allow_unfinished or self.path.suffix == ".active"):
            last = max((record.end for record in self._walk()), default=len(MCAP0_MAGIC))
            raise RecordingError(
                f"{self.path}: is unfinished: it breaks off at byte {last} of {len(self._map)}, without a footer; "
                "`aemd recover` finishes it, `aemd info` tells what it holds up to there"
            )
        schemas: dict[int, Schema] = {}
        for record in self._walk():
            match record.opcode:
                case Opcode.SCHEMA:
                    schema = self._parse(Schema, record)
                    schemas.setdefault(schema.id, schema)  # the summary's is a copy
                case Opcode.CHANNEL:
                    self._enter(self._parse(Channel, record))
                case Opcode.METADATA:
                    metadata = self._parse(Metadata, record)
                    self.metadata.setdefault(metadata.name, {}).update(metadata.metadata)
                case Opcode.ATTACHMENT:
                    attachment = self._parse(Attachment, record)
                    self._attachments[attachment.name] = attachment.data
                case Opcode.STATISTICS:
                    self._counted = self._parse(records.Statistics, record)
                case Opcode.MESSAGE:
                    raise RecordingError(
                        f"{self.path}: has a message outside a chunk at byte {record.at}; we read chunked files only"
                    )
        if RAW not in self.channels:
            topics = ", ".join(sorted(self.channels)) or "none"
            raise RecordingError(
                f"{self.path}: has no topic {RAW} of {SCHEMAS[RAW]}, which we need; its topics: {topics}"
            )
        return dict(self._kind_of(topic, schemas) for topic in self.channels if is_ours(topic))

    def _enter(self, channel: Channel) -> None:
        """Take in a channel; of several on a topic that is not ours, and of which we read nothing, the last."""
        if channel.id in {known.id for known in self.channels.values()}:
            return  # the summary's is a copy
        first = self.channels.get(channel.topic)
        if first is not None and is_ours(channel.topic):
            raise RecordingError(
                f"{self.path}: has two channels on {channel.topic}, {first.id} and {channel.id}, as where files were "
                f"merged; we read those with one; `aemd replay --topic {RAW} --field value` takes the readings of all"
            )
        self.channels[channel.topic] = channel

    def _kind_of(self, topic: str, schemas: Mapping[int, Schema]) -> tuple[int, MessageKind]:
        channel = self.channels[topic]
        try:
            return channel.id, kind_of(channel, schemas.get(channel.schema_id))
        except ValueError as error:
            raise RecordingError(f"{self.path}: {error}") from error

    def _describe(self) -> Description:
        raw, segment = self.channels[RAW].metadata, self.metadata.get("aemd.segment", {})
        stages = ("session", "instrument", "calibration", "estimator", "clock")
        try:
            first_index, interval_s = int(segment.get("first_index", "0")), float(segment.get("interval_s", "0"))
        except ValueError as error:
            raise RecordingError(f"{self.path}: metadata aemd.segment: {error}; it must hold numbers") from error
        return Description(
            unit=raw.get("unit", "V"),
            quantity=raw.get("quantity", "voltage"),
            interval_s=interval_s,
            first_index=first_index,
            segment={name: text for name, text in segment.items() if name not in {"first_index", "interval_s"}},
            state=self.metadata.get("aemd.state", {}),
            witnesses={
                topic.removeprefix(WITNESS_PREFIX): channel.metadata.get("unit", "")
                for topic, channel in self.channels.items()
                if topic.startswith(WITNESS_PREFIX)
            },
            config_toml=self._attachments.get("config.toml", b"").decode(errors="replace"),
            **{stage: self.metadata.get(f"aemd.{stage}", {}) for stage in stages},
        )

    # Records and chunks.

    def _walk(self) -> Iterator[Record]:
        """Yield every whole record of the file, to its footer or to where an unfinished file breaks off."""
        at = len(MCAP0_MAGIC)
        for record in walk(self._map):
            yield record
            at = record.end
            if record.opcode == Opcode.FOOTER:
                return
        if self.is_finished:
            raise RecordingError(f"{self.path}: is damaged: no record at byte {at}")

    def _parse(self, kind: type[_AnyRecord], record: Record) -> _AnyRecord:
        try:
            return parse(kind, self._map, record)
        except ValueError as error:
            raise RecordingError(f"{self.path}: is damaged: {error}") from error

    def _chunks(self) -> Iterator[tuple[Record, list[Record]]]:
        """Yield each chunk with the message indexes behind it."""
        chunk, indexes = None, list[Record]()
        for record in self._walk():
            if record.opcode == Opcode.MESSAGE_INDEX:
                indexes.append(record)
                continue
            if chunk is not None:
                yield chunk, indexes
            chunk, indexes = (record if record.opcode == Opcode.CHUNK else None), []
        if chunk is not None:
            yield chunk, indexes

    def _pieces(self, topics: Collection[str]) -> Iterator[Piece]:
        """Yield what each chunk holds of these topics, the indexes of readings and estimates in full."""
        indexes_of = FullIndexes(self.description.first_index)
        base = 0
        for chunk, indexes in self._chunks():
            try:
                piece, length = decode_chunk(self._map, chunk, indexes, self.kinds, topics, base)
            except BadChunkError as error:
                raise RecordingError(f"{self.path}: is damaged: its chunk at byte {chunk.at} {error}") from error
            base += length
            indexes_of.restore(piece)
            yield piece


def open_map(path: Path) -> mmap.mmap:
    """Return the file's bytes.

    Raises:
        RecordingError: it cannot be read, or is no MCAP file.
    """
    try:
        with path.open("rb") as file:
            begin = file.read(len(MCAP0_MAGIC))
            if begin == MCAP0_MAGIC:
                return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except IsADirectoryError as error:
        raise RecordingError(f"{path}: is a folder: name the files in it, as {path}/*.mcap") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {(error.strerror or str(error)).lower()}") from error
    if not begin:
        raise RecordingError(f"{path}: is empty: nothing was written to it; remove it, or look for another copy")
    raise RecordingError(
        f"{path}: is no MCAP file: its first 8 bytes are not MCAP's; import a table with `aemd import`"
    )
