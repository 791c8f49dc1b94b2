"""Check: does a recording hold together? Its checksums, its indexes, its numbers against its content.

Chunk by chunk, so that a file of any size takes no memory; every finding is one line that says what and where.
"""

import mmap
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from mcap import records
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, Footer, MetadataIndex
from mcap.writer import MCAP0_MAGIC

from aemd.errors import RecordingError
from aemd.record.chunk import BadChunkError, Contents, FullIndexes, open_chunk
from aemd.record.continuity import Continuity
from aemd.record.cut import make_batch
from aemd.record.reader import Recording, open_map
from aemd.record.walk import DAMAGED, Record, has_end, parse, walk

__all__ = ["CheckResult", "check"]

_NOTED = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT)
_HELD_OF_CHUNKS = (
    *("chunk_start_offset", "chunk_length", "compression", "compressed_size", "uncompressed_size"),
    *("message_start_time", "message_end_time"),
)
_MOST_FINDINGS = 20  # a file that is wrong throughout is not told of chunk by chunk


@dataclass(frozen=True, slots=True)
class CheckResult:
    """What a check found."""

    file: str
    whole: bool
    """Whether there is no finding."""
    findings: tuple[str, ...]
    """What is wrong, and where."""
    notes: tuple[str, ...]
    """What is no fault of the file: readings that were lost and are told of, stretches that recovery passed over."""
    chunks: int
    readings: int
    estimates: int
    lost: int
    gaps: int


def check(path: Path, *, progress: Callable[[int, int], None] = lambda _done, _total: None) -> CheckResult:
    """Hold everything in the recording that can be held against something else.

    Args:
        path: the recording.
        progress: called with the MiB looked at, and those that there are.

    Raises:
        RecordingError: it cannot be read at all, or is none of our recordings.
    """
    with open_map(path) as octets, Recording(path, allow_unfinished=True) as recording:
        return _Checker(path, octets, recording, progress).run()


