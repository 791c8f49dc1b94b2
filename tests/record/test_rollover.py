"""One acquisition in several files: nothing is lost between them, each stands alone, and a full disk is no end."""

import errno
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aemd.block import ESTIMATE, READING, Batch, Block, Estimates
from aemd.errors import RecordingError
from aemd.estimate.registry import make_estimator
from aemd.estimate.state import copy_state, write_state
from aemd.record.background import Background
from aemd.record.check import check
from aemd.record.description import Description, write_parameters
from aemd.record.growing import GrowingFile
from aemd.record.reader import Recording
from aemd.record.rollover import Rollover, Segment
from aemd.record.writer import Recorder
from aemd.replay import replay
from tests.record.made import STEP_NS, readings_of

INTERVAL_S = STEP_NS * 1e-9
NOON_NS = 1_700_049_600_000_000_000
"""2023-11-15 12:00 UTC."""


class Run:
    """An acquisition without an instrument: readings through an estimator into a rollover, the clock ours to move."""

    def __init__(self, folder: Path, estimator: str = "aem", **options: object) -> None:
        self.folder, self.now_ns, self.free_bytes = folder, 0, 10**12
        self.lines: list[str] = []
        parameters = {"lag": 9} if estimator == "imm" else {}
        self.estimator = make_estimator(estimator, parameters, INTERVAL_S)
        self.description = Description(
            interval_s=INTERVAL_S,
            session={"id": "1"},
            estimator=write_parameters(estimator, parameters),
            config_toml="# none\n",
        )
        self.files = 0
        self.rollover = Rollover(
            self._open, tell=self.lines.append, clock=lambda: self.now_ns, free=lambda _: self.free_bytes, **options
        )  # type: ignore[arg-type]
        self.estimates: list[Estimates] = []

    def _open(self, segment: Segment) -> Recorder:
        path = self.folder / f"{self.files + 1:03d}.mcap"
        told = {"first_index": segment.first_index, "segment": segment.as_text(), "state": write_state(segment.state)}
        recorder = Recorder(
            path, replace(self.description, **told), flush_interval_s=1.0, clock=lambda: self.now_ns, keep_room=True
        )
        self.files += 1
        return recorder

    def push(self, block: Block) -> None:
        if not self.rollover.is_recording:
            self.rollover._join()  # the file before is finished in real time, which ours does not wait for
        estimates = self.estimator.push(block)
        wanted = self.rollover.wants_state
        self.rollover.write(Batch(block), estimates)
        self.estimates.append(estimates)
        if wanted:
            self.rollover.take_state(copy_state(self.estimator))

    def close(self) -> list[Path]:
        rest = self.estimator.flush()
        self.rollover.write(Batch(np.empty(0, READING)), rest)
        self.estimates.append(rest)
        self.rollover.close("stop")
        return sorted(self.folder.glob("*.mcap"))


def _content(paths: list[Path]) -> tuple[Block, Estimates]:
    readings, estimates = [np.empty(0, READING)], [np.empty(0, ESTIMATE)]
    for path in paths:
        with Recording(path) as recording:
            recording.verify()
            for batch, made in recording.batches_with_estimates():
                readings.append(batch.readings)
                estimates.append(made)
        result = check(path)
        assert result.whole, result.findings
    return np.concatenate(readings), np.concatenate(estimates)


@pytest.mark.parametrize("estimator", ["aem", "imm", "filterpy"])
def test_by_size_no_reading_is_lost_and_each_file_replays_alone_to_the_bit(tmp_path: Path, estimator: str) -> None:
    readings = readings_of(4000)
    run = Run(tmp_path, estimator, rotate_bytes=1 << 16)
    for at in range(0, 4000, 7):
        run.now_ns = at * STEP_NS
        run.push(readings[at : at + 7])
    paths = run.close()

    read, estimates = _content(paths)
    assert len(paths) > 1  # how many depends on when the disk has finished the one before
    assert read.tobytes() == readings.tobytes()
    assert estimates.tobytes() == np.concatenate(run.estimates).tobytes()
    for path in paths:
        assert replay(path, check=True).identical is True
    for number, path in enumerate(paths, start=1):
        with Recording(path) as recording:
            segment, close = recording.metadata["aemd.segment"], recording.metadata["aemd.close"]
            assert recording.description.session == {"id": "1"}
            assert recording.attachment("config.toml") == b"# none\n"
        assert segment["number"] == str(number)
        assert segment.get("previous", "") == (paths[number - 2].name if number > 1 else "")
        assert close["reason"] == ("rotate" if number < len(paths) else "stop")
        assert (close["lost"], close["not_written"]) == ("0", "0")


