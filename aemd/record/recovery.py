"""Recovery: makes a whole recording, in place, of what a crash, a power cut or a bad disk has left of one.

What is good is not touched. A torn tail is cut off. A damaged stretch in the middle stays where it is, framed as one
record of an opcode that every reader skips, so that the file needs no second copy of itself and what can still be read
in it is not thrown away; its readings are told of as lost. Behind the last good record come a note of all this and the
file's end. Each step leaves a file from which a recovery that is itself interrupted can be repeated.
"""

import mmap
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zstandard
from isal.isal_zlib import crc32
from mcap.records import DataEnd, Metadata

from aemd.errors import RecordingError
from aemd.record.chunk import encode_chunk
from aemd.record.disk import sync_folder, take_name, try_lock, why
from aemd.record.rows import Track, merge
from aemd.record.schema import EVENT, encode_event
from aemd.record.summary import encode
from aemd.record.survey import Survey, survey
from aemd.record.walk import has_end

__all__ = ["Recovery", "recover", "recover_folder"]

_ACTIVE = ".active"
_CRC_PIECE_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Recovery:
    """What a recovery found and did."""

    file: str
    """The finished recording."""
    readings: int
    estimates: int
    lost: int
    """Readings that the index counts and the recording lacks, for whatever reason."""
    gaps: int
    chunks: int
    damaged_stretches: int
    """Passed over in the middle of the file."""
    damaged_bytes: int
    """In them."""
    dropped_bytes: int
    """Cut off: the torn tail, or zeros that a file system left there."""
    indexes_rebuilt: int
    """Message indexes that were missing or wrong."""

    @property
    def is_lossy(self) -> bool:
        """Whether anything was given up."""
        return bool(self.damaged_stretches or self.dropped_bytes)


def recover(path: Path) -> Recovery:
    """Finish an unfinished or damaged recording, and give it its name.

    Args:
        path: NAME.mcap.active, which becomes NAME.mcap; or NAME.mcap, which keeps its name.

    Raises:
        RecordingError: it is no recording, holds nothing, is being written, or its name is taken; or the disk refused.
    """
    target = path.with_suffix("") if path.suffix == _ACTIVE else path
    try:
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be opened: {why(error)}; name an unfinished recording") from error
    try:
        return _recover(path, target, fd)
    except OSError as error:  # a device, or a file system without locks
        raise RecordingError(f"{path}: cannot be recovered: {why(error)}; copy it to a disk of your own") from error
    finally:
        os.close(fd)


def recover_folder(folder: Path) -> Iterator[str]:
    """Recover every unfinished recording of the folder that nobody writes; yield a line about each, failures too.

    One that was begun and got no reading is removed: it would be told of at every start, for ever.
    """
    for path in sorted(folder.glob(f"*.mcap{_ACTIVE}")):
        if path.is_fifo() or _is_being_written(path):  # a pipe would be waited for without end
            continue
        try:
            if _remove_unused(path):
                yield f"removed={path} readings=0"
                continue
            found = recover(path)
        except RecordingError as error:
            yield f"not recovered: {error}"
        else:
            yield (
                f"recovered={found.file} readings={found.readings} lost={found.lost} "
                f"dropped_bytes={found.dropped_bytes} damaged_stretches={found.damaged_stretches}"
            )


def _is_being_written(path: Path) -> bool:
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False  # `recover` says why
    try:
        return not try_lock(fd)
    finally:
        os.close(fd)


def _remove_unused(path: Path) -> bool:
    """Remove a file that has the beginning of a recording and nothing behind it; tell whether it was one.

    Nothing means zeros, which are room that was kept for what comes. Whatever else follows may be what is left of a
    chunk, and stays. An empty file stays, too: somebody may be about to lock it.
    """
    with suppress(OSError, RecordingError), path.open("rb") as file:
        if not try_lock(file.fileno()):
            return False
        found, _ = _look(path, file.fileno())
        file.seek(found.end)
        if found.chunks or found.counts.readings or found.stretches or found.is_ended:
            return False
        while piece := file.read(_CRC_PIECE_BYTES):
            if piece.strip(b"\0"):
                return False
        path.unlink()
        return True
    return False


