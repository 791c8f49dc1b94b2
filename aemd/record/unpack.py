"""The contents of a Chunk record: unpacked, and held against the size and the checksum that it states."""

import struct
from io import BytesIO

import lz4.frame
import zstandard
from isal.isal_zlib import crc32
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.records import Chunk

__all__ = ["BadChunkError", "unpack"]

_MOST_BYTES = 1 << 30  # a chunk that says it is longer is damaged, or nothing that this machine should unpack


class BadChunkError(Exception):
    """The chunk is damaged, or holds what its schema does not allow; the message says which, without the place."""


def unpack(record: bytes) -> tuple[Chunk, bytes]:
    """Return the chunk as it is packed, and the records in it, given the body of its Chunk record.

    Raises:
        BadChunkError: the chunk is damaged, or packed in a way that we do not know.
    """
    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(record)))
    except (struct.error, UnicodeDecodeError, EndOfFile, OverflowError) as error:  # the last: a length beyond 2^63
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
