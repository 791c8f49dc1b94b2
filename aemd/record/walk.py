"""The records of an MCAP file one after the other, each with its place."""

import struct
from collections.abc import Iterator
from io import BytesIO
from mmap import MADV_DONTNEED, PAGESIZE, mmap
from typing import NamedTuple, TypeVar, cast

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import McapRecord
from mcap.writer import MCAP0_MAGIC

__all__ = ["DAMAGED", "FRAME", "Record", "has_end", "parse", "walk"]

FRAME = struct.Struct("<BQ")
"""Opcode, length of what follows."""
DAMAGED = 0x80
"""Opcode of a stretch that `recover` passed over. From 0x80 on they are the applications' own; readers skip them."""

_FOOTER = bytes([Opcode.FOOTER]) + (20).to_bytes(8, "little")
_END_BYTES = len(_FOOTER) + 20 + len(MCAP0_MAGIC)

_KEPT_BYTES = 2 << 20  # of the file, in memory at a time: some chunks
_AROUND_BYTES = 2 << 20  # that the kernel may map before the byte that is read

_AnyRecord = TypeVar("_AnyRecord", bound=McapRecord)


class Record(NamedTuple):
    """Where a record is in the file."""

    opcode: int
    at: int
    begin: int
    """First byte of its body."""
    end: int


def walk(octets: mmap, at: int = len(MCAP0_MAGIC)) -> Iterator[Record]:
    """Yield every whole record from this byte on, to the footer or to where there is none.

    What lies behind is given back to the kernel now and then: else a file that has been read through would count as
    this program's memory, however large.
    """
    kept_from = at
    while at + FRAME.size <= len(octets):
        if at - kept_from > _KEPT_BYTES:
            begin = max(kept_from - _AROUND_BYTES, 0) // PAGESIZE * PAGESIZE
            octets.madvise(MADV_DONTNEED, begin, (at - begin) // PAGESIZE * PAGESIZE)
            kept_from = at
        opcode, length = FRAME.unpack_from(octets, at)
        end = at + FRAME.size + length
        if opcode == 0 or end > len(octets):  # zeros are what a file system leaves where a write got lost
            return
        yield Record(opcode, at, at + FRAME.size, end)
        if opcode == Opcode.FOOTER:
            return
        at = end


def parse(kind: type[_AnyRecord], octets: mmap | bytes, record: Record) -> _AnyRecord:
    """Return the record as the mcap package's class.

    Raises:
        ValueError: it is damaged.
    """
    try:
        parsed = kind.read(ReadDataStream(BytesIO(octets[record.begin : record.end])))  # type: ignore[attr-defined] # every subclass has it
    except (struct.error, UnicodeDecodeError, EndOfFile, OverflowError) as error:
        raise ValueError(f"its {kind.__name__} at byte {record.at}") from error
    return cast("_AnyRecord", parsed)


def has_end(octets: mmap) -> bool:
    """Tell whether the file ends as a finished one does."""
    end = octets[-_END_BYTES:]
    return len(end) == _END_BYTES and end.startswith(_FOOTER) and end.endswith(MCAP0_MAGIC)
