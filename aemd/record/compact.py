"""Compact: a recording's small live chunks put together into large ones, with the same messages in the same order.

A live chunk holds a second; at 15 readings/s a chunk of 1 MiB takes ten minutes to fill. What belongs to no chunk comes
over as it is. The copy is read back and held against the original before it gets its name.
"""

import hashlib
import mmap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, McapRecord, Metadata, Schema

from aemd.errors import RecordingError
from aemd.record.chunk import BadChunkError, MessageKind, open_chunk
from aemd.record.growing import Compression, GrowingFile
from aemd.record.reader import Recording, open_map
from aemd.record.rows import EMPTY, Rows
from aemd.record.walk import Record, has_end, parse, walk
from aemd.record.writer import CHUNK_BYTES

__all__ = ["Compaction", "compact"]

_KINDS: dict[int, type[McapRecord]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
}


@dataclass(frozen=True, slots=True)
class Compaction:
    """What was put together."""

    file: str
    """The new recording."""
    messages: int
    chunks_before: int
    chunks: int
    bytes_before: int
    bytes: int


def compact(path: Path, out: Path, *, compression: Compression = "zstd", chunk_bytes: int = CHUNK_BYTES) -> Compaction:
    """Write the recording again, in chunks of this size.

    Raises:
        RecordingError: it is unfinished or damaged, the new one exists, or the disk refuses.
    """
    with Recording(path) as recording, open_map(path) as octets:
        if not has_end(octets):
            raise RecordingError(f"{path}: is unfinished: stop what writes it, or finish it with `aemd recover`")
        recording.verify()
        kinds = recording.kinds
        schemas, channels, before, behind = _around(path, octets)
        file = GrowingFile(out, schemas, channels, compression=compression, durability="crash")
        try:
            for record in before:
                file.append(record)
            original, chunks, messages = hashlib.sha256(), [0, 0], 0
            waiting: list[Rows] = []
            waiting_bytes = 0
            for rows in _rows(path, octets, kinds):
                original.update(rows.octets.data)
                chunks[0] += 1
                messages += len(rows.start)
                waiting.append(rows)
                waiting_bytes += len(rows.octets)
                if waiting_bytes >= chunk_bytes:
                    rest, written = _write(file, _join(waiting), chunk_bytes, behind, to_the_last=False)
                    waiting, waiting_bytes = [rest], len(rest.octets)
                    chunks[1] += written
            _, written = _write(file, _join(waiting), chunk_bytes, behind, to_the_last=True)
            chunks[1] += written
            for record in behind:
                file.append(record)
            file.finish_content()
            _hold_against(file.active, kinds, original.digest())
        except BaseException:
            file.discard()
            raise
        file.take_name()
        return Compaction(str(out), messages, chunks[0], chunks[1], len(octets), out.stat().st_size)


def _around(path: Path, octets: mmap.mmap) -> tuple[list[Schema], list[Channel], list[McapRecord], list[McapRecord]]:
    """Return schemas, channels, and the other records before and behind the first chunk."""
    schemas: list[Schema] = []
    channels: list[Channel] = []
    before: list[McapRecord] = []
    behind: list[McapRecord] = []
    others = before
    for record in walk(octets):
        if record.opcode == Opcode.DATA_END:
            break
        if record.opcode == Opcode.CHUNK:
            others = behind
        kind = _KINDS.get(record.opcode)
        if kind is None:
            continue
        try:
            parsed = parse(kind, octets, record)
        except ValueError as error:
            raise RecordingError(f"{path}: is damaged: {error}") from error
        if isinstance(parsed, Schema):
            schemas.append(parsed)
        elif isinstance(parsed, Channel):
            channels.append(parsed)
        else:
            others.append(parsed)
    return schemas, channels, before, behind


def _rows(path: Path, octets: mmap.mmap, kinds: dict[int, MessageKind]) -> Iterator[Rows]:
    """Yield what each chunk holds."""
    for chunk, indexes in _chunks(octets):
        try:
            yield open_chunk(octets, chunk, indexes, kinds).rows
        except BadChunkError as error:
            raise RecordingError(f"{path}: is damaged: its chunk at byte {chunk.at} {error}") from error


def _chunks(octets: mmap.mmap) -> Iterator[tuple[Record, list[Record]]]:
    chunk, indexes = None, list[Record]()
    for record in walk(octets):
        if record.opcode == Opcode.MESSAGE_INDEX:
            indexes.append(record)
            continue
        if chunk is not None:
            yield chunk, indexes
        chunk, indexes = (record if record.opcode == Opcode.CHUNK else None), []
    if chunk is not None:
        yield chunk, indexes


def _join(parts: list[Rows]) -> Rows:
    """Return these rows, one part after the other, without copying each part more than once."""
    if len(parts) <= 1:
        return parts[0] if parts else EMPTY
    lengths = np.cumsum([0, *(len(part.octets) for part in parts[:-1])])
    return Rows(
        np.concatenate([part.octets for part in parts]),
        np.concatenate([part.channel for part in parts]),
        np.concatenate([part.log_time for part in parts]),
        np.concatenate([part.start + length for part, length in zip(parts, lengths.tolist(), strict=True)]),
    )


def _write(
    file: GrowingFile, rows: Rows, chunk_bytes: int, behind: list[McapRecord], *, to_the_last: bool
) -> tuple[Rows, int]:
    """Write the chunks of at least this size, and the rest where it is the last; return it, and how many there were.

    The attachments that stood behind the first chunk stand behind the first one again, for those who repair files.
    """
    written = 0
    while len(rows.octets) >= chunk_bytes or (to_the_last and len(rows.start)):
        chunk, rows = rows.split(int(np.searchsorted(rows.start, chunk_bytes)))
        file.write_chunk(chunk)
        written += 1
        for record in [record for record in behind if isinstance(record, Attachment)]:
            file.append(record)
            behind.remove(record)
    return rows, written


def _hold_against(copy: Path, kinds: dict[int, MessageKind], digest: bytes) -> None:
    """Make sure that the copy holds the same messages in the same order.

    Raises:
        RecordingError: it does not.
    """
    found = hashlib.sha256()
    with open_map(copy) as octets:
        for rows in _rows(copy, octets, kinds):
            found.update(rows.octets.data)
    if found.digest() != digest:
        raise RecordingError(f"{copy}: is not what was written: the disk gives back other bytes; use another one")
