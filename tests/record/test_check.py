"""What a check holds against each other, one by one."""

import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from aemd.block import Batch
from aemd.errors import RecordingError
from aemd.record.check import check
from aemd.record.description import Description
from aemd.record.schema import SCHEMA_DATA
from tests.record.made import estimates_of, readings_of, records_of


def test_a_wrong_message_index_is_found_without_a_checksum_over_it(record: Callable[..., Path], tmp_path: Path) -> None:
    """A file may leave out the data section's checksum (0, MCAP specification), and an index has none of its own."""
    readings = readings_of(20)
    octets = bytearray(record([(Batch(readings), estimates_of(readings))]).read_bytes())
    records = records_of(bytes(octets))
    index = next(at for opcode, at, _ in records if opcode == 0x07)
    data_end = next(at for opcode, at, _ in records if opcode == 0x0F)
    octets[data_end + 9 : data_end + 13] = bytes(4)
    (tmp_path / "good.mcap").write_bytes(octets)
    struct.pack_into("<Q", octets, index + 9 + 6, 77)
    (tmp_path / "bad.mcap").write_bytes(octets)

    assert check(tmp_path / "good.mcap").whole
    assert check(tmp_path / "bad.mcap").findings == (
        f"the message index at byte {index} does not agree with its chunk",
    )


def test_missing_readings_of_which_no_event_tells_are_found(record: Callable[..., Path]) -> None:
    readings = readings_of(20)
    kept = readings[[*range(8), *range(11, 20)]]
    path = record([(Batch(kept), estimates_of(kept))])

    result = check(path)

    assert result.findings == ("readings 8 to 10 are missing, and no event tells of it",)
    assert result.notes == ("3 readings lost in 1 places",)


def test_a_reading_without_its_estimate_is_found(record: Callable[..., Path]) -> None:
    readings = readings_of(20)
    path = record([(Batch(readings), estimates_of(readings[:-3]))])

    assert check(path).findings == ("it has 20 readings and 17 estimates",)


def test_no_byte_of_a_recording_can_be_wrong_without_a_finding(record: Callable[..., Path], tmp_path: Path) -> None:
    """Also where a length gets too large for any memory, and in the summary, which is read record by record."""
    readings = readings_of(20)
    good = record([(Batch(readings), estimates_of(readings))]).read_bytes()
    bad = tmp_path / "bad.mcap"
    for at in range(len(good)):
        if at % 3 == 0 or good[at : at + 8].endswith(bytes(4)):
            bad.write_bytes(good[:at] + bytes([good[at] ^ 0xFF]) + good[at + 1 :])
            try:
                assert check(bad).findings, at
            except RecordingError:
                continue


@pytest.mark.parametrize(
    ("opcode", "offset", "finding"),
    [
        (0x0B, 0, "statistics tell of message_count"),
        (0x0B, 8, "statistics tell of schema_count"),
        (0x0B, 10, "statistics tell of channel_count"),
        (0x0B, 14, "statistics tell of attachment_count"),
        (0x0B, 18, "statistics tell of metadata_count"),
        (0x0B, 22, "statistics tell of chunk_count"),
        (0x0B, 26, "statistics tell of message_start_time"),
        (0x0B, 34, "statistics tell of message_end_time"),
        (0x08, 0, "message_start_time"),
        (0x08, 16, "does not tell of the chunk|chunk_start_offset"),
        (0x08, -16, "compressed_size"),
        (0x08, -8, "uncompressed_size"),
        (0x04, -1, "channel at byte .* is not as at the beginning"),
        (0x03, 8, "schema at byte .* is not as at the beginning"),
        (0x0E, 1, "summary offset"),
        (0x0E, 9, "summary offset"),
    ],
)
def test_a_summary_that_is_wrong_with_a_right_checksum_is_found(
    opcode: int, offset: int, finding: str, record: Callable[..., Path], tmp_path: Path
) -> None:
    """As a program would leave it that changes a file: the checksum (MCAP specification, Footer) is made to fit."""
    readings = readings_of(20)
    octets = bytearray(record([(Batch(readings), estimates_of(readings))]).read_bytes())
    footer = len(octets) - 8 - 20 - 9
    summary_start = struct.unpack_from("<Q", octets, footer + 9)[0]
    at, body = next((at, body) for op, at, body in records_of(bytes(octets)) if op == opcode and at >= summary_start)
    octets[at + 9 + (offset if offset >= 0 else len(body) + offset)] ^= 1
    struct.pack_into("<I", octets, footer + 25, zlib.crc32(octets[summary_start : footer + 25]))
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(octets)

    assert re.search(finding, "; ".join(check(bad).findings))


def test_a_file_of_the_reference_writer_is_as_whole_as_ours_but_for_the_closing_note(
    record: Callable[..., Path], tmp_path: Path
) -> None:
    """It writes a summary offset of length 0 for each group that is empty, as attachments are here."""
    path = tmp_path / "other.mcap"
    with record([(Batch(readings_of(20)), estimates_of(readings_of(0)))], Description()).open("rb") as file:
        messages = [message for message in StreamReader(file).records if isinstance(message, Message)]
    with path.open("wb") as out:
        writer = Writer(out)
        writer.start()
        channel = writer.register_channel(
            "/dmm/raw", "protobuf", writer.register_schema("aemd.v1.Reading", "protobuf", SCHEMA_DATA)
        )
        for message in messages:
            writer.add_message(channel, message.log_time, message.data, message.publish_time, message.sequence)
        writer.finish()

    offsets = [body for opcode, _, body in records_of(path.read_bytes()) if opcode == 0x0E]
    assert any(body.endswith(bytes(8)) for body in offsets)
    assert check(path).findings == ("it has no closing note: the program that made it did not finish it",)


def test_bytes_behind_the_end_are_found_even_if_they_are_another_recording(
    record: Callable[..., Path], tmp_path: Path
) -> None:
    readings = readings_of(20)
    good = record([(Batch(readings), estimates_of(readings))]).read_bytes()
    (tmp_path / "two.mcap").write_bytes(good + good)

    assert check(tmp_path / "two.mcap").findings == (
        f"its end is at byte {len(good) - 8}, and bytes follow that belong to nothing",
    )


def test_rubbish_behind_the_end_is_told_of_as_that(record: Callable[..., Path], tmp_path: Path) -> None:
    readings = readings_of(20)
    good = record([(Batch(readings), estimates_of(readings))]).read_bytes()
    (tmp_path / "more.mcap").write_bytes(good + b"rubbish")

    assert check(tmp_path / "more.mcap").findings == (
        f"it ends at byte {len(good)}, and 7 bytes follow that belong to nothing; `aemd recover` cuts them off",
    )


def test_chunks_that_changed_places_are_told_of_as_that_and_not_as_a_loss_of_milliards(
    record: Callable[..., Path], tmp_path: Path
) -> None:
    """A message has the lower 32 bits of its number, so a step back of ten looks like one ahead of 2^32 - 10."""
    readings = readings_of(60)
    octets = record([(Batch(readings), estimates_of(readings))], chunk_bytes=2500).read_bytes()
    second, third, fourth = [at for opcode, at, _ in records_of(octets) if opcode == 0x06][1:4]
    swapped = octets[:second] + octets[third:fourth] + octets[second:third] + octets[fourth:]
    (tmp_path / "swapped.mcap").write_bytes(swapped)

    found = check(tmp_path / "swapped.mcap")

    told = "; ".join(found.findings)
    step = re.search(r"has reading (\d+) after reading (\d+)", told)
    assert step
    assert int(step[1]) <= int(step[2]) < 60
    assert "42949" not in told
    assert found.lost < 60
