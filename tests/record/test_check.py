"""What a check holds against each other, one by one."""

import struct
from collections.abc import Callable
from pathlib import Path

from aemd.block import Batch
from aemd.errors import RecordingError
from aemd.record.check import check
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

    assert check(path).findings == ("readings 8 to 10 are missing, and no event tells of it",)


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
