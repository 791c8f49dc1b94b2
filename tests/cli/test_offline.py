"""Recordings replayed, inspected and drawn; and files that are none."""

import json
import re
import zlib
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from tests.cli.asking import Run, refused


def test_a_replay_gives_the_same_bits_and_says_so(aemd: Run, recording: Path) -> None:
    code, out, _ = aemd("replay", recording, "--check", "--json")

    found = json.loads(out)
    assert code == 0
    assert found["identical"] is True
    assert found["readings"] == 500


def test_a_replay_that_differs_says_where_and_fails(aemd: Run, recording: Path, tmp_path: Path) -> None:
    """The recorded estimator's name is changed on the way to another file: its estimates no longer come out again."""
    other = tmp_path / "other.mcap"
    aemd("replay", recording, "--estimator", "kalman", "--out", other)
    forged = tmp_path / "forged.mcap"
    name = b"\x04\x00\x00\x00name\x06\x00\x00\x00kalman"
    option = b"\x09\x00\x00\x00sigma_R_V\x07\x00\x00\x000.00099"
    content = other.read_bytes()
    assert name in content
    assert option in content
    forged.write_bytes(checksummed(content.replace(option, option.replace(b"0.00099", b"0.00098"))))

    code, out, _ = aemd("replay", forged, "--check", "--json")

    found = json.loads(out)
    assert code == 1
    assert found["identical"] is False
    assert re.match(r"reading \d+: \w+ was .*, is ", found["difference"])


def checksummed(content: bytes) -> bytes:
    """Return a changed recording with its checksum of the data section set right, found by trying (MCAP: DataEnd)."""
    at = content.rindex(b"\x0f" + (4).to_bytes(8, "little"))
    return content[: at + 9] + zlib.crc32(content[:at]).to_bytes(4, "little") + content[at + 13 :]


def test_a_replay_with_another_estimator_writes_the_same_readings(aemd: Run, recording: Path, tmp_path: Path) -> None:
    out_file = tmp_path / "kalman.mcap"

    code, out, _ = aemd("replay", recording, "--estimator", "kalman", "--out", out_file, "--json")

    assert code == 0
    assert json.loads(out)["identical"] is None
    tables = []
    for path in (recording, out_file):
        table = tmp_path / f"{path.stem}.csv"
        aemd("export", path, "-o", table)
        tables.append(np.genfromtxt(table, delimiter=",", names=True))
    assert np.array_equal(tables[0]["value_V"], tables[1]["value_V"])
    assert not np.array_equal(tables[0]["estimate_V"], tables[1]["estimate_V"])
    assert aemd("replay", out_file, "--check")[0] == 0


def test_info_counts_what_the_acquisition_counted(aemd: Run, recording: Path) -> None:
    found = json.loads(aemd("info", recording, "--json")[1])

    assert (found["readings"], found["lost"], found["gaps"]) == (500, 0, 0)
    assert found["t1"] - found["t0"] == pytest.approx(499 * 0.002, abs=0.01)
    assert found["topics"]["/dmm/raw"] == found["topics"]["/dmm/filtered"] == 500


def test_a_picture_is_drawn_of_a_recording(aemd: Run, recording: Path, tmp_path: Path) -> None:
    picture = tmp_path / "picture.png"

    assert aemd("replay", recording, "--plot", picture)[0] == 0

    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        (b"0.00099", b"x.00099", "metadata aemd.estimator: sigma_R_V = 'x.00099'"),
        (b"\x04\x00\x00\x00name", b"\x04\x00\x00\x00nome", "metadata aemd.estimator: name: missing"),
    ],
)
def test_a_damaged_description_of_the_estimator_is_refused(
    before: bytes, after: bytes, says: str, aemd: Run, recording: Path, tmp_path: Path
) -> None:
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(recording.read_bytes().replace(before, after))

    code, out, err = aemd("replay", damaged)

    assert says in refused(code, err, out, 1)


