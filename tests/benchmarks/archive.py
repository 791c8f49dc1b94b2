"""An archive of 64 files on the workers of a local dask cluster: two workers beside one."""

import os
import tempfile
import time
from pathlib import Path

import psutil
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
        measured = {workers: run(Path(folder), workers) for workers in (1, 2)}
    (one_s, one), (two_s, two) = measured[1], measured[2]
    speed = FILES * READINGS / two_s
    print(f"archive: {FILES} files of {READINGS:,} readings, AEM, MCAP to MCAP, on a dask cluster of this machine")
    print(f"  two workers    {speed / 1e6:7.3f} M readings/s   {one_s / two_s:7.2f} x one worker")
    # The seconds that processors worked tell the same on a machine that does other things meanwhile.
    for name, at in (("workers", 0), ("coordinator", 1)):
        print(f"  CPU of {name:<11} {one[at]:6.1f} s for one worker, {two[at]:6.1f} s for two")
    print(f"  CPU in all         {sum(two) / sum(one):7.2f} x one worker's")


def run(folder: Path, workers: int) -> tuple[float, tuple[float, float]]:
    """Return the seconds that a cluster of so many workers takes, and the CPU's of workers and of this process.

    Its start and their first compilation are not counted. The scheduler is in this process.
    """
    with LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as cluster:
        warm = folder / f"warm-{time.monotonic_ns()}"
        for number in range(2 * workers):
            (warm / "in").mkdir(parents=True, exist_ok=True)
            make(warm / "in" / f"{number}.mcap", 1000)
        replay_archive(str(warm / "in"), str(warm / "out"), scheduler=cluster.scheduler_address)
        out = folder / f"out-{time.monotonic_ns()}"
        processes = [psutil.Process(nanny.pid) for nanny in cluster.workers.values()]
        before, mine, start = _cpu_s(processes), time.process_time(), time.perf_counter()
        done = replay_archive(str(folder / "in"), str(out), scheduler=cluster.scheduler_address)
        elapsed_s = time.perf_counter() - start
        cpu_s = _cpu_s(processes) - before, time.process_time() - mine
    assert (done.replayed, done.failed) == (FILES, ())
    return elapsed_s, cpu_s


def _cpu_s(processes: list[psutil.Process]) -> float:
    return sum(times.user + times.system for times in (process.cpu_times() for process in processes))
