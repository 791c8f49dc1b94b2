"""An archive replays as its files would one by one, and a run of files as one long recording."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from aemd.archive import ArchiveSummary, replay_archive
from aemd.archive.places import Place
from aemd.config import EstimatorChoice
from aemd.errors import RecordingError
from aemd.estimate.aem import AemOptions
from aemd.estimate.imm import ImmOptions
from aemd.estimate.registry import ESTIMATORS
from aemd.record.source import Selection
from aemd.replay import replay
from tests.archive.made import acquire, estimates_in, readings_of, write, write_segments


def _model(path: Path, text: str) -> Path:
    path.write_text(f"[estimator]\n{text}\n")
    return path


@pytest.mark.parametrize(
    "estimator",
    [*(f'name = "{name}"' for name in ESTIMATORS), 'name = "imm"\nlag = 20', 'name = "aem"\ne_step = "smoothed"'],
)
def test_a_run_of_files_is_one_long_replay_to_the_bit(tmp_path: Path, estimator: str) -> None:
    readings = readings_of(1000)
    write_segments(tmp_path / "in", readings, 5)
    model = _model(tmp_path / "m.toml", estimator)
    replay(write(tmp_path / "long.mcap", readings), model=model, out=tmp_path / "once.mcap")

    done = replay_archive(f"{tmp_path}/in/*.mcap", str(tmp_path / "out"), model=model)

    expected = estimates_in([tmp_path / "once.mcap"])
    found = estimates_in(sorted((tmp_path / "out").glob("*.mcap")))
    assert (done.files, done.runs, done.replayed, done.failed) == (5, 1, 5, ())
    assert len(expected) == 993
    assert found.tobytes() == expected.tobytes()


def _archive(folder: Path) -> ArchiveSummary:
    return replay_archive(f"{folder}/in/**/*.mcap", str(folder / "out"))


def _bytes_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.mcap")}


def test_processes_give_the_bytes_that_one_gives(tmp_path: Path) -> None:
    for number in range(3):
        write_segments(tmp_path / "in" / f"day{number}", readings_of(400, number), 3, session=f"s{number}")
    write(tmp_path / "in" / "alone.mcap", readings_of(300, 9))

    one = replay_archive(f"{tmp_path}/in/**/*.mcap", str(tmp_path / "one"))
    two = replay_archive(f"{tmp_path}/in/**/*.mcap", str(tmp_path / "two"), jobs=2)

    assert (one.files, one.runs, two.replayed) == (10, 4, 10)
    assert sorted(_bytes_of(tmp_path / "one")) == sorted(_bytes_of(tmp_path / "in"))
    assert _bytes_of(tmp_path / "one") == _bytes_of(tmp_path / "two")
    assert not list(tmp_path.rglob(".aemd-scratch"))


def test_a_rerun_makes_only_what_is_missing_or_changed_and_what_follows_it(tmp_path: Path) -> None:
    parts = write_segments(tmp_path / "in", readings_of(800), 4)
    write(tmp_path / "in" / "alone.mcap", readings_of(300, 9))
    _archive(tmp_path)
    before = _bytes_of(tmp_path / "out")

    again = _archive(tmp_path)
    (tmp_path / "out" / parts[1].name).unlink()
    missing = _archive(tmp_path)
    os.utime(parts[0], ns=(1, 1))  # touched, and the same
    touched = _archive(tmp_path)
    unchanged = _bytes_of(tmp_path / "out")
    parts[2].unlink()
    changed = readings_of(800)[400 - 7 : 593].copy()
    changed["value_V"] += 1e-3
    write(parts[2], changed, session="s", first_index=int(changed["index"][0]))
    followed = _archive(tmp_path)

    assert (again.replayed, again.unchanged) == (0, 5)
    assert (missing.replayed, missing.unchanged) == (1, 4)
    assert (touched.replayed, touched.unchanged) == (0, 5)
    assert unchanged == before
    assert (followed.replayed, followed.unchanged) == (2, 3)


def test_after_a_kill_the_rest_is_made_and_what_was_made_is_no_stranger(tmp_path: Path) -> None:
    for number in range(12):
        write(tmp_path / "in" / f"{number:02}.mcap", readings_of(20_000, seed=number))
    out = tmp_path / "out"
    command = [sys.executable, "-m", "aemd", "replay", str(tmp_path / "in"), "-o", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as killed:
        while not (made := list(out.glob("*.mcap"))) and killed.poll() is None:
            os.sched_yield()
        killed.kill()
    assert made

    done = replay_archive(str(tmp_path / "in"), str(out))

    assert (done.replayed + done.unchanged, done.failed) == (12, ())
    assert set(json.loads((out / "manifest.json").read_text())) == {"files"}
    (out / "00.mcap").unlink()
    replay_archive(str(tmp_path / "in"), str(tmp_path / "whole"))
    replay_archive(str(tmp_path / "in"), str(out))
    for path in sorted((tmp_path / "whole").glob("*.mcap")):
        assert path.read_bytes() == (out / path.name).read_bytes()


@pytest.mark.parametrize("estimator", ["aem", "imm"])
@pytest.mark.parametrize("model", [None, 'name = "rem"', 'name = "imm"\nlag = 20'])
def test_each_result_of_a_rotated_recording_replays_alone_to_the_bit(
    tmp_path: Path, estimator: str, model: str | None
) -> None:
    parts = acquire(tmp_path / "in", readings_of(1000), estimator)
    path = None if model is None else _model(tmp_path / "m.toml", model)

    done = replay_archive(str(tmp_path / "in"), str(tmp_path / "out"), model=path)

    assert (len(parts), done.runs, done.replayed, done.failed) == (4, 1, 4, ())
    for part in parts:
        again = replay(tmp_path / "out" / part.name, check=True)
        assert (again.difference, again.identical) == (None, True), part.name


@pytest.mark.parametrize("choice", [EstimatorChoice("aem", AemOptions()), EstimatorChoice("imm", ImmOptions(lag=20))])
def test_an_archive_that_begins_in_the_midst_of_a_session_gives_the_recorded_estimates(
    tmp_path: Path, choice: EstimatorChoice
) -> None:
    parts = acquire(tmp_path / "in", readings_of(1000), choice)
    recorded = estimates_in(parts[2:])
    for part in parts[:2]:
        part.unlink()

    done = replay_archive(str(tmp_path / "in"), str(tmp_path / "out"))

    assert (done.runs, done.replayed, done.failed) == (1, 2, ())
    assert estimates_in(sorted((tmp_path / "out").glob("*.mcap"))).tobytes() == recorded.tobytes()
    assert all(replay(path, check=True).identical for path in (tmp_path / "out").glob("*.mcap"))


def test_results_of_an_earlier_form_are_made_again(tmp_path: Path) -> None:
    write_segments(tmp_path / "in", readings_of(400), 2)
    _archive(tmp_path)
    manifest = tmp_path / "out" / "manifest.json"
    told = json.loads(manifest.read_text())
    for entry in told["files"].values():
        del entry["form"]  # the first did not tell
    manifest.write_text(json.dumps(told))

    done = [_archive(tmp_path) for _ in range(2)]

    assert [(item.replayed, item.unchanged, item.failed) for item in done] == [(2, 0, ()), (0, 2, ())]


@pytest.mark.parametrize(("name", "options"), [("kf", {}), ("rem", {"newer": 1})])
def test_an_estimator_that_this_version_lacks_needs_another_in_its_place(
    tmp_path: Path, name: str, options: dict[str, int]
) -> None:
    path = write(tmp_path / "in" / "a.mcap", readings_of(200), estimator=name, **options)
    plain = write(tmp_path / "plain.mcap", readings_of(200))
    model = _model(tmp_path / "m.toml", 'name = "rem"')
    replay(plain, estimator="rem", out=tmp_path / "expected.mcap")

    for number, asked in enumerate(({"estimator": "rem"}, {"model": model})):
        out = tmp_path / f"{number}"
        replay(path, out=tmp_path / f"{number}.mcap", **asked)
        assert replay_archive(str(tmp_path / "in"), str(out), **asked).failed == ()
        for made in (tmp_path / f"{number}.mcap", out / "a.mcap"):
            assert estimates_in([made]).tobytes() == estimates_in([tmp_path / "expected.mcap"]).tobytes()
        with pytest.raises(RecordingError, match=r"a\.mcap: .* name another by --estimator$"):
            replay(path, check=True, **asked)
    with pytest.raises(RecordingError, match=r"a\.mcap: .* name another by --estimator$"):
        replay(path)
    assert "name another by --estimator" in replay_archive(str(tmp_path / "in"), str(tmp_path / "none")).failed[0]


def test_another_topic_is_another_result(tmp_path: Path) -> None:
    write(tmp_path / "in" / "a.mcap", readings_of(300), estimator="kalman")
    (tmp_path / "two").mkdir()
    replay(tmp_path / "in" / "a.mcap", out=tmp_path / "two" / "a.mcap")
    source, out = str(tmp_path / "two"), str(tmp_path / "out")

    for topic in ("/dmm/raw", "/dmm/filtered"):
        done = replay_archive(source, out, estimator="kalman", selection=Selection(topic=topic, field="value"))
        assert (done.replayed, done.failed) == (1, ())
    again = replay_archive(source, out, estimator="kalman", selection=Selection(topic="/dmm/filtered", field="value"))

    assert again.unchanged == 1


def test_a_file_that_is_added_to_a_run_goes_on_from_its_end(tmp_path: Path) -> None:
    readings = readings_of(800)
    parts = write_segments(tmp_path / "in", readings, 4)
    later = tmp_path / "later"
    parts[3].rename(later)
    _archive(tmp_path)
    later.rename(parts[3])

    added = _archive(tmp_path)
    replay(write(tmp_path / "long.mcap", readings), out=tmp_path / "once.mcap")

    # The one that was the last is no longer: what an estimator holds back was due there, and is not now.
    assert (added.replayed, added.unchanged) == (2, 2)
    found = estimates_in(sorted((tmp_path / "out").glob("*.mcap")))
    assert found.tobytes() == estimates_in([tmp_path / "once.mcap"]).tobytes()


def test_a_damaged_file_is_told_of_and_the_rest_is_finished_as_after_a_loss(tmp_path: Path) -> None:
    readings = readings_of(800)
    parts = write_segments(tmp_path / "in", readings, 4)
    octets = bytearray(parts[1].read_bytes())
    octets[octets.index(b"\x28\xb5\x2f\xfd") + 60] ^= 1  # in the first zstd frame
    parts[1].write_bytes(octets)
    lost = np.concatenate([readings[:199], readings[397:]])

    done = _archive(tmp_path)
    replay(write(tmp_path / "long.mcap", lost), out=tmp_path / "once.mcap")

    assert (done.replayed, len(done.failed)) == (3, 1)
    assert "s-001.mcap: is damaged: its chunk at byte" in done.failed[0]
    assert not (tmp_path / "out" / parts[1].name).exists()
    found = estimates_in(sorted((tmp_path / "out").glob("*.mcap")))
    assert found.tobytes() == estimates_in([tmp_path / "once.mcap"]).tobytes()


def test_copies_of_a_recording_are_runs_of_their_own(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write(tmp_path / "in" / f"{name}.mcap", readings_of(200), session="same")

    done = _archive(tmp_path)

    assert (done.files, done.runs) == (2, 2)
    made = _bytes_of(tmp_path / "out")
    assert made["a.mcap"] == made["b.mcap"]


def test_what_is_no_result_of_the_archive_is_never_written_over(tmp_path: Path) -> None:
    write(tmp_path / "in" / "a.mcap", readings_of(200))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a.mcap").write_text("mine")

    done = _archive(tmp_path)

    assert done.failed == (f"{tmp_path}/out/a.mcap: exists, and is no result of this archive; move it away",)
    assert (tmp_path / "out" / "a.mcap").read_text() == "mine"


def test_results_in_the_midst_of_their_archive_are_not_taken_for_a_part_of_it(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", readings_of(200))

    done = [replay_archive(str(tmp_path), str(tmp_path / "out")) for _ in range(2)]

    assert [(item.files, item.replayed) for item in done] == [(1, 1), (1, 0)]


@pytest.mark.parametrize(
    ("pattern", "out"),
    [
        ("file://{}/**/*.mcap", "{}/out"),
        ("local://{}/**/*.mcap", "{}/out"),
        ("{}/**/*.mcap", "file://{}/out"),
        ("file://{}/**/*.mcap", "local://{}/out"),
        ("{}/**/*.mcap", "{}/../link"),
        ("file://{}/**/*.mcap", "{}/../link"),
        ("memory://{}/**/*.mcap", "memory:/{}/out"),
    ],
)
def test_results_are_known_however_their_folder_is_named(tmp_path: Path, pattern: str, out: str) -> None:
    fsspec = pytest.importorskip("fsspec")
    archive = tmp_path / "in"
    made = write(archive / "a.mcap", readings_of(200))
    (archive / "out").mkdir()
    (tmp_path / "link").symlink_to(archive / "out")
    if pattern.startswith("memory"):
        system = fsspec.filesystem("memory")
        system.makedirs(str(archive), exist_ok=True)
        system.put_file(str(made), str(made))

    done = [replay_archive(pattern.format(archive), out.format(archive)) for _ in range(2)]

    assert [(item.files, item.replayed, item.failed) for item in done] == [(1, 1, ()), (1, 0, ())]


def test_a_source_that_is_a_link_to_a_result_is_a_source(tmp_path: Path) -> None:
    write(tmp_path / "out" / "kept" / "b.mcap", readings_of(200))
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.mcap").symlink_to(tmp_path / "out" / "kept" / "b.mcap")

    assert _archive(tmp_path).files == 1


def test_the_manifest_tells_sources_results_and_their_checksums(tmp_path: Path) -> None:
    source = write(tmp_path / "in" / "day" / "a.mcap", readings_of(200))

    replay_archive(f"{tmp_path}/in/**/*.mcap", str(tmp_path / "out"), estimator="kalman")

    told = json.loads((tmp_path / "out" / "manifest.json").read_text())["files"]["day/a.mcap"]
    assert told["source_sha256"] == Place(str(source)).checksum()
    assert told["out_sha256"] == Place(str(tmp_path / "out" / "day" / "a.mcap")).checksum()
    assert (told["readings"], told["asked"]) == (193, {"asked": "kalman"})


@pytest.mark.parametrize("scheme", ["memory", "file"])
def test_files_behind_a_scheme_replay_to_the_same_bytes(tmp_path: Path, scheme: str) -> None:
    fsspec = pytest.importorskip("fsspec")
    parts = write_segments(tmp_path / "in", readings_of(400), 2)
    _archive(tmp_path)
    system, root = fsspec.url_to_fs(f"{scheme}://{tmp_path}/far")
    for part in parts:
        system.makedirs(f"{root}/in/day", exist_ok=True)
        system.put_file(str(part), f"{root}/in/day/{part.name}")

    url = f"{scheme}://{tmp_path}/far"
    done = [replay_archive(f"{url}/in/**/*.mcap", f"{url}/out") for _ in range(2)]

    assert [(item.replayed, item.unchanged, item.failed) for item in done] == [(2, 0, ()), (0, 2, ())]
    for part in parts:
        assert system.cat_file(f"{root}/out/day/{part.name}") == (tmp_path / "out" / part.name).read_bytes()
