"""An archive's replay that is interrupted, killed or short of room: what was made is kept, the rest follows."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from aemd.archive import replay_archive
from aemd.archive.places import Place
from aemd.errors import RecordingError
from tests.archive.made import readings_of, write, write_segments

FILES = 12
READINGS = 100_000  # of each file: some tenths of a second of work, so that the middle is not missed


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("archive")
    first = write(folder / "in" / "00.mcap", readings_of(READINGS))
    for number in range(1, FILES):
        os.link(first, first.with_name(f"{number:02}.mcap"))
    replay_archive(str(folder / "in"), str(folder / "whole"), jobs=2)
    return folder


def _made(out: Path) -> list[Path]:
    return list(out.glob("*.mcap"))


def _wait(condition: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + 60
    while not condition() and time.monotonic() < deadline:
        os.sched_yield()
    return condition()


def _begin(archive: Path, out: Path, jobs: int) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "aemd", "replay", str(archive / "in"), "-o", str(out), "--jobs", str(jobs)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize(
    ("number", "jobs", "code", "line"),
    [
        pytest.param(signal.SIGINT, 1, 130, "aemd: interrupted\n", id="ctrl-c"),
        pytest.param(signal.SIGTERM, 2, 143, "", id="terminated", marks=pytest.mark.slow),
    ],
)
def test_what_was_made_until_an_interruption_is_not_made_again(
    archive: Path, tmp_path: Path, number: signal.Signals, jobs: int, code: int, line: str
) -> None:
    out = tmp_path / "out"
    with _begin(archive, out, jobs) as process:
        assert _wait(lambda: len(_made(out)) >= 4)
        children = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(number)
        told, complaint = process.communicate(timeout=60)
    made = len(_made(out))

    assert (process.returncode, told, complaint) == (code, "", line)
    assert 4 <= made < FILES
    assert psutil.wait_procs(children, timeout=10)[1] == []
    assert not list(out.rglob(".aemd-scratch"))
    done = replay_archive(str(archive / "in"), str(out))
    assert done.failed == ()
    assert made - jobs <= done.unchanged <= made  # one a worker may have taken its name and not been noted
    assert done.replayed == FILES - done.unchanged
    for path in _made(archive / "whole"):
        assert (out / path.name).read_bytes() == path.read_bytes()


@pytest.mark.slow
def test_workers_end_with_the_process_that_started_them_however_it_ends(archive: Path, tmp_path: Path) -> None:
    with _begin(archive, tmp_path / "out", 2) as process:
        assert _wait(lambda: bool(_made(tmp_path / "out")))
        children = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        process.communicate(timeout=60)

    assert len(children) >= 2
    assert psutil.wait_procs(children, timeout=10)[1] == []


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_full_disk_is_one_line_and_leaves_whole_files(tmp_path: Path, small_disk: Path, jobs: int) -> None:
    for number in range(3):
        write_segments(tmp_path / "in" / str(number), readings_of(90_000, number), 4, session=str(number))
    whole, out = tmp_path / "whole", small_disk / "out"
    replay_archive(str(tmp_path / "in"), str(whole))

    with pytest.raises(RecordingError) as caught:
        replay_archive(str(tmp_path / "in"), str(out), jobs=jobs)

    made = list(out.rglob("*.mcap"))
    assert 0 < len(made) < 12
    assert str(caught.value) == (
        f"{out}: no space left; {len(made)} of 12 files are there and whole; "
        "make room, and run it again: it goes on from there"
    )
    assert not list(out.rglob(".aemd-scratch"))
    assert json.loads((out / "manifest.json").read_text())["files"].keys() == {
        str(path.relative_to(out)) for path in made
    }
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    done = replay_archive(str(tmp_path / "in"), str(out))
    assert (done.unchanged, done.replayed, done.failed) == (len(made), 12 - len(made), ())
    for path in whole.rglob("*.mcap"):
        assert (out / path.relative_to(whole)).read_bytes() == path.read_bytes()


def test_a_small_file_that_finds_no_room_is_a_line(small_disk: Path) -> None:
    with pytest.raises(RecordingError, match=r"manifest\.json: cannot be written: no space left on device$"):
        Place(str(small_disk / "manifest.json")).write_text("x" * 9_000_000)
