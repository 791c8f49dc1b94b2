"""GrowingFile: an MCAP file that is readable up to its last record at any time, and gets its name when it is complete.

Layout (MCAP specification, profile ""):

    magic, Header, Schemas, Channels     on disk, with what is appended before `sync`, before the first reading
    Chunk, MessageIndex ...              written as one; each is whole before the next begins
    DataEnd, summary, Footer, magic      at the end

While it grows the file is NAME.mcap.active, locked; its final name never takes the place of another file. Schemas and
channels stand before the first chunk, so that a damaged chunk does not take them with it. Only Message records and the
bodies of MessageIndex are our own bytes; every other record is written by the mcap package.

A file that is told to keep room owns the blocks for its own end at any time: a disk that fills up refuses the next
chunk before a byte of it is written, and what was written before can still be finished.
"""

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Literal, NoReturn

import zstandard
from isal.isal_zlib import crc32
from mcap.records import Channel, DataEnd, Header, McapRecord, Schema
from mcap.writer import MCAP0_MAGIC

from aemd.errors import RecordingError
from aemd.record.chunk import encode_chunk
from aemd.record.disk import NO_ROOM, keep_room, sync_folder, take_name, why
from aemd.record.rows import Rows
from aemd.record.summary import Summary, encode

__all__ = ["UNDER_ANOTHER_NAME", "ZSTD_LEVEL", "Compression", "Durability", "GrowingFile", "compressor_for"]

Compression = Literal["zstd", "zstd-fast", "none"]
"""Fast takes half the time to pack and to unpack, and 2 to 6 % more room: for what can be made again from a file."""
Durability = Literal["power", "crash"]

UNDER_ANOTHER_NAME = "; make room, and record under another name"
"""The way out of a disk's refusal, at the end of its message."""
ZSTD_LEVEL = 1  # level 3 saves less than one per cent of readings, whose last digits are noise
_FAST: dict[str, int] = {
    "strategy": zstandard.STRATEGY_FAST,
    "target_length": 3,  # level -3: three positions in four are not looked at, and single bytes not coded
    "window_log": 20,
    "chain_log": 6,
    "search_log": 1,
    # Level -3 has 13 and 7; a table that the processor's nearest cache holds gives the same size 15 % sooner.
    "hash_log": 10,
    "min_match": 6,
}
_END_BYTES = 1 << 16  # besides the summary: config, close and clock records, DataEnd
_ROOM_STEP_BYTES = 1 << 20  # room is asked for in such steps: at 15 readings/s, some times an hour


def compressor_for(compression: Compression) -> zstandard.ZstdCompressor | None:
    """Return what packs chunks; None where they are stored as they are."""
    if compression == "zstd-fast":
        return zstandard.ZstdCompressor(compression_params=zstandard.ZstdCompressionParameters(**_FAST))
    return zstandard.ZstdCompressor(level=ZSTD_LEVEL) if compression == "zstd" else None


