"""recover, check, compact; and what an acquisition does about what an earlier one has left."""

import json
from pathlib import Path

import numpy as np
import pytest

from aemd.block import Batch
from aemd.record.writer import Recorder
from tests.cli.asking import Run, refused
from tests.record.made import DESCRIPTION, estimates_of, readings_of, records_of


@pytest.fixture
def left(tmp_path: Path) -> Path:
    """What a crash has left: three chunks and half of a fourth."""
    readings = readings_of(80)
    recorder = Recorder(tmp_path / "left.mcap", DESCRIPTION, chunk_bytes=2700)
    recorder.write(Batch(readings), estimates_of(readings))
    path = recorder.close()
    octets = path.read_bytes()
    path.unlink()
    fourth = [at for opcode, at, _ in records_of(octets) if opcode == 0x06][3]
    active = tmp_path / "left.mcap.active"
    active.write_bytes(octets[: fourth + 100])
    return active


def test_what_a_crash_has_left_is_recovered_checked_and_replayed(aemd: Run, left: Path) -> None:
    path = left.with_suffix("")
    assert aemd("check", left)[0] == 1

    code, out, _ = aemd("recover", left, "--json")

    found = json.loads(out)
    assert code == 0
    assert (found["file"], found["readings"], found["dropped_bytes"]) == (str(path), 60, 100)
    assert not left.exists()
    assert aemd("check", path) == (0, f"{path}: whole: 60 readings, 60 estimates, 0 lost\n", "")
    assert json.loads(aemd("info", path, "--json")[1])["closed"] == "recovered"


def test_a_damaged_file_fails_the_check_with_a_line_that_says_where_and_the_others_are_checked(
    aemd: Run, recording: Path, tmp_path: Path
) -> None:
    bad = tmp_path / "bad.mcap"
    octets = bytearray(recording.read_bytes())
    at, body = next((at, body) for opcode, at, body in records_of(bytes(octets)) if opcode == 0x06)
    octets[at + 9 + len(body) // 2] ^= 1
    bad.write_bytes(octets)

    code, out, err = aemd("check", bad, recording, tmp_path / "none.mcap")

    lines = out.splitlines()
    assert (code, err) == (1, "")
    assert any(line.startswith(f"{bad}: the chunk at byte {at} ") for line in lines)
    assert f"{recording}: whole: 500 readings, 500 estimates, 0 lost" in lines
    assert any(line.startswith(f"{tmp_path / 'none.mcap'}: cannot be read: no such file") for line in lines)
    results = json.loads(aemd("check", bad, recording, "--json")[1])
    assert [result["whole"] for result in results] == [False, True]


@pytest.mark.parametrize("seed", range(8))
def test_any_changed_byte_behind_the_descriptions_is_found(
    aemd: Run, recording: Path, tmp_path: Path, seed: int
) -> None:
    octets = bytearray(recording.read_bytes())
    first = next(at for opcode, at, _ in records_of(bytes(octets)) if opcode == 0x06)
    rng = np.random.default_rng(seed)
    for _ in range(25):
        changed = bytearray(octets)
        changed[rng.integers(first, len(octets))] ^= rng.integers(1, 256)
        bad = tmp_path / "bad.mcap"
        bad.write_bytes(changed)

        code, out, _ = aemd("check", bad, "--json")

        assert (code, json.loads(out)[0]["whole"]) == (1, False)


def test_a_recording_is_compacted_and_still_replays_to_the_bit(aemd: Run, recording: Path, tmp_path: Path) -> None:
    code, out, _ = aemd("compact", recording, "-o", tmp_path / "c.mcap", "--json")

    found = json.loads(out)
    assert (code, found["messages"], found["chunks"]) == (0, 1000 + found["messages"] % 1000, 1)
    assert aemd("check", tmp_path / "c.mcap")[0] == 0
    assert aemd("replay", tmp_path / "c.mcap", "--check")[0] == 0


def test_an_acquisition_recovers_what_lies_in_its_folder_and_is_not_stopped_by_what_it_cannot(
    aemd: Run, quick: Path, left: Path
) -> None:
    (left.parent / "empty.mcap.active").write_bytes(b"")

    code, out, err = aemd("acquire", quick, "--seconds", 0.5, "--out", left.parent, "--json")

    told = err.splitlines()
    assert code == 0
    assert json.loads(out)["readings"] == 250
    assert sum(line.startswith(f"recovered={left.with_suffix('')} readings=60") for line in told) == 1
    assert sum(line.startswith("not recovered: ") and "empty.mcap.active" in line for line in told) == 1
    assert left.with_suffix("").exists()


@pytest.mark.parametrize("content", [None, b"", b"time,value\n"])
def test_what_is_no_recording_is_not_recovered(aemd: Run, tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "x.mcap.active"
    if content is not None:
        path.write_bytes(content)

    code, out, err = aemd("recover", path)

    assert "x.mcap.active" in refused(code, err, out, 1)
