"""GrowingFile: an MCAP file that is readable up to its last record at any time, and gets its name when it is complete.

Layout (MCAP specification, profile ""):

    magic, Header, Schemas, Channels     on disk, with what is appended before `sync`, before the first reading
    Chunk, MessageIndex ...              written as one; each is whole before the next begins
    DataEnd, summary, Footer, magic      at the end

While it grows the file is NAME.mcap.active, locked; its final name never takes the place of another file. Schemas and
channels stand before the first chunk, so that a damaged chunk does not take them with it. Only Message records and the
bodies of MessageIndex are our own bytes; every other record is written by the mcap package.
"""

import contextlib
import fcntl
import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Literal, NoReturn

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from aemd.errors import RecordingError
from aemd.record.rows import Rows

__all__ = ["Compression", "Durability", "GrowingFile"]

Compression = Literal["zstd", "none"]
Durability = Literal["power", "crash"]

_ZSTD_LEVEL = 1  # level 3 saves less than one per cent of readings, whose last digits are noise
_INDEX_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
_INDEX_OPCODES = (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)


class GrowingFile:
    """The file that a Recorder writes. After a failure, or `finish`, it is closed and takes nothing more."""

    def __init__(
        self,
        path: Path,
        schemas: Sequence[Schema],
        channels: Sequence[Channel],
        *,
        compression: Compression,
        durability: Durability,
    ) -> None:
        """Create the .active file with header, schemas and channels.

        Raises:
            RecordingError: the recording or its .active file exists, or the disk refuses.
        """
        self.path = path
        self.active = path.with_name(path.name + ".active")
        self._schemas, self._channels = schemas, channels
        self._compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL) if compression == "zstd" else None
        self._sync_chunks = durability == "power"
        self._good_bytes = 0
        """What was written whole; also the offset of the next record."""
        self._crc = 0
        """Of all of it."""
        self._statistics = Statistics(0, len(channels), {}, 0, 0, 0, 0, 0, len(schemas))
        # Encoded as they come: a day of one-second chunks, as objects, would take ten times the memory.
        self._indexes = {opcode: RecordBuilder() for opcode in _INDEX_OPCODES}

        self._fd = self._create()
        self._append_bytes(MCAP0_MAGIC)
        self.append(Header(profile="", library=f"aemd {version('aemd')} mcap-python/{version('mcap')}"))
        for record in (*schemas, *channels):
            self.append(record)

    @property
    def is_open(self) -> bool:
        """Whether records can be added."""
        return self._fd >= 0

    def append(self, record: McapRecord) -> None:
        """Write one record between chunks, and index it where the summary wants that.

        Raises:
            RecordingError: the disk refused; what was written before is kept and readable.
        """
        octets = _encode(record)
        offset = self._good_bytes
        self._append_bytes(octets)
        if isinstance(record, Metadata):
            self._statistics.metadata_count += 1
            MetadataIndex(offset, len(octets), record.name).write(self._indexes[Opcode.METADATA_INDEX])
        elif isinstance(record, Attachment):
            self._statistics.attachment_count += 1
            AttachmentIndex(
                offset=offset,
                length=len(octets),
                log_time=record.log_time,
                create_time=record.create_time,
                data_size=len(record.data),
                name=record.name,
                media_type=record.media_type,
            ).write(self._indexes[Opcode.ATTACHMENT_INDEX])

    def write_chunk(self, rows: Rows) -> None:
        """Write these messages, at least one, as a chunk with its message indexes, in one piece.

        Raises:
            RecordingError: the disk refused; what was written before is kept and readable.
        """
        octets = rows.octets.tobytes()
        first_ns, last_ns = int(rows.log_time[0]), int(rows.log_time[-1])
        compression = "zstd" if self._compressor else ""
        stored = self._compressor.compress(octets) if self._compressor else octets
        chunk = _encode(
            Chunk(
                compression=compression,
                data=stored,
                message_start_time=first_ns,
                message_end_time=last_ns,
                uncompressed_crc=zlib.crc32(octets),
                uncompressed_size=len(octets),
            )
        )
        parts, offsets = [chunk], {}
        offset, at = self._good_bytes, self._good_bytes + len(chunk)
        for channel in np.unique(rows.channel).tolist():
            mine = rows.channel == channel
            entries = np.empty(np.count_nonzero(mine), _INDEX_ENTRY)
            entries["log_time"], entries["offset"] = rows.log_time[mine], rows.start[mine]
            body = entries.tobytes()
            parts.append(struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(body), channel, len(body)) + body)
            offsets[channel] = at
            at += len(parts[-1])
            counts = self._statistics.channel_message_counts
            counts[channel] = counts.get(channel, 0) + len(entries)
        self._append_bytes(b"".join(parts))
        if self._sync_chunks:
            self._sync()

        ChunkIndex(
            chunk_length=len(chunk),
            chunk_start_offset=offset,
            compression=compression,
            compressed_size=len(stored),
            message_end_time=last_ns,
            message_index_length=at - offset - len(chunk),
            message_index_offsets=offsets,
            message_start_time=first_ns,
            uncompressed_size=len(octets),
        ).write(self._indexes[Opcode.CHUNK_INDEX])
        if self._statistics.chunk_count == 0:
            self._statistics.message_start_time = first_ns
        self._statistics.message_end_time = last_ns
        self._statistics.chunk_count += 1
        self._statistics.message_count += len(rows.start)

    def sync(self) -> None:
        """Wait until the disk has the file and its entry in the folder.

        Raises:
            RecordingError: the disk refused.
        """
        self._sync()
        with self._or_fail():
            _sync_folder(self.active.parent)

    def finish(self) -> None:
        """Write the summary, wait for the disk, and give the file its name.

        Raises:
            RecordingError: the disk refused, or the name was taken meanwhile; the .active file is kept and readable.
        """
        self.append(DataEnd(self._crc))
        self._append_bytes(self._summary())
        self._sync()
        try:
            os.link(self.active, self.path)  # unlike a rename, it fails where the name is taken
            self.active.unlink()
            _sync_folder(self.path.parent)
        except OSError as error:
            raise RecordingError(
                f"{self.path}: cannot take its name: {_why(error)}; the recording is complete, in {self.active.name}: "
                "give it another name"
            ) from error
        finally:
            self._release()

    def discard(self) -> None:
        """Remove the unfinished file; a finished one stays. Twice is fine."""
        if self.is_open:
            self._release()
            self.active.unlink()

    def _create(self) -> int:
        try:
            if self.path.exists():
                raise RecordingError(f"{self.path}: exists: a recording is never overwritten; choose another name")
            fd = os.open(self.active, os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_CLOEXEC, 0o644)
        except FileExistsError as error:
            raise RecordingError(
                f"{self.active}: exists: another program writes this recording, or one died doing so; choose another "
                "name, or move the unfinished file away"
            ) from error
        except OSError as error:
            raise RecordingError(f"{self.active}: cannot be created: {_why(error)}; choose another folder") from error
        # Who looks for recordings that a crash has left behind passes over those that are locked.
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return fd

    def _append_bytes(self, octets: bytes) -> None:
        rest = memoryview(octets)
        with self._or_fail():
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        self._good_bytes += len(octets)
        self._crc = zlib.crc32(octets, self._crc)

    def _sync(self) -> None:
        with self._or_fail():
            os.fdatasync(self._fd)

    @contextlib.contextmanager
    def _or_fail(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> NoReturn:
        """Cut the file to what is good, and let go of it."""
        with contextlib.suppress(OSError):  # a reader stops at the torn record just as well
            os.ftruncate(self._fd, self._good_bytes)
        self._release()
        raise RecordingError(
            f"{self.active}: cannot be written: {_why(error)}; its first {self._good_bytes} bytes are kept and "
            "readable; make room, and record under another name"
        ) from error

    def _release(self) -> None:
        os.close(self._fd)
        self._fd = -1

    def _summary(self) -> bytes:
        """Return the summary section, the footer and the closing magic."""
        groups: Mapping[Opcode, bytes] = {
            Opcode.SCHEMA: _encode(*self._schemas),
            Opcode.CHANNEL: _encode(*self._channels),
            Opcode.STATISTICS: _encode(self._statistics),
            **{opcode: _drain(builder) for opcode, builder in self._indexes.items()},
        }
        start = at = self._good_bytes
        offsets = []
        for opcode, group in groups.items():
            if group:
                offsets.append(SummaryOffset(opcode, at, len(group)))
            at += len(group)
        summary = b"".join(groups.values()) + _encode(*offsets)
        # The summary's CRC covers the footer, too, up to the CRC itself.
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, at)
        return summary + _encode(Footer(start, at, zlib.crc32(summary + footer))) + MCAP0_MAGIC


def _encode(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return _drain(builder)


def _drain(builder: RecordBuilder) -> bytes:
    octets: bytes = builder.end()  # type: ignore[no-untyped-call] # the package leaves its return type out
    return octets


def _sync_folder(folder: Path) -> None:
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _why(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
