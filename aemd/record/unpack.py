"""The contents of a Chunk record: unpacked, and held against the size and the checksum that it states."""

import struct
from dataclasses import dataclass
from mmap import mmap

import lz4.frame
import zstandard
from isal.isal_zlib import crc32

from aemd.record.walk import Record

__all__ = ["BadChunkError", "Head", "unpack"]

_TIMES_SIZE_CRC = struct.Struct("<QQQI")
_MOST_BYTES = 1 << 30  # a chunk that says it is longer is damaged, or nothing that this machine should unpack
_ZSTD_UNTOLD = -1  # of zstandard.frame_content_size: the frame does not tell it


class BadChunkError(Exception):
    """The chunk is damaged, or holds what its schema does not allow; the message says which, without the place."""


@dataclass(frozen=True, slots=True)
class Head:
    """What a Chunk record says of its contents (MCAP specification, "Chunk")."""

    message_start_time: int
    message_end_time: int
    uncompressed_size: int
    uncompressed_crc: int
    """0 for none."""
    compression: str
    compressed_size: int


def unpack(octets: mmap, record: Record) -> tuple[Head, bytes]:
    """Return what a Chunk record says, and the records in it.

    They are unpacked from the file where it lies: the mcap package's own reader copies them three times before. No view
    of the file outlives the call, not even in an error's traceback, or the file could not be closed.

    Raises:
        BadChunkError: the chunk is damaged, or packed in a way that we do not know.
    """
    with memoryview(octets) as file, file[record.begin : record.end] as body:
        try:
            head, at = _parse(body)
        except (struct.error, UnicodeDecodeError) as error:
            raise BadChunkError("has a damaged header") from error
        if head.uncompressed_size > _MOST_BYTES:
            raise BadChunkError(f"claims to unpack to {head.uncompressed_size} bytes")
        with body[at : at + head.compressed_size] as packed:
            contents = _unpack(packed, head)
    if len(contents) != head.uncompressed_size:
        raise BadChunkError(f"unpacks to {len(contents)} bytes instead of {head.uncompressed_size}")
    if head.uncompressed_crc and crc32(contents) != head.uncompressed_crc:
        raise BadChunkError("has a wrong CRC")
    return head, contents


def _unpack(packed: memoryview, head: Head) -> bytes:
    """Return what is packed, without ever taking more memory than the chunk states.

    Raises:
        BadChunkError: it cannot be unpacked, or is longer.
    """
    try:
        match head.compression:
            case "":
                return bytes(packed)
            case "zstd":
                # A frame that tells its size is given a buffer of that size, whatever the most is: one bit may make it
                # exabytes.
                if zstandard.frame_content_size(packed) in {_ZSTD_UNTOLD, head.uncompressed_size}:
                    return zstandard.ZstdDecompressor().decompress(packed, max_output_size=head.uncompressed_size)
            case "lz4":
                frame = lz4.frame.LZ4FrameDecompressor()
                contents: bytes = frame.decompress(packed, max_length=head.uncompressed_size + 1)
                if frame.eof:
                    return contents
            case _:
                raise BadChunkError(f"is compressed with {head.compression!r}, of which we read zstd and lz4 only")
    except (zstandard.ZstdError, RuntimeError) as error:  # the second is lz4's
        raise BadChunkError("cannot be unpacked") from error
    raise BadChunkError(f"does not unpack to the {head.uncompressed_size} bytes that it states")


def _parse(body: memoryview) -> tuple[Head, int]:
    """Return what stands before the data, and where these begin.

    Raises:
        struct.error: the body is too short for what it says.
        UnicodeDecodeError: the name of the compression is none.
    """
    start, end, size, crc = _TIMES_SIZE_CRC.unpack_from(body)
    at = _TIMES_SIZE_CRC.size
    (length,) = struct.unpack_from("<I", body, at)
    (name,) = struct.unpack_from(f"{length}s", body, at + 4)
    at += 4 + length
    (length,) = struct.unpack_from("<Q", body, at)
    at += 8
    if at + length > len(body):
        raise struct.error("the data end behind the record")
    return Head(start, end, size, crc, name.decode(), length), at
