"""Readings a second of each estimator on one core, by the block, and as a ratio to filterpy's Kalman filter."""

import time

import numpy as np

from aemd.block import make_block
from aemd.estimate.registry import ESTIMATORS, make_estimator

READINGS = 2_000_000
SLOW_READINGS = 20_000
BLOCK = 8192
SLOW = {"filterpy"}


def speed(name: str, readings: int) -> float:
    """Return readings/s, the best of three runs, compilation not counted."""
    rng = np.random.default_rng(1)
    values_V = 1e-3 * (rng.standard_normal(readings).cumsum() * 0.05 + rng.standard_normal(readings))
    block = make_block(values_V, interval_ns=67.12e6)
    make_estimator(name, {}, 0.06712).push(block[:100])
    best_s = float("inf")
    for _ in range(1 if name in SLOW else 3):
        estimator = make_estimator(name, {}, 0.06712)
        start_s = time.perf_counter()
        for begin in range(0, readings, BLOCK):
            estimator.push(block[begin : begin + BLOCK])
        best_s = min(best_s, time.perf_counter() - start_s)
    return readings / best_s


def main() -> None:
    speeds = {name: speed(name, SLOW_READINGS if name in SLOW else READINGS) for name in ESTIMATORS}
    base = speeds.get("filterpy", float("nan"))
    print(f"estimators: one core, blocks of {BLOCK}")
    for name, found in speeds.items():
        print(f"  {name:10} {found / 1e6:8.3f} M readings/s   {found / base:8.1f} x filterpy")