def _recover(path: Path, target: Path, fd: int) -> Recovery:
    if not try_lock(fd):
        raise RecordingError(f"{path}: is being written by another program; stop that first")
    if target != path and target.exists() and not target.samefile(path):
        raise RecordingError(f"{target}: exists: a recording is never overwritten; move it, and recover again")
    size = os.fstat(fd).st_size
    found, is_whole = _look(path, fd)
    if not (found.counts.readings or found.chunks):
        raise RecordingError(f"{path}: holds no reading; it is left alone, and can be removed")
    report = Recovery(
        file=str(target),
        readings=found.counts.readings,
        estimates=found.counts.estimates,
        lost=found.counts.lost,
        gaps=found.counts.gaps,
        chunks=found.chunks,
        damaged_stretches=len(found.stretches),
        damaged_bytes=sum(end - begin for begin, end in found.stretches),
        dropped_bytes=0 if found.is_ended else size - found.end,
        indexes_rebuilt=found.indexes_rebuilt,
    )
    try:
        if not is_whole:
            _write(fd, found, report)
        os.fsync(fd)
        if target != path:
            take_name(path, target)
        else:
            sync_folder(path.parent)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be finished: {why(error)}; make room, and recover again") from error
    return report


def _look(path: Path, fd: int) -> tuple[Survey, bool]:
    """Return what is good in the file, and whether all of it is, its end included."""
    try:
        octets = mmap.mmap(fd, 0, access=mmap.ACCESS_READ)
    except ValueError as error:
        raise RecordingError(f"{path}: is empty; it is left alone, and can be removed") from error
    with octets:
        try:
            found = survey(octets)
        except ValueError as error:
            raise RecordingError(f"{path}: {error}; it is no recording of ours") from error
        is_whole = not (found.patches or found.tail or found.lost) and has_end(octets) and found.is_ended
        if is_whole:
            wanted = _end(found, _crc(fd, found.end))
            is_whole = octets[found.end :] == wanted
        return found, is_whole


def _write(fd: int, found: Survey, report: Recovery) -> None:
    for offset, octets in found.patches:
        os.pwrite(fd, octets, offset)
    os.fdatasync(fd)
    offset, tail = found.end, found.tail
    # Over the torn tail before it is cut off, so that a full disk has these blocks for it.
    if found.lost and EVENT in found.channels:
        happened = [encode_event(event) for event in found.lost]
        instants = np.array([event.t_ns for event in found.lost], np.int64)
        rows = merge([Track(found.channels[EVENT].id, instants, happened)], found.last_log_time_ns)
        parts, index, messages = encode_chunk(rows, zstandard.ZstdCompressor(), offset + len(tail))
        found.summary.add_chunk(index, messages)
        tail += b"".join(parts)
    facts = {
        "reason": "recovered",
        "dropped_bytes": str(report.dropped_bytes),
        "damaged_stretches": str(report.damaged_stretches),
        "damaged_bytes": str(report.damaged_bytes),
        "indexes_rebuilt": str(report.indexes_rebuilt),
    }
    close = Metadata("aemd.close", facts | found.counts.to_text())
    octets = encode(close)
    found.summary.add(close, offset + len(tail), len(octets))
    tail += octets
    crc = crc32(tail, _crc(fd, offset))
    found.end += len(tail)
    octets = tail + _end(found, crc)
    written = 0
    while written < len(octets):
        written += os.pwrite(fd, memoryview(octets)[written:], offset + written)
    os.ftruncate(fd, offset + len(octets))


def _end(found: Survey, crc: int) -> bytes:
    """Return DataEnd and all behind it."""
    data_end = encode(DataEnd(crc))
    return data_end + found.summary.end(found.end + len(data_end))


def _crc(fd: int, end: int) -> int:
    """Return the checksum of the file up to this byte."""
    crc = 0
    for at in range(0, end, _CRC_PIECE_BYTES):
        crc = crc32(os.pread(fd, min(_CRC_PIECE_BYTES, end - at), at), crc)
    return crc