def test_a_check_finds_damage_outside_the_chunks_too(aemd: Run, recording: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(recording.read_bytes().replace(b"readings\x03\x00\x00\x00500", b"readings\x03\x00\x00\x00900"))

    for words, says in ((["replay", damaged, "--check"], "checksum"), (["info", damaged], "it tells of 900 readings")):
        code, out, err = aemd(*words)
        assert says in refused(code, err, out, 1)


def test_a_table_of_one_reading_cannot_be_estimated(aemd: Run, tmp_path: Path) -> None:
    table, path = tmp_path / "log.csv", tmp_path / "log.mcap"
    table.write_text("time,value\n0.0,1.0\n")
    assert aemd("import", table, "-o", path)[0] == 0

    code, out, err = aemd("replay", path)

    assert str(path) in refused(code, err, out, 1)


def test_enormous_values_are_drawn_and_summed_without_complaint(aemd: Run, tmp_path: Path) -> None:
    table, path = tmp_path / "log.csv", tmp_path / "log.mcap"
    table.write_text("time,value\n0,1e308\n1,-1e308\n2,1e308\n")
    aemd("import", table, "-o", path)

    code, out, err = aemd("replay", path, "--plot", tmp_path / "p.png", "--json")

    assert code == 0, err
    assert json.loads(out)["raw_variance_V2"] is None


def test_what_was_flushed_of_an_unfinished_file_can_be_replayed_and_exported(
    aemd: Run, recording: Path, tmp_path: Path
) -> None:
    active = tmp_path / "cut.mcap.active"
    content = recording.read_bytes()
    active.write_bytes(content[: len(content) - 3000])

    assert json.loads(aemd("info", active, "--json")[1])["finalised"] is False
    assert aemd("replay", active)[0] == 0
    assert aemd("export", active, "-o", tmp_path / "cut.csv")[0] == 0


def foreign(path: Path) -> None:
    """An MCAP of somebody else: valid, with other topics."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Pose", "jsonschema", b"{}")
        channel = writer.register_channel("/robot/pose", "json", schema)
        writer.add_message(channel, log_time=1, publish_time=1, data=b"{}")
        writer.finish()


@pytest.mark.parametrize("command", ["replay", "info", "export"])
@pytest.mark.parametrize("kind", ["missing", "empty", "text", "foreign", "truncated", "damaged", "a folder"])
def test_a_file_that_is_no_sound_recording_is_refused(
    kind: str, command: str, aemd: Run, recording: Path, tmp_path: Path
) -> None:
    path = tmp_path / "file.mcap"
    content = recording.read_bytes()
    if kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("time,value\n0,1\n")
    elif kind == "foreign":
        foreign(path)
    elif kind == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif kind == "damaged":
        middle = len(content) // 2
        path.write_bytes(
            content[:middle] + bytes(byte ^ 0xFF for byte in content[middle : middle + 64]) + content[middle + 64 :]
        )
    elif kind == "a folder":
        path.mkdir()

    words = ["-o", tmp_path / "t.csv"] if command == "export" else []
    code, out, err = aemd(command, path, *words)

    if (
        kind in {"truncated", "damaged"} and command == "info"
    ):  # it tells what the file says of itself, as far as it goes
        assert code == 0
    else:
        assert str(path) in refused(code, err, out, 1)


def test_what_exists_is_never_overwritten(aemd: Run, recording: Path) -> None:
    before = recording.read_bytes()

    code, out, err = aemd("replay", recording, "--out", recording)

    assert "exists" in refused(code, err, out, 1)
    assert recording.read_bytes() == before


def test_an_unknown_estimator_is_a_usage_error_that_lists_those_there_are(aemd: Run, recording: Path) -> None:
    code, out, err = aemd("replay", recording, "--estimator", "aen")

    assert "did you mean 'aem'?" in refused(code, err, out, 2)


def test_a_check_without_recorded_estimates_is_a_usage_error(aemd: Run, tmp_path: Path) -> None:
    table, path = tmp_path / "log.csv", tmp_path / "log.mcap"
    table.write_text("time,value\n0.0,1.0\n0.1,2.0\n0.2,3.0\n")
    aemd("import", table, "-o", path)

    code, out, err = aemd("replay", path, "--check")

    assert "no estimates" in refused(code, err, out, 2)
