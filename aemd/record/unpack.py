"""The contents of a Chunk record: unpacked, and held against the size and the checksum that it states."""

import struct

import lz4.frame
import zstandard
from isal.isal_zlib import crc32
from mcap.records import Chunk

__all__ = ["BadChunkError", "unpack"]

_TIMES_SIZE_CRC = struct.Struct("<QQQI")
_MOST_BYTES = 1 << 30  # a chunk that says it is longer is damaged, or nothing that this machine should unpack


class BadChunkError(Exception):
    """The chunk is damaged, or holds what its schema does not allow; the message says which, without the place."""


def unpack(record: bytes) -> tuple[Chunk, bytes]:
    """Return the chunk as it is packed, and the records in it, given the body of its Chunk record.

    Raises:
        BadChunkError: the chunk is damaged, or packed in a way that we do not know.
    """
    try:
        chunk = _parse(record)
    except (struct.error, UnicodeDecodeError) as error:
        raise BadChunkError("has a damaged header") from error
    if chunk.uncompressed_size > _MOST_BYTES:
        raise BadChunkError(f"claims to unpack to {chunk.uncompressed_size} bytes")
    data: bytes = chunk.data
    try:
        if chunk.compression == "zstd":
            data = zstandard.ZstdDecompressor().decompress(data, max_output_size=chunk.uncompressed_size)
        elif chunk.compression == "lz4":
            data = lz4.frame.decompress(data)
        elif chunk.compression:
            raise BadChunkError(f"is compressed with {chunk.compression!r}, of which we read zstd and lz4 only")
    except (zstandard.ZstdError, RuntimeError) as error:  # the second is lz4's
        raise BadChunkError("cannot be unpacked") from error
    if len(data) != chunk.uncompressed_size:
        raise BadChunkError(f"unpacks to {len(data)} bytes instead of {chunk.uncompressed_size}")
    if chunk.uncompressed_crc and crc32(data) != chunk.uncompressed_crc:
        raise BadChunkError("has a wrong CRC")
    return chunk, data


def _parse(record: bytes) -> Chunk:
    """Do what `Chunk.read` does, which copies the data twice (MCAP specification, "Chunk").

    Raises:
        struct.error: the body is too short for what it says.
        UnicodeDecodeError: the name of the compression is none.
    """
    start, end, size, crc = _TIMES_SIZE_CRC.unpack_from(record)
    at = _TIMES_SIZE_CRC.size
    (length,) = struct.unpack_from("<I", record, at)
    (name,) = struct.unpack_from(f"{length}s", record, at + 4)
    at += 4 + length
    (length,) = struct.unpack_from("<Q", record, at)
    at += 8
    if at + length > len(record):
        raise struct.error("the data end behind the record")
    return Chunk(
        compression=name.decode(),
        data=record[at : at + length],
        message_end_time=end,
        message_start_time=start,
        uncompressed_crc=crc,
        uncompressed_size=size,
    )