class _Checker:
    def __init__(
        self, path: Path, octets: mmap.mmap, recording: Recording, progress: Callable[[int, int], None]
    ) -> None:
        self._path, self._octets, self._recording, self._progress = path, octets, recording, progress
        self._findings: list[str] = []
        self._unsaid = 0
        self._notes: list[str] = []
        first_index = recording.description.first_index
        self._continuity = Continuity(first_index, self._find)
        self._counts = self._continuity.counts
        self._full = FullIndexes(first_index)
        self._messages: dict[int, int] = {}
        self._chunks = 0
        self._first_time_ns = self._log_time_ns = 0
        self._kinds = recording.kinds

    def run(self) -> CheckResult:
        summarised = self._summarised()
        noted = {opcode: list[Record]() for opcode in _NOTED}
        for chunk, indexes in self._records(noted):
            self._take(chunk, indexes, next(summarised, None))
            self._progress(chunk.end >> 20, len(self._octets) >> 20)
        if (extra := next(summarised, None)) is not None:
            self._find(f"the summary tells of a chunk at byte {extra.chunk_start_offset} that is not there")
        are_told = self._continuity.hold_jumps()
        close = self._recording.metadata.get("aemd.close", {})
        self._continuity.hold_estimates(self._recording.description.estimator, close.get("reason"))
        if has_end(self._octets):
            self._hold_end(noted)
        else:
            self._find(self._what_follows() or "it has no end: it was not finished; `aemd recover` finishes it")
        if self._unsaid:
            self._findings.append(f"and {self._unsaid} more")
        if self._counts.lost:
            told = ", and told of" if are_told else ""
            self._notes.append(f"{self._counts.lost} readings lost in {self._counts.gaps} places{told}")
        return CheckResult(
            file=str(self._path),
            whole=not self._findings,
            findings=tuple(self._findings),
            notes=tuple(self._notes),
            chunks=self._chunks,
            readings=self._counts.readings,
            estimates=self._counts.estimates,
            lost=self._counts.lost,
            gaps=self._counts.gaps,
        )

    def _find(self, finding: str) -> None:
        if len(self._findings) < _MOST_FINDINGS:
            self._findings.append(finding)
        else:
            self._unsaid += 1

    def _records(self, noted: Mapping[Opcode, list[Record]]) -> Iterator[tuple[Record, list[Record]]]:
        """Yield each chunk with the message indexes behind it, and note the other records of the data section."""
        chunk, indexes, end = None, list[Record](), len(MCAP0_MAGIC)
        for record in walk(self._octets):
            end = record.end
            if record.opcode == Opcode.MESSAGE_INDEX:
                indexes.append(record)
                continue
            if chunk is not None:
                yield chunk, indexes
            chunk, indexes = (record if record.opcode == Opcode.CHUNK else None), []
            if record.opcode in noted:
                noted[Opcode(record.opcode)].append(record)
            elif record.opcode == DAMAGED:
                length = record.end - record.at
                self._notes.append(f"{length} bytes at byte {record.at} are damaged; recovery passed over them")
            elif record.opcode == Opcode.DATA_END:
                return
        if chunk is not None:
            yield chunk, indexes
        if end != len(self._octets):
            self._find(f"no record at byte {end}")

    def _summarised(self) -> Iterator[ChunkIndex]:
        """Yield the chunk indexes of the summary."""
        footer = self._footer()
        if footer is None or not footer.summary_start:
            return
        for record in walk(self._octets, footer.summary_start):
            if record.opcode == Opcode.CHUNK_INDEX:
                try:
                    yield parse(ChunkIndex, self._octets, record)
                except ValueError as error:
                    self._find(f"the summary is damaged: {error}")

    def _footer(self) -> Footer | None:
        if not has_end(self._octets):
            return None
        at = len(self._octets) - len(MCAP0_MAGIC) - 20 - 9
        found = next(walk(self._octets, at), None)
        return None if found is None else parse(Footer, self._octets, found)

    def _what_follows(self) -> str:
        """Tell of what is behind an end that is in the middle of the file; empty if there is none."""
        for record in walk(self._octets):
            end = record.end + len(MCAP0_MAGIC)
            if record.opcode == Opcode.FOOTER and self._octets[record.end : end] == MCAP0_MAGIC:
                rest = f"{len(self._octets) - end} bytes follow that belong to nothing"
                return f"it ends at byte {end}, and {rest}; `aemd recover` cuts them off"
        return ""

    # Chunks.

    def _take(self, chunk: Record, indexes: list[Record], told: ChunkIndex | None) -> None:
        self._chunks += 1
        place = f"the chunk at byte {chunk.at}"
        try:
            contents = open_chunk(self._octets, chunk, indexes, self._kinds)
        except BadChunkError as error:
            self._find(f"{place} {error}")
            return
        self._hold_index(place, chunk, indexes, contents, told)
        self._hold_times(place, contents)
        for channel, count in contents.messages.items():
            self._messages[channel] = self._messages.get(channel, 0) + count
        self._full.restore(contents.piece)
        batch, estimates = make_batch(contents.piece)
        self._continuity.add(place, batch, estimates)

    def _hold_index(
        self, place: str, chunk: Record, indexes: list[Record], contents: Contents, told: ChunkIndex | None
    ) -> None:
        wanted = contents.index_records()
        held = {int.from_bytes(self._octets[index.begin : index.begin + 2], "little"): index for index in indexes}
        held = {channel: index for channel, index in held.items() if channel in wanted}
        if wanted.keys() != held.keys():
            self._find(f"{place} has message indexes of channels {sorted(held)} instead of {sorted(wanted)}")
        for channel, index in held.items():
            if self._octets[index.at : index.end] != wanted[channel]:
                self._find(f"the message index at byte {index.at} does not agree with its chunk")
        if told is None:
            if has_end(self._octets):
                self._find(f"the summary does not tell of {place}")
            return
        made = contents.chunk_index(chunk.at, chunk.end - chunk.at, chunk.end)
        offsets = {channel: index.at for channel, index in held.items()}
        for name in _HELD_OF_CHUNKS:
            if getattr(told, name) != getattr(made, name):
                self._find(f"the summary tells of {place} that its {name} is {getattr(told, name)}")
        if told.message_index_length != (indexes[-1].end if indexes else chunk.end) - chunk.end:
            self._find(f"the summary tells of {place} that its message_index_length is {told.message_index_length}")
        if {channel: at for channel, at in told.message_index_offsets.items() if channel in offsets} != offsets:
            self._find(f"the summary does not tell where the message indexes of {place} are")

    def _hold_times(self, place: str, contents: Contents) -> None:
        times, head = contents.rows.log_time, contents.head
        if not len(times):
            return
        if times[0] < self._log_time_ns or (times[1:] < times[:-1]).any():
            self._find(f"{place} has a log time before that of the message before it")
        self._first_time_ns = min(self._first_time_ns or int(times.min()), int(times.min()))
        self._log_time_ns = max(self._log_time_ns, int(times.max()))
        if (head.message_start_time, head.message_end_time) != (times.min(), times.max()):
            self._find(f"{place} says that it begins or ends at another time than its messages do")

    # The end.

    def _hold_end(self, noted: Mapping[Opcode, list[Record]]) -> None:
        try:
            self._recording.verify()
        except RecordingError as error:
            self._find(str(error).removeprefix(f"{self._path}: "))
        self._hold_close()
        footer = self._footer()
        if footer is None or not footer.summary_start:
            self._find("it has no summary")
            return
        told: dict[int, list[Record]] = {}
        end = footer.summary_start
        for record in walk(self._octets, footer.summary_start):
            group = told.setdefault(record.opcode, [])
            if record.opcode == Opcode.CHUNK_INDEX:
                del group[1:]  # of these the first and the last will do: there is one for every megabyte of the file
            group.append(record)
            end = record.end
        if end != len(self._octets) - len(MCAP0_MAGIC):
            self._find(f"its end is at byte {end}, and bytes follow that belong to nothing")
        for record in (record for each in told.values() for record in each):
            try:
                self._hold_summary(record, told, noted)
            except ValueError as error:
                self._find(f"the summary is damaged: {error}")
        for opcode, indexed in ((Opcode.METADATA, Opcode.METADATA_INDEX), (Opcode.ATTACHMENT, Opcode.ATTACHMENT_INDEX)):
            if (count := len(told.get(indexed, []))) != len(noted[opcode]):
                self._find(
                    f"it has {len(noted[opcode])} {opcode.name.lower()} records, and its summary tells of {count}"
                )

    def _hold_summary(
        self, record: Record, told: Mapping[int, list[Record]], noted: Mapping[Opcode, list[Record]]
    ) -> None:
        """Hold one record of the summary against the rest of the file.

        Raises:
            ValueError: it is damaged.
        """
        if record.opcode in {Opcode.METADATA_INDEX, Opcode.ATTACHMENT_INDEX}:
            self._hold_place(record)
        elif record.opcode == Opcode.STATISTICS:
            self._hold_statistics(parse(records.Statistics, self._octets, record), told, noted)
        elif record.opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:  # a repetition of the data section's, number included
            number = self._octets[record.begin : record.begin + 2]
            for original in noted[Opcode(record.opcode)]:
                is_same = self._octets[original.begin : original.end] == self._octets[record.begin : record.end]
                if self._octets[original.begin : original.begin + 2] == number and not is_same:
                    self._find(
                        f"the {Opcode(record.opcode).name.lower()} at byte {record.at} is not as at the beginning"
                    )
        elif record.opcode == Opcode.SUMMARY_OFFSET:
            offset = parse(records.SummaryOffset, self._octets, record)
            group = told.get(offset.group_opcode, [])
            if not group and offset.group_length == 0:
                return  # the reference writer tells of groups that it leaves out, too
            if not group or (offset.group_start, offset.group_length) != (group[0].at, group[-1].end - group[0].at):
                self._find(f"the summary offset at byte {record.at} tells of records that are not there")

    def _hold_place(self, record: Record) -> None:
        told: MetadataIndex | AttachmentIndex
        if record.opcode == Opcode.METADATA_INDEX:
            told, opcode = parse(MetadataIndex, self._octets, record), Opcode.METADATA
        else:
            told, opcode = parse(AttachmentIndex, self._octets, record), Opcode.ATTACHMENT
        found = next(walk(self._octets, told.offset), None)
        if found is None or found.opcode != opcode or found.end - found.at != told.length:
            name = opcode.name.lower()
            self._find(f"the summary tells of {name} {told.name!r} at byte {told.offset}; it is not there")

    def _hold_statistics(
        self, told: records.Statistics, summary: Mapping[int, list[Record]], noted: Mapping[Opcode, list[Record]]
    ) -> None:
        counts = {channel: count for channel, count in told.channel_message_counts.items() if count}
        if counts != self._messages:
            self._find(f"its statistics tell of {counts} messages by channel; it holds {self._messages}")
        for name, held in {
            "message_count": sum(self._messages.values()),
            "chunk_count": self._chunks,
            "schema_count": len(summary.get(Opcode.SCHEMA, [])) or told.schema_count,  # a summary may leave them out
            "channel_count": len(summary.get(Opcode.CHANNEL, [])) or told.channel_count,
            "attachment_count": len(noted[Opcode.ATTACHMENT]),
            "metadata_count": len(noted[Opcode.METADATA]),
            "message_start_time": self._first_time_ns,
            "message_end_time": self._log_time_ns,
        }.items():
            if (said := getattr(told, name)) != held:
                self._find(f"its statistics tell of {name} = {said}; it is {held}")

    def _hold_close(self) -> None:
        close = self._recording.metadata.get("aemd.close")
        if close is None:
            self._find("it has no closing note: the program that made it did not finish it")
            return
        for name in ("readings", "estimates", "lost", "next_index"):
            if name in close and close[name] != str(getattr(self._counts, name)):
                self._find(f"its closing note tells of {name} = {close[name]}; it is {getattr(self._counts, name)}")
