"""The whole program on a disk that fills up, and is emptied again while it runs."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from aemd.block import Batch
from aemd.errors import RecordingError
from aemd.record.check import check
from aemd.record.reader import Recording
from aemd.record.recovery import recover
from aemd.record.writer import Recorder
from aemd.replay import replay
from tests.record.made import DESCRIPTION, estimates_of, readings_of

CONFIG = """
[instrument]
resource = "sim"
range_V = 10.0
aperture_s = 100e-6
autozero = "off"
trigger_delay_s = 0.0
interval_s = 0.0005
[recording]
flush_interval_s = 0.25
min_free_bytes = {min_free_bytes}
rotate_bytes = 1000000
[simulator]
seed = 3
"""


def _wait_for(condition: Callable[[], bool], process: subprocess.Popen[str], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, "it ended"
        assert time.monotonic() < deadline, "it never came"
        time.sleep(0.05)


@pytest.mark.parametrize(
    "min_free_bytes",
    [pytest.param(0, id="to the last byte"), pytest.param(3_000_000, id="some left", marks=pytest.mark.slow)],
)
def test_a_full_disk_is_survived_counted_and_recording_goes_on_by_itself(
    small_disk: Path, tmp_path: Path, min_free_bytes: int
) -> None:
    config, log, filler = tmp_path / "config.toml", tmp_path / "log", small_disk / "filler"
    config.write_text(CONFIG.format(min_free_bytes=min_free_bytes))
    words = [sys.executable, "-m", "aemd", "acquire", str(config), "--out", str(small_disk), "--json"]
    with log.open("w") as err:
        process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=err, text=True)
    try:
        _wait_for(lambda: any(path.stat().st_size > 50_000 for path in small_disk.glob("*.active")), process)
        with filler.open("wb") as file:  # all but a little, which the recording then fills
            left = os.statvfs(small_disk).f_bavail * 4096 - min_free_bytes - 200_000
            file.write(bytes(left))
        _wait_for(lambda: "recording=stopped" in log.read_text(), process)
        time.sleep(0.5)  # readings come, and none is written
        filler.unlink()
        _wait_for(lambda: "recording=resumed" in log.read_text(), process)
        files = len(list(small_disk.iterdir()))
        _wait_for(lambda: any(path.stat().st_size > 50_000 for path in small_disk.glob("*.active")), process)
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()

    found = json.loads(out)
    paths = sorted(small_disk.glob("*.mcap"), key=_number)
    assert process.returncode == 0, log.read_text()
    assert files >= 2
    assert not list(small_disk.glob("*.active"))
    contents = [_readings(path) for path in paths]
    read = np.concatenate(contents)["index"]
    assert (np.diff(read) > 0).all()
    assert len(read) + found["not_written"] == found["readings"]
    assert found["not_written"] > 500
    assert len(set(range(found["readings"])) - set(read.tolist())) == found["not_written"]  # the instrument lost none
    assert found["lost"] == 0
    reasons = []
    for path in paths:
        assert replay(path, check=True).identical is True
        with Recording(path) as recording:
            reasons.append(recording.metadata["aemd.close"]["reason"])
    assert "disk-full" in reasons
    assert reasons[-1] == "stop"
    assert sum(_lost(path) for path in paths) == found["not_written"]


def test_a_disk_that_is_full_to_the_last_byte_still_has_the_room_for_the_end(small_disk: Path) -> None:
    recorder = Recorder(small_disk / "r.mcap", DESCRIPTION, chunk_bytes=4000, compression="none", keep_room=True)
    _fill(small_disk / "filler")
    readings = readings_of(50_000)
    estimates = estimates_of(readings)

    with pytest.raises(RecordingError, match="no space left on device"):
        recorder.write(Batch(readings), estimates)
    path = recorder.close("disk-full")

    assert path == small_disk / "r.mcap"
    assert check(path).whole
    assert 1000 < check(path).readings == recorder.written.readings < recorder.counts.readings


def _fill(path: Path) -> None:
    with path.open("wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(bytes(4096))


def _number(path: Path) -> int:
    with Recording(path) as recording:
        return int(recording.metadata["aemd.segment"]["number"])


def _lost(path: Path) -> int:
    with Recording(path) as recording:
        return recording.statistics().lost


def _readings(path: Path) -> np.ndarray:
    result = check(path)
    assert result.whole, (path, result.findings)
    with Recording(path) as recording:
        recording.verify()
        return np.concatenate([batch.readings for batch in recording.batches()])


def test_what_a_kill_left_on_a_full_disk_is_finished_with_the_room_that_it_gives_back(small_disk: Path) -> None:
    recorder = Recorder(small_disk / "r.mcap", DESCRIPTION, chunk_bytes=4000, keep_room=True)
    readings = readings_of(2000)
    recorder.write(Batch(readings), estimates_of(readings))
    recorder.release()
    _fill(small_disk / "filler")

    found = recover(small_disk / "r.mcap.active")

    assert found.readings > 1900
    assert check(small_disk / "r.mcap").whole