def test_by_time_the_cut_is_at_the_first_reading_behind_the_boundary(tmp_path: Path) -> None:
    readings = readings_of(900)
    readings["t_ns"] += NOON_NS - int(readings["t_ns"][450]) + 1000  # the 450th comes a microsecond after noon
    run = Run(tmp_path, rotate_s=3600.0)
    for at in range(900):
        run.now_ns = at * STEP_NS
        run.push(readings[at : at + 1])
    paths = run.close()

    read, _ = _content(paths)
    assert read.tobytes() == readings.tobytes()
    with Recording(paths[1]) as recording:
        assert recording.description.first_index == 450
    assert len(paths) == 2
    assert [replay(path, check=True).identical for path in paths] == [True, True]


def test_a_gap_of_the_instrument_over_the_boundary_is_counted_once(tmp_path: Path) -> None:
    readings = readings_of(900)
    readings["t_ns"] += NOON_NS - int(readings["t_ns"][450])
    readings = np.delete(readings, slice(440, 460))
    run = Run(tmp_path, rotate_s=3600.0)
    for at in range(len(readings)):
        run.push(readings[at : at + 1])
    paths = run.close()

    lost = []
    for path in paths:
        with Recording(path) as recording:
            lost.append(recording.statistics().lost)
    assert sum(lost) == 20
    assert len(paths) == 2


def test_below_min_free_bytes_the_file_is_finished_and_it_goes_on_by_itself(tmp_path: Path) -> None:
    readings = readings_of(600)
    run = Run(tmp_path, min_free_bytes=10**9)
    for at in range(600):
        run.now_ns = at * STEP_NS
        run.free_bytes = 10**8 if 200 <= at < 400 else 10**10
        run.push(readings[at : at + 1])
    paths = run.close()

    read, _ = _content(paths)
    missing = sorted(set(readings["index"].tolist()) - set(read["index"].tolist()))
    assert len(paths) == 2
    assert 100 <= missing[0] <= 220
    assert 400 <= missing[-1] + 1 <= 400 + round(6 / INTERVAL_S)
    assert missing == list(range(missing[0], missing[-1] + 1))
    assert run.rollover.not_written == len(missing)
    with Recording(paths[0]) as recording:
        assert recording.metadata["aemd.close"]["reason"] == "disk-full"
    with Recording(paths[1]) as recording:
        assert recording.metadata["aemd.segment"]["not_written"] == str(len(missing))
        assert recording.statistics().lost == len(missing)
        (event,) = [event for batch in recording.batches() for event in batch.events]
    assert (event.first_index, event.last_index) == (missing[0], missing[-1])
    assert event.t_ns == int(readings["t_ns"][missing[0]])
    assert f"{len(missing)} readings not written" in event.message
    assert [replay(path, check=True).identical for path in paths] == [True, True]
    assert [line.split(" ")[0] for line in run.lines] == ["recording=stopped", "recording=resumed"]
    assert run.lines[0].endswith("then='goes on by itself when it can'")
    assert "record under another name" not in run.lines[0]  # nobody is asked to


