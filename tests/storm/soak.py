"""Weeks without a fault in minutes: memory, descriptors and threads stay flat, nothing is lost.

`python -m tests.storm.soak [DAYS]`, 30 without; exit code 1 where it is not so.
"""

import gc
import sys
import tempfile
from pathlib import Path

import psutil

from aemd.block import Batch, Estimates
from agilent34410 import Options
from tests.storm.weather import LOOKS_EVERY, pass_through

DAY_NS = 86_400 * 10**9
MOST_GROWTH = 8 * 2**20
"""Bytes from the end of the first tenth on: allocators breathe, a leak of a byte a reading is 40 MB in a month."""


class Days:
    """A sink that notes what the process uses at the end of each simulated day."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, int, int]] = []
        self._process = psutil.Process()
        self._due_ns = 0

    def write(self, batch: Batch, estimates: Estimates) -> None:
        if not batch.readings.size or (t_ns := int(batch.readings["t_ns"][-1])) < self._due_ns:
            return
        self._due_ns = t_ns + DAY_NS // 4
        gc.collect()
        self.rows.append((self._process.memory_info().rss, self._process.num_fds(), self._process.num_threads()))


def main(days: float = 30.0) -> int:
    watch = Days()
    with tempfile.TemporaryDirectory() as folder:
        passed = pass_through(
            (),
            days * 86_400,
            recording=Path(folder) / "soak.mcap",
            poll_s=10 * LOOKS_EVERY * Options().interval_s,
            keep=False,
            watchers=[watch],
            clock_error_ppm=50.0,
        )
    counts = passed.tally.counts
    settled = watch.rows[max(1, len(watch.rows) // 10) :]
    memory, descriptors, threads = zip(*settled, strict=True)
    growth = memory[-1] - memory[0]
    flat = growth < MOST_GROWTH and len(set(descriptors)) == len(set(threads)) == 1
    print(
        f"{days:g} days: {counts.readings} readings, {counts.lost} lost, {passed.stream.outages} outages; memory"
        f" {memory[-1] / 2**20:.0f} MB, {growth / 2**20:+.1f} MB; descriptors {set(descriptors)}; threads"
        f" {set(threads)}; {passed.cpu_s:.0f} s of CPU"
    )
    return int(counts.lost > 0 or not flat)


if __name__ == "__main__":
    sys.exit(main(*map(float, sys.argv[1:2])))
