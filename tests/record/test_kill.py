"""The whole program, killed at any moment: what is back is every reading up to the last flush, and nothing else."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from aemd.record.check import check
from aemd.record.reader import Recording
from aemd.record.recovery import recover
from aemd.replay import replay

FLUSH_S = 0.5
BOUND_S = 0.25
"""Beyond the flush interval: two readings for a look at the instrument, their aperture, a batch on its way."""
STEP_V, STEPS = 1e-4, 5000

CONFIG = """
[instrument]
resource = "sim"
range_V = 10.0
{settings}
autozero = "off"
trigger_delay_s = 0.0
[recording]
flush_interval_s = {flush_s}
min_free_bytes = 0
[simulator]
recording = "{table}"
noise = false
"""
RATES = {
    "15 Hz": (0.06712, "aperture_s = 0.02\ninterval_s = 0.06712"),
    "10 kS/s": (1e-4, "aperture_s = 100e-6\ninterval_s = 0.0001"),
}


@contextmanager
def _acquiring(folder: Path, rate: str) -> Iterator[subprocess.Popen[bytes]]:
    """Acquire a staircase whose step says which reading this is."""
    interval_s, settings = RATES[rate]
    table, config = folder / "stairs.csv", folder / "config.toml"
    rows = (f"{step * interval_s:.9f},{step * STEP_V:.4f}\n" for step in range(STEPS))
    table.write_text("time,value\n" + "".join(rows))
    config.write_text(CONFIG.format(settings=settings, flush_s=FLUSH_S, table=table))
    words = [sys.executable, "-m", "aemd", "acquire", str(config), "--out", str(folder)]
    process = subprocess.Popen(words, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def _withheld_s(process: subprocess.Popen[bytes]) -> float:
    """Return what the machine has kept from it so far, s: each thread's wait for a processor, and any wait for a disk.

    On a machine that has nothing else to do that is some milliseconds a second.
    """
    waited_ns = 0
    for task in Path(f"/proc/{process.pid}/task").glob("*/schedstat"):
        with suppress(OSError):  # a thread that has just ended
            waited_ns += int(task.read_text().split()[1])
    disk_us = 0
    with suppress(OSError):  # a kernel that does not count it
        disk_us = int(Path("/proc/pressure/io").read_text().split("total=")[1].split()[0])
    return waited_ns * 1e-9 + disk_us * 1e-6


def _kill(folder: Path, rate: str, after_s: float) -> tuple[Path, int, float]:
    """Kill it so long after its first flush.

    Returns:
        What it left, when that was, ns UTC, and what the machine had kept from it since its file was there, s.
    """
    withheld_s = None
    with _acquiring(folder, rate) as process:
        while True:
            found = list(folder.glob("*.mcap.active"))
            if found and withheld_s is None:
                withheld_s = _withheld_s(process)
            if found and b"\x04\0\0\0zstd" in found[0].read_bytes():
                break
            assert process.poll() is None
            time.sleep(0.01)
        time.sleep(after_s)  # the moment is the point of the test
        withheld_s = _withheld_s(process) - withheld_s
        killed_ns = time.time_ns()  # before: nobody is held to what the killer is late
        process.send_signal(signal.SIGKILL)
    return found[0], killed_ns, withheld_s


def _lost_s(active: Path, killed_ns: int, rate: str) -> float:
    """Recover, and assert all but the bound; return from the last reading that is back to the kill, s."""
    interval_s, _ = RATES[rate]
    found = recover(active)
    path = Path(found.file)
    result = check(path)
    assert result.whole, result.findings
    with Recording(path) as recording:
        recording.verify()
        readings = np.concatenate([batch.readings for batch in recording.batches()])
    # As many as the time allows, each once, each with its own value: nothing is invented.
    assert readings["index"].tolist() == list(range(len(readings)))
    step, index = readings["value_V"] / STEP_V, readings["index"]
    begin = round(step[0]) - int(index[0])  # where the staircase was at the start
    wanted = (index + begin) % STEPS
    on_the_stairs = (wanted > 1) & (wanted < STEPS - 2)  # not where they fall back, and a reading may be of both ends
    assert np.abs(step - wanted)[on_the_stairs].max() <= 1
    assert replay(path, check=True).identical is True
    return (killed_ns - int(readings["t_ns"][-1])) * 1e-9 - interval_s


@pytest.mark.parametrize(("rate", "after_s"), [("15 Hz", 0.31), ("15 Hz", 0.97), ("10 kS/s", 0.08), ("10 kS/s", 1.47)])
def test_after_a_kill_every_flushed_reading_is_back(rate: str, after_s: float, tmp_path: Path) -> None:
    active, killed_ns, withheld_s = _kill(tmp_path, rate, after_s)

    assert _lost_s(active, killed_ns, rate) < FLUSH_S + BOUND_S + withheld_s


@pytest.mark.slow
@pytest.mark.timeout(4 * 3600)
@pytest.mark.parametrize("rate", RATES)
def test_after_a_hundred_kills_no_more_than_the_bound_is_lost(rate: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    lost_s, withheld_s = np.empty(100), np.empty(100)
    for number in range(100):
        folder = tmp_path / str(number)
        folder.mkdir()
        active, killed_ns, withheld_s[number] = _kill(folder, rate, float(rng.uniform(0, 1.5)))
        lost_s[number] = _lost_s(active, killed_ns, rate)
    print(
        f"\n{rate}: lost up to {lost_s.max():.3f} s of readings, median {np.median(lost_s):.3f} s; in each the machine"
        f" kept back {np.median(withheld_s):.3f} s, up to {withheld_s.max():.3f} s"
    )

    assert (lost_s < FLUSH_S + BOUND_S + withheld_s).all()