@pytest.fixture
def refusing(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """While it is set, the disk refuses every chunk as a failing one does, after half of it."""
    failing = threading.Event()
    written = GrowingFile._append_bytes

    def append(self: GrowingFile, *parts: bytes) -> None:
        if failing.is_set() and parts[0][:1] == b"\x06":
            with self._or_fail():
                os.pwrite(self._fd, parts[0] + parts[1][: len(parts[1]) // 2], self._good_bytes)
                raise OSError(errno.EIO, "Input/output error")
        written(self, *parts)

    monkeypatch.setattr(GrowingFile, "_append_bytes", append)
    yield failing
    failing.clear()


def test_a_disk_that_fails_ends_the_file_where_it_was_good_and_not_the_acquisition(
    tmp_path: Path, refusing: threading.Event
) -> None:
    readings = readings_of(600)
    run = Run(tmp_path)
    for at in range(600):
        run.now_ns = at * STEP_NS
        (refusing.set if 200 <= at < 300 else refusing.clear)()
        run.push(readings[at : at + 1])
    paths = run.close()

    read, _ = _content(paths)
    missing = sorted(set(readings["index"].tolist()) - set(read["index"].tolist()))
    assert len(paths) >= 2
    assert missing == list(range(missing[0], missing[-1] + 1))
    assert missing[0] <= 200  # what waited for its chunk is gone, too
    assert run.rollover.not_written == len(missing)
    assert [replay(path, check=True).identical for path in paths] == [True] * len(paths)
    with Recording(paths[0]) as recording:
        assert recording.statistics().readings == missing[0]


def test_the_first_file_is_refused_where_there_is_no_room(tmp_path: Path) -> None:
    class Full(Run):
        free_bytes = property(lambda _: 10**8, lambda *_: None)

    with pytest.raises(RecordingError, match=r"has 100 MB left, fewer than \[recording\] min_free_bytes = 200 MB"):
        Full(tmp_path, min_free_bytes=200_000_000)
    assert list(tmp_path.iterdir()) == []


def test_the_state_that_comes_with_a_batch_is_that_behind_it(tmp_path: Path) -> None:
    """In a thread of its own, far behind the estimator: the files replay all the same."""
    run = Run(tmp_path, rotate_bytes=1 << 16)
    background = Background(
        run.rollover, queue_batches=4, cutter=run.rollover, copy_state=lambda: copy_state(run.estimator)
    )
    readings = readings_of(20_000)
    for at in range(0, 20_000, 50):
        block = readings[at : at + 50]
        run.now_ns = at * STEP_NS
        background.write(Batch(block), run.estimator.push(block))
    background.close("stop")

    paths = sorted(tmp_path.glob("*.mcap"))
    read, _ = _content(paths)
    assert len(paths) > 1
    assert read.tobytes() == readings.tobytes()
    assert all(replay(path, check=True).identical for path in paths)


def test_what_cannot_be_finished_stays_and_is_told_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run(tmp_path, rotate_bytes=1 << 16)
    finish: Callable[[GrowingFile], None] = GrowingFile.finish

    def refuse(self: GrowingFile) -> None:
        if self.path.name == "001.mcap":
            with self._or_fail():
                raise OSError(errno.EIO, "Input/output error")
        finish(self)

    monkeypatch.setattr(GrowingFile, "finish", refuse)
    for at in range(0, 2000, 10):
        run.now_ns = at * STEP_NS
        run.push(readings_of(2000)[at : at + 10])
    run.close()

    assert (tmp_path / "001.mcap.active").exists()
    assert (tmp_path / "002.mcap").exists()
    assert any(line.startswith("recording=unfinished") and "001.mcap.active" in line for line in run.lines)


def test_a_file_that_somebody_removes_is_noticed_and_another_one_begun(tmp_path: Path) -> None:
    readings = readings_of(600)
    run = Run(tmp_path)
    for at in range(600):
        run.now_ns = at * STEP_NS
        if at == 100:
            run.rollover.active.unlink()
        run.push(readings[at : at + 1])
        if run.rollover.trouble:
            trouble = run.rollover.trouble
    paths = run.close()

    read, _ = _content(paths)
    assert "somebody has removed" in trouble
    assert not run.rollover.trouble
    assert 0 < len(read) == 600 - run.rollover.not_written
    assert read["index"].tolist() == list(range(600 - len(read), 600))
