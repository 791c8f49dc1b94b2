"""Every estimator on measured logs: parameters from one half, judged on the other, both ways.

Judged by the log-likelihood of each reading before it is seen, in nats a reading, from the hundredth reading of the
unseen half on: until then each has its own way to start. Run it where the logs are:

    AEMD_MEASURED=FOLDER python -m tests.estimate.real_logs [NAME ...]

Each rival is given its own parameters of greatest likelihood on the half that IMM is tuned on:

    KF, REM, AEM  sigma_Q and sigma_R; AEM's slopes are counted in units of sigma_R, as 0.99 mV to the paper's 1 mV
    LMS           taps, step and memory of its error's variance from a grid; about the half's median, which helps it
"""

import gzip
import itertools
import math
import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from aemd.block import Block, make_block
from aemd.estimate import make_estimator
from aemd.estimate.tune import tune

RIVALS = ("KF", "LMS", "REM", "AEM")
SLOW_LOGS = ("adc24_7hz_reference", "dmm6d_lm399_3hz", "dmm6d_calibrator_warmup")
SHAKER = "shaker_vibration_shock"
TRIALS = 7
NAMES = (*SLOW_LOGS, *(f"shaker-{trial}" for trial in range(TRIALS)))
SKIPPED = 100
"""Readings of the unseen half that are not judged."""
RESONANCES = 20
"""At most; whether a log has any is for the tuning to find."""
NAME_OF = {"KF": "kalman", "LMS": "lms", "REM": "rem", "AEM": "aem"}


def readings_of(folder: Path, name: str) -> tuple[NDArray[np.float64], float]:
    """Return the readings of a log, in its own unit, and the interval between them, s."""
    if name.startswith("shaker-"):
        with np.load(folder / f"{SHAKER}.npz") as log:
            return log["accel_board"][int(name.split("-")[1])].astype(float), float(np.diff(log["time"][:2])[0])
    with gzip.open(folder / f"{name}.csv.gz", "rt") as lines:
        time_s, values = np.loadtxt(lines, delimiter=",", skiprows=1, usecols=(0, 1), unpack=True)
    return values, float(np.median(np.diff(time_s)))


def score(name: str, options: Any, readings: NDArray[np.float64], interval_s: float) -> float:
    """Return the log-likelihood per reading, in nats, of all but the first ones."""
    estimator = make_estimator(name, options, interval_s)
    estimates = np.concatenate([estimator.push(block_of(readings, interval_s)), estimator.flush()])
    return float(np.mean(estimates["log_likelihood"][SKIPPED:]))


def block_of(readings: NDArray[np.float64], interval_s: float) -> Block:
    return make_block(readings, interval_ns=interval_s * 1e9)


def tuned_rival(method: str, readings: NDArray[np.float64], interval_s: float) -> dict[str, Any]:
    """Return the options of greatest likelihood of one of the paper's four."""
    step = float(np.std(np.diff(readings)))
    if method == "LMS":
        grid = itertools.product((2, 5, 15, 40, 100), (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 1.5), (30, 300))
        tried = [
            {
                "taps": taps,
                "step": rate,
                "error_memory": memory,
                "least_power_V2": taps * step**2,
                "sigma_R_V": step,
            }
            for taps, rate, memory in grid
        ]
        return max(tried, key=lambda options: score("lms", options, readings, interval_s))

    def options(logarithms: NDArray[np.float64]) -> dict[str, Any]:
        found = dict(zip(("sigma_Q_V", "sigma_R_V"), (step * np.exp(logarithms)).tolist(), strict=True))
        if method != "KF":
            found["likelihood_unit_V"] = found["sigma_R_V"] / 0.99
        if method == "AEM":
            found["slope_unit_V"] = found["sigma_R_V"] / 0.99
        return found

    def unlikely(logarithms: NDArray[np.float64]) -> float:
        value = -score(NAME_OF[method], options(np.clip(logarithms, -12, 6)), readings, interval_s)
        return value if math.isfinite(value) else 1e9

    best = min(
        (
            minimize(unlikely, start, method="Nelder-Mead", options={"maxfev": 80, "xatol": 0.02, "fatol": 1e-4})
            for start in ([-3.0, -0.4], [-0.4, -3.0])
        ),
        key=lambda result: result.fun,
    )
    return options(np.clip(best.x, -12, 6))


def scores_of(folder: Path, name: str) -> Iterator[tuple[str, dict[str, float], Mapping[str, Any]]]:
    """Yield, for each direction, its name, each method's score on the unseen half, and its parameters."""
    readings, interval_s = readings_of(folder, name)
    half = readings.size // 2
    parts = readings[:half], readings[half:]
    for direction, known, unseen in (("first -> second", *parts), ("second -> first", *parts[::-1])):
        middle = float(np.median(known))
        found: dict[str, Any] = {method: tuned_rival(method, known - middle, interval_s) for method in RIVALS}
        tuning = tune([block_of(known, interval_s)], interval_s, slow="input", resonances=RESONANCES)
        scores = {method: score(NAME_OF[method], found[method], unseen - middle, interval_s) for method in RIVALS}
        scores["imm"] = score("imm", tuning.options, unseen, interval_s)
        yield direction, scores, found | {"imm": (str(tuning.kind), tuning.options)}


def main(names: list[str]) -> None:
    print(
        f"{'log':26}{'tuned -> judged':18}" + "".join(f"{method:>9}" for method in (*RIVALS, "imm")) + "  imm leads by"
    )
    for name in names or NAMES:
        for direction, scores, found in scores_of(Path(os.environ["AEMD_MEASURED"]), name):
            lead = scores["imm"] - max(scores[method] for method in RIVALS)
            cells = "".join(f"{value:9.3f}" for value in scores.values())
            print(f"{name:26}{direction:18}{cells}{lead:+9.3f}", flush=True)
            for method, options in found.items():
                print(f"    {method}: {options}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
