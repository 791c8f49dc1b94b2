"""An archive of 64 files on the workers of a local dask cluster: two workers beside one."""

import os
import tempfile
import time
from pathlib import Path

from distributed import LocalCluster

from aemd.archive import replay_archive
from tests.benchmarks.offline import make

FILES = 64
READINGS = 200_000
"""Of each file: four hours at 15 readings/s, some tenths of a second of work."""


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        first = Path(folder) / "in" / "00.mcap"
        first.parent.mkdir()
        make(first, READINGS)
        for number in range(1, FILES):
            os.link(first, first.with_name(f"{number:02}.mcap"))
        elapsed_s = {workers: run(Path(folder), workers) for workers in (1, 2)}
    speed = FILES * READINGS / elapsed_s[2]
    print(f"archive: {FILES} files of {READINGS:,} readings, AEM, MCAP to MCAP, on a dask cluster of this machine")
    print(f"  two workers    {speed / 1e6:7.3f} M readings/s   {elapsed_s[1] / elapsed_s[2]:7.2f} x one worker")


def run(folder: Path, workers: int) -> float:
    """Return the seconds that a cluster of so many workers takes, its start and their first compilation not counted."""
    with LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as cluster:
        warm = folder / f"warm-{time.monotonic_ns()}"
        for number in range(2 * workers):
            (warm / "in").mkdir(parents=True, exist_ok=True)
            make(warm / "in" / f"{number}.mcap", 1000)
        replay_archive(str(warm / "in"), str(warm / "out"), scheduler=cluster.scheduler_address)
        out = folder / f"out-{time.monotonic_ns()}"
        start = time.perf_counter()
        done = replay_archive(str(folder / "in"), str(out), scheduler=cluster.scheduler_address)
        elapsed_s = time.perf_counter() - start
    assert (done.replayed, done.failed) == (FILES, ())
    return elapsed_s
