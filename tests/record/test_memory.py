"""However long a recording is, no more than some megabytes of it are in memory."""

from pathlib import Path

import numpy as np

from aemd.block import ESTIMATE, Batch
from aemd.record.description import Description
from aemd.record.reader import Recording
from aemd.record.writer import Recorder
from tests.record.made import readings_of

MEGABYTE = 1 << 20


def _mapped_bytes(path: Path) -> int:
    """Return what the kernel counts as this process's memory of a mapped file."""
    mine = False
    total = 0
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if "-" in line.split(" ", 1)[0]:
            mine = line.endswith(str(path))
        elif mine and line.startswith("Rss:"):
            total += int(line.split()[1]) * 1024
    return total


def test_a_file_that_is_read_through_does_not_become_this_programs_memory(tmp_path: Path) -> None:
    block = readings_of(100_000)
    recorder = Recorder(tmp_path / "r.mcap", Description(), compression="none")
    for _ in range(8):
        recorder.write(Batch(block), np.empty(0, ESTIMATE))
        block = block.copy()
        block["index"] += len(block)
    path = recorder.close()

    most = 0
    with Recording(path) as recording:
        after_opening = _mapped_bytes(path)
        for number, _ in enumerate(recording.batches()):
            if number % 5 == 0:
                most = max(most, _mapped_bytes(path))

    assert path.stat().st_size > 45 * MEGABYTE
    assert after_opening < 12 * MEGABYTE
    assert 0 < most < 16 * MEGABYTE


def _status_bytes(name: str) -> int:
    """Return a figure of the kernel's about this process."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:"))


def test_a_file_that_is_held_against_its_checksum_does_not_either(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "r.mcap", Description(), compression="none")
    recorder.write(Batch(readings_of(800_000)), np.empty(0, ESTIMATE))
    path = recorder.close()

    with Recording(path) as recording:
        before = _status_bytes("VmRSS")
        Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
        recording.verify()
        peak = _status_bytes("VmHWM")

    assert path.stat().st_size > 45 * MEGABYTE
    assert peak - before < 20 * MEGABYTE