class GrowingFile:
    """The file that a Recorder writes. After a failure it takes no more than its end; after `finish`, nothing."""

    def __init__(
        self,
        path: Path,
        schemas: Sequence[Schema],
        channels: Sequence[Channel],
        *,
        compression: Compression,
        durability: Durability,
        keep_room: bool = False,
        library: str = "",
    ) -> None:
        """Create the .active file with header, schemas and channels.

        Args:
            path: name of the finished file.
            schemas: of the channels.
            channels: of the messages.
            compression: of the chunks.
            durability: "power" syncs each chunk, "crash" leaves that to the kernel.
            keep_room: own the blocks for the file's end from now on.
            library: what the header tells besides our name and version.

        Raises:
            RecordingError: the recording or its .active file exists, or the disk refuses.
        """
        self.path = path
        self.active = path.with_name(path.name + ".active")
        self._compressor = compressor_for(compression)
        self._sync_chunks = durability == "power"
        self._good_bytes = 0
        """What was written whole; also the offset of the next record."""
        self._crc = 0
        """Of all of it."""
        self._room_to = 0 if keep_room else -1
        """To which byte the file owns its blocks; -1 where it does not ask for them."""
        self._summary = Summary(schemas, channels)
        self.has_failed = False

        self._fd = self._create()
        try:
            self._append_bytes(MCAP0_MAGIC)
            self.append(Header(profile="", library=f"aemd {version('aemd')} mcap-python/{version('mcap')}{library}"))
            for record in (*schemas, *channels):
                self.append(record)
        except RecordingError:
            self.discard()
            raise

    @property
    def is_open(self) -> bool:
        """Whether records can be added."""
        return self._fd >= 0 and not self.has_failed

    @property
    def is_released(self) -> bool:
        """Whether nothing more can be done with it."""
        return self._fd < 0

    @property
    def size_bytes(self) -> int:
        """What the file would have if it were finished now, at most."""
        return self._good_bytes + self._summary.size_bytes

    def append(self, record: McapRecord) -> None:
        """Write one record between chunks, and index it where the summary wants that.

        Raises:
            RecordingError: the disk refused; what was written before is kept and readable.
        """
        octets = encode(record)
        offset = self._good_bytes
        self._append_bytes(octets)
        self._summary.add(record, offset, len(octets))

    def write_chunk(self, rows: Rows) -> None:
        """Write these messages, at least one, as a chunk with its message indexes, in one piece.

        Raises:
            RecordingError: the disk refused; what was written before is kept and readable.
        """
        parts, index, counts = encode_chunk(rows, self._compressor, self._good_bytes)
        self._ask_for_room(sum(map(len, parts)))
        self._append_bytes(*parts)
        if self._sync_chunks:
            self._sync()
        self._summary.add_chunk(index, counts)

    def sync(self) -> None:
        """Wait until the disk has the file and its entry in the folder.

        Raises:
            RecordingError: the disk refused.
        """
        self._ask_for_room(0)
        self._sync()
        with self._or_fail():
            sync_folder(self.active.parent)

    def finish(self) -> None:
        """Write the summary, wait for the disk, and give the file its name; after a failure, as far as it was good.

        Raises:
            RecordingError: the disk refused, or the name was taken meanwhile; the .active file is kept and readable.
        """
        self.finish_content()
        self.take_name()

    def finish_content(self) -> None:
        """Write the summary, and wait for the disk.

        Raises:
            RecordingError: the disk refused; the .active file is kept and readable.
        """
        data_end = encode(DataEnd(self._crc))
        self._append_bytes(data_end + self._summary.end(self._good_bytes + len(data_end)))
        if self._room_to > self._good_bytes:
            with self._or_fail():
                os.ftruncate(self._fd, self._good_bytes)  # the room that was not needed
        self._sync()

    def take_name(self) -> None:
        """Give the finished file its name, and let go of it.

        Raises:
            RecordingError: the name was taken meanwhile; the .active file is kept and complete.
        """
        try:
            take_name(self.active, self.path)
        except OSError as error:
            if not self.active.exists():
                raise RecordingError(
                    f"{self.path}: is no more: somebody removed {self.active} while it was written"
                ) from error
            raise RecordingError(
                f"{self.path}: cannot take its name: {why(error)}; the recording is complete, in {self.active.name}: "
                "give it another name"
            ) from error
        finally:
            self.release()

    def discard(self) -> None:
        """Remove the unfinished file; a finished one stays. Twice is fine."""
        if self._fd >= 0:
            self.release()
            self.active.unlink(missing_ok=True)

    def release(self) -> None:
        """Let go of the file as it is, and of its lock. Twice is fine."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _create(self) -> int:
        try:
            if self.path.exists():
                raise RecordingError(f"{self.path}: exists: a recording is never overwritten; choose another name")
            fd = os.open(self.active, os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_CLOEXEC, 0o644)
        except FileExistsError as error:
            raise RecordingError(
                f"{self.active}: exists: another program writes this recording, or one died doing so; choose another "
                "name, or `aemd recover` the unfinished file"
            ) from error
        except OSError as error:
            raise RecordingError(f"{self.active}: cannot be created: {why(error)}; choose another folder") from error
        # Who looks for recordings that a crash has left behind passes over those that are locked. Waits, since such a
        # look, which finds nothing in an empty file, may be going on.
        fcntl.flock(fd, fcntl.LOCK_EX)
        return fd

    def _ask_for_room(self, length: int) -> None:
        """Make sure of the blocks for so many bytes more, and for the file's end behind them."""
        needed = self._good_bytes + length + self._summary.size_bytes + _END_BYTES
        if not 0 <= self._room_to < needed:
            return
        for room_to in (needed + _ROOM_STEP_BYTES, needed):
            try:
                keep_room(self._fd, self._good_bytes, room_to - self._good_bytes)
            except OSError as error:
                if error.errno not in {*NO_ROOM, errno.EIO}:  # a file system that cannot: without, then
                    self._room_to = -1
                    return
                if room_to == needed:
                    self._fail(error)
                continue
            self._room_to = room_to
            return

    def _append_bytes(self, *parts: bytes) -> None:
        at, rest = self._good_bytes, [memoryview(octets) for octets in parts]
        with self._or_fail():
            while rest:
                written = os.pwritev(self._fd, rest, at)
                at += written
                while rest and written >= len(rest[0]):
                    written -= len(rest.pop(0))
                if rest:
                    rest[0] = rest[0][written:]
        self._good_bytes = at
        for octets in parts:
            self._crc = crc32(octets, self._crc)

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
        """Cut the file to what is good; its end may follow, and nothing else."""
        self.has_failed = True
        with contextlib.suppress(OSError):  # a reader stops at the torn record just as well
            if os.fstat(self._fd).st_size > self._good_bytes:
                os.ftruncate(self._fd, self._good_bytes)
                if self._room_to >= 0:  # the cut has given it back
                    keep_room(self._fd, self._good_bytes, self._summary.size_bytes + _END_BYTES)
        raise RecordingError(
            f"{self.active}: cannot be written: {why(error)}; its first {self._good_bytes} bytes are kept and "
            f"readable{UNDER_ANOTHER_NAME}"
        ) from error
