"""Summary: the table of contents at the end of an MCAP file, kept while the file grows or is read through.

Schemas, Channels, Statistics, ChunkIndexes, AttachmentIndexes, MetadataIndexes, SummaryOffsets, Footer, magic
"""

import struct
from collections.abc import Mapping, Sequence

import numpy as np
from isal.isal_zlib import crc32
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

__all__ = ["Summary", "encode", "encode_index"]

_INDEX_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
_INDEX_OPCODES = (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)
_END_BYTES = 1024  # Statistics, SummaryOffsets, Footer and magic, amply


class Summary:
    """What is told of each record as it comes, in the order of the file; then `end` makes the file's end."""

    def __init__(self, schemas: Sequence[Schema], channels: Sequence[Channel]) -> None:
        self.statistics = Statistics(0, len(channels), {}, 0, 0, 0, 0, 0, len(schemas))
        self._declared = {Opcode.SCHEMA: encode(*schemas), Opcode.CHANNEL: encode(*channels)}
        # Encoded as they come: a day of one-second chunks, as objects, would take ten times the memory.
        self._indexes = {opcode: bytearray() for opcode in _INDEX_OPCODES}

    @property
    def size_bytes(self) -> int:
        """What `end` would return now is no longer than this."""
        known = (*self._declared.values(), *self._indexes.values())
        return sum(map(len, known)) + 10 * len(self.statistics.channel_message_counts) + _END_BYTES

    def add(self, record: McapRecord, offset: int, length: int) -> None:
        """Take note of a record between chunks; only metadata and attachments are noted."""
        if isinstance(record, Metadata):
            self.statistics.metadata_count += 1
            self._indexes[Opcode.METADATA_INDEX] += encode(MetadataIndex(offset, length, record.name))
        elif isinstance(record, Attachment):
            self.statistics.attachment_count += 1
            index = AttachmentIndex(
                offset=offset,
                length=length,
                log_time=record.log_time,
                create_time=record.create_time,
                data_size=len(record.data),
                name=record.name,
                media_type=record.media_type,
            )
            self._indexes[Opcode.ATTACHMENT_INDEX] += encode(index)

    def add_chunk(self, index: ChunkIndex, messages: Mapping[int, int]) -> None:
        """Take note of a chunk, and of its messages by channel."""
        self._indexes[Opcode.CHUNK_INDEX] += encode(index)
        statistics, counts = self.statistics, self.statistics.channel_message_counts
        for channel, count in messages.items():
            counts[channel] = counts.get(channel, 0) + count
        if statistics.chunk_count == 0:
            statistics.message_start_time = index.message_start_time
        statistics.message_start_time = min(statistics.message_start_time, index.message_start_time)
        statistics.message_end_time = max(statistics.message_end_time, index.message_end_time)
        statistics.chunk_count += 1
        statistics.message_count += sum(messages.values())

    def end(self, start: int) -> bytes:
        """Return the summary section, the footer and the closing magic, for a section that begins at this byte."""
        groups: Mapping[Opcode, bytes] = {
            **self._declared,
            Opcode.STATISTICS: encode(self.statistics),
            **{opcode: bytes(octets) for opcode, octets in self._indexes.items()},
        }
        at = start
        offsets = []
        for opcode, group in groups.items():
            if group:
                offsets.append(SummaryOffset(opcode, at, len(group)))
            at += len(group)
        section = b"".join(groups.values()) + encode(*offsets)
        # The summary's CRC covers the footer, too, up to the CRC itself.
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, at)
        return section + encode(Footer(start, at, crc32(section + footer))) + MCAP0_MAGIC


def encode(*records: McapRecord) -> bytes:
    """Return these records as bytes, one after the other."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    octets: bytes = builder.end()  # type: ignore[no-untyped-call] # the package leaves its return type out
    return octets


def encode_index(channel: int, log_time: NDArray[np.integer], start: NDArray[np.integer]) -> bytes:
    """Return the MessageIndex record of one channel's messages in a chunk: log times, and where each begins."""
    entries = np.empty(len(start), _INDEX_ENTRY)
    entries["log_time"], entries["offset"] = log_time, start
    head = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + entries.nbytes, channel, entries.nbytes)
    return b"".join([head, entries.data])
