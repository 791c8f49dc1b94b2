"""Clean records, as many as fit into a time: how often is something found where there is nothing?

    python -m tests.diagnose.clean --minutes 60 --seed 770000 -o clean.jsonl

Each is of the base model by formula, with random rate, length, time constants, noise and shocks. Nominal is 0.3 % of
the records; every alarm is listed with its check and p-value, and its seed makes the record again.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from aemd.diagnose import criticise
from aemd.diagnose.series import Series
from tests.diagnose.plant import markov, series

__all__ = ["record"]


def record(seed: int) -> tuple[Series, dict[str, float]]:
    """Return a clean record and what it was drawn with."""
    rng = np.random.default_rng([seed, 11])
    n, rate_hz = (
        int(10 ** rng.uniform(np.log10(600), np.log10(9000))),
        float(10 ** rng.uniform(np.log10(3), np.log10(50))),
    )
    step_s = 1 / rate_hz
    tau_s = step_s * 10 ** rng.uniform(0.3, 2.0)
    drift_tau_s = n * step_s * 10 ** rng.uniform(-1.3, 1.3)
    drift_sd, white = 10 ** rng.uniform(-1.0, 0.7), 10 ** rng.uniform(-1.0, 0.5)
    y = markov(rng, n, tau_s, 1.0, step_s) + markov(rng, n, drift_tau_s, drift_sd, step_s)
    y += white * rng.standard_normal(n)
    shocks, size, decay_s = 0.0, 0.0, 0.0
    if rng.random() < 0.5:
        shocks, size = n * 10 ** rng.uniform(-3.0, -1.5), rng.uniform(4, 25)
        decay_s = step_s * 10 ** rng.uniform(-0.3, 1.5)
        jumps = (rng.random(n) < shocks / n) * size * rng.standard_normal(n)
        y += lfilter([1], [1, -np.exp(-step_s / decay_s)], jumps)
    made = series(
        1e-3 * (y + rng.uniform(-100, 100)),
        time_s=np.arange(n) * step_s,
        index=np.arange(n),
        status=np.zeros(n, np.uint32),
        interval_s=step_s,
        nominal_interval_s=step_s,
    )
    drawn = {
        "n": n,
        "rate_hz": rate_hz,
        "tau_steps": tau_s * rate_hz,
        "drift_spans": drift_tau_s / (n * step_s),
        "drift_sd": drift_sd,
        "white": white,
        "shocks": shocks,
        "size": size,
        "decay_steps": decay_s * rate_hz,
    }
    return made, drawn


def main() -> None:
    """Run until the time is over, then say how often there was an alarm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=770_000, help="of the first record; the others follow it")
    parser.add_argument("-o", "--out", type=Path, help="one line of JSON a record, written as they come")
    asked = parser.parse_args()
    until, runs, alarms = time.monotonic() + 60 * asked.minutes, 0, 0
    while runs < asked.runs and time.monotonic() < until:
        seed = asked.seed + runs
        runs += 1
        made, drawn = record(seed)
        begun = time.process_time()
        found = criticise(made)
        told = {
            "seed": seed,
            "cpu_s": round(time.process_time() - begun, 2),
            "findings": [(item.cause, item.p_value, item.d_nats, item.experiment) for item in found.findings],
            "checks": [(item.check, item.observed, item.p_value) for item in found.discrepancies],
            "drawn": {name: float(f"{value:.4g}") for name, value in drawn.items()},
        }
        if asked.out:
            with asked.out.open("a") as file:
                file.write(json.dumps(told) + "\n")
        if found.findings:
            alarms += 1
            print(json.dumps(told), flush=True)
    print(f"{alarms} alarms in {runs} records")


if __name__ == "__main__":
    main()
