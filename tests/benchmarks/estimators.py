"""Readings a second of each estimator on one core, by the block, and as a ratio to filterpy's Kalman filter.

Processor time, so that what else the machine does is not counted; the best of three runs, compilation not counted.
"""

import time

import numpy as np
from numpy.typing import NDArray

from aemd.block import Block, make_block
from aemd.estimate import Estimator, make_estimator
from aemd.estimate.registry import ESTIMATORS
from aemd.estimate.tune import tune

READINGS = 2_000_000
SLOW_READINGS = 20_000
BLOCK = 8192
SLOW = {"filterpy"}
INTERVAL_S = 0.06712
LENGTHS = (100_000, 1_000_000, 10_000_000)
WINDOWS = (5, 10, 20, 40, 60)
TUNED_ON = 5000  # readings
STEPS_V = 0.05e-3  # of the walk
NOISE_V = 1e-3


def walk(readings: int, noise_V: float = NOISE_V) -> Block:
    """Return a random walk under noise: a reading far from what IMM's defaults expect, and what AEM's do."""
    rng = np.random.default_rng(1)
    steps, noise = rng.standard_normal(readings), rng.standard_normal(readings)
    return make_block(STEPS_V * steps.cumsum() + noise_V * noise, interval_ns=INTERVAL_S * 1e9)


def seconds(estimator: Estimator, block: Block) -> float:
    """Return the processor time that the readings take by the block."""
    start_s = time.process_time()
    for begin in range(0, block.size, BLOCK):
        estimator.push(block[begin : begin + BLOCK])
    return time.process_time() - start_s


def nanoseconds(name: str, options: object, block: Block) -> float:
    """Return ns/reading."""
    make_estimator(name, options, INTERVAL_S).push(block[:100])
    runs = 1 if name in SLOW else 3
    return 1e9 / block.size * min(seconds(make_estimator(name, options, INTERVAL_S), block) for _ in range(runs))


def main() -> None:
    block = walk(READINGS)
    found = {name: nanoseconds(name, {}, block[: SLOW_READINGS if name in SLOW else None]) for name in ESTIMATORS}
    tuned = tune([block[:TUNED_ON]], INTERVAL_S).options
    found["imm, tuned"] = nanoseconds("imm", tuned, block)
    base = found.get("filterpy", float("nan"))
    print(f"estimators: one core, blocks of {BLOCK}, a random walk under {1e3 * NOISE_V:g} mV of noise")
    print(
        "  imm has its defaults, 60 times less noise: most readings are in doubt between its modes, its slowest path;"
    )
    print(f"  `imm, tuned` has what `aemd tune` finds in the first {TUNED_ON} readings")
    for name, spent in found.items():
        print(f"  {name:10} {1e3 / spent:8.3f} M readings/s   {base / spent:8.1f} x filterpy")

    print("estimators: ns/reading against the length of the stream")
    print(f"  {'':10} {''.join(f'{length / 1e6:>8g} M' for length in LENGTHS)}")
    stream = walk(max(LENGTHS))
    for name, options in (("aem", {}), ("imm", tuned)):
        spent_ns = [nanoseconds(name, options, stream[:length]) for length in LENGTHS]
        print(f"  {name:10} {''.join(f'{spent:10.0f}' for spent in spent_ns)}")
    del stream

    print("estimators: ns/reading of REM and of AEM with one window, v readings long, every window 10 passes")
    print(f"  {'v':10} {''.join(f'{v:10}' for v in WINDOWS)}   straight line through them")
    for name in ("rem", "aem"):
        spent_ns = [nanoseconds(name, window_options(name, v), block[: READINGS // 4]) for v in WINDOWS]
        print(f"  {name:10} {''.join(f'{spent:10.0f}' for spent in spent_ns)}   {line_through(spent_ns)}")
    print("estimators: ns/reading of AEM against the most passes, v = 10")
    passes = (1, 10, 100, 1000)
    print(f"  {'r_max':10} {''.join(f'{r:10}' for r in passes)}")
    spent_ns = [nanoseconds("aem", window_options("aem", 10) | {"r_max": r}, block[: READINGS // 4]) for r in passes]
    print(f"  {'aem':10} {''.join(f'{spent:10.0f}' for spent in spent_ns)}")


def window_options(name: str, v: int) -> dict[str, object]:
    """Return options of one window of v readings."""
    window: dict[str, object] = {"window": v} if name == "rem" else {"windows": (v,), "thresholds": ()}
    return window | {"delta": 0.0, "r_max": 10}


def line_through(spent_ns: list[float]) -> str:
    """Say what straight line fits, and how far from it they are."""
    v: NDArray[np.float64] = np.array(WINDOWS, dtype=float)
    slope, start = np.polyfit(v, spent_ns, 1)
    furthest = float(np.max(np.abs(np.array(spent_ns) / (start + slope * v) - 1)))
    return f"{start:.0f} + {slope:.1f} v, to {100 * furthest:.0f} %"
