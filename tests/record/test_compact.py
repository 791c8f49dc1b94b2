"""A compacted recording holds the same messages in the same order, in fewer bytes."""

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.records import Message
from mcap.stream_reader import StreamReader

from aemd.block import Batch
from aemd.errors import RecordingError
from aemd.record.check import check
from aemd.record.compact import compact
from aemd.record.reader import Recording
from tests.record.made import DESCRIPTION, estimates_of, eventful_batch, readings_of, records_of

WITH_WITNESS = replace(DESCRIPTION, witnesses={"temperature": "degC"})


def _messages(path: Path) -> list[Message]:
    with path.open("rb") as file:
        return [found for found in StreamReader(file, validate_crcs=True).records if isinstance(found, Message)]


def test_small_chunks_become_large_ones_with_the_same_messages(record: Callable[..., Path], tmp_path: Path) -> None:
    readings = readings_of(5000)
    path = record([(Batch(readings), estimates_of(readings))], chunk_bytes=1500)

    found = compact(path, tmp_path / "c.mcap", chunk_bytes=100_000)

    assert _messages(tmp_path / "c.mcap") == _messages(path)
    assert found.messages == 10_000
    assert found.chunks_before > 300
    assert found.chunks == -(-5000 * (45 + 91) // 100_000)
    assert found.bytes == (tmp_path / "c.mcap").stat().st_size < 0.9 * path.stat().st_size
    result = check(tmp_path / "c.mcap")
    assert result.whole, result.findings
    chunks = [body for opcode, _, body in records_of((tmp_path / "c.mcap").read_bytes()) if opcode == 0x06]
    assert all(struct.unpack_from("<Q", body, 16)[0] >= 100_000 for body in chunks[:-1])


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_all_that_describes_the_recording_comes_over(
    record: Callable[..., Path], tmp_path: Path, compression: str
) -> None:
    path = record([eventful_batch()], WITH_WITNESS, chunk_bytes=200)

    compact(path, tmp_path / "c.mcap", compression=compression)  # type: ignore[arg-type]

    with Recording(path) as before, Recording(tmp_path / "c.mcap") as after:
        assert after.description == before.description
        assert after.metadata == before.metadata
        assert after.statistics() == before.statistics()
        assert after.attachment("config.toml") == before.attachment("config.toml")
    opcodes = [opcode for opcode, _, _ in records_of((tmp_path / "c.mcap").read_bytes())]
    assert opcodes.index(0x09) > opcodes.index(
        0x06
    )  # an attachment in front makes `mcap recover` leave out compression


def test_a_damaged_recording_is_not_compacted_and_leaves_nothing(record: Callable[..., Path], tmp_path: Path) -> None:
    octets = bytearray(record([eventful_batch()], WITH_WITNESS).read_bytes())
    at = next(at for opcode, at, _ in records_of(bytes(octets)) if opcode == 0x06)
    octets[at + 80] ^= 1
    (tmp_path / "bad.mcap").write_bytes(octets)

    with pytest.raises(RecordingError, match="is damaged"):
        compact(tmp_path / "bad.mcap", tmp_path / "c.mcap")
    assert not list(tmp_path.glob("c.mcap*"))
    with pytest.raises(RecordingError, match=r"r\.mcap: exists: a recording is never overwritten"):
        compact(tmp_path / "r.mcap", tmp_path / "r.mcap")


def test_a_recording_that_still_grows_is_not_compacted(record: Callable[..., Path], tmp_path: Path) -> None:
    octets = record([eventful_batch()], WITH_WITNESS, chunk_bytes=200).read_bytes()
    data_end = next(at for opcode, at, _ in records_of(octets) if opcode == 0x0F)
    (tmp_path / "r.mcap.active").write_bytes(octets[:data_end])

    with pytest.raises(RecordingError, match=r"is unfinished: .* `aemd recover`"):
        compact(tmp_path / "r.mcap.active", tmp_path / "c.mcap")
    assert not list(tmp_path.glob("c.mcap*"))
