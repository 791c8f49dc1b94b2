"""`python -m tests.storm --seed N [--faults 1000] [--hours 24] [--link socket] [--poll S]`: exits 1 on any breach."""

import argparse
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import get_args

from aemd.info import inspect
from sim34410.bench import Link
from sim34410.faults import Kind, draw_faults
from tests.storm.judge import judge
from tests.storm.weather import pass_through


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.storm")
    parser.add_argument("--seed", type=int, action="append", help="one or more; 1 to 10 without")
    parser.add_argument("--faults", type=int, default=1000)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--link", choices=get_args(Link), default="socket")
    parser.add_argument("--poll", type=float, metavar="S", help="between two looks; 3 s without, 0 in earnest")
    parser.add_argument("--kind", choices=get_args(Kind), action="append")
    asked = parser.parse_args()
    breaches = 0
    for seed in asked.seed or range(1, 11):
        kinds = tuple(asked.kind) if asked.kind else get_args(Kind)
        faults = draw_faults(seed, asked.faults, asked.hours * 3600, kinds)
        with tempfile.TemporaryDirectory() as folder:
            passed = pass_through(
                faults,
                asked.hours * 3600 + 60,
                link=asked.link,
                poll_s=asked.poll,
                recording=Path(folder) / "storm.mcap",
                seed=seed,
                clock_error_ppm=100.0,
                clock_drift_ppm_per_day=5.0,
            )
            assert passed.recording is not None
            told = inspect(passed.recording)
        found = judge(passed)
        disagree = int((told.readings, told.lost, told.gaps) != _counted(passed.tally))
        breaches += found.breaches + disagree
        print(
            f"seed {seed}: {len(faults)} faults, {passed.readings.size} readings recorded of {passed.truth.size} made,"
            f" {told.lost} lost in {told.gaps} gaps, {passed.stream.outages} outages;"
            f" stamps within {found.worst_ns * 1e-6:.3f} ms, {found.worst_inside_ns * 1e-6:.3f} ms in outages;"
            f" {passed.cpu_s:.0f} s of CPU; breaches {found.breaches + disagree}"
        )
        if found.breaches + disagree:
            print(f"  {asdict(found)} info says {(told.readings, told.lost, told.gaps)}, not {_counted(passed.tally)}")
    return int(breaches > 0)


def _counted(tally: object) -> tuple[int, int, int]:
    counts = tally.counts  # type: ignore[attr-defined]
    return counts.readings, counts.lost, counts.gaps


if __name__ == "__main__":
    sys.exit(main())
