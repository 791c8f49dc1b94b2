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
