"""Run the tests over many seeds, on all processors, and put the figures together."""

import os
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import astuple, dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aemd.estimate import make_estimator
from aemd.estimate.imm import ImmOptions
from aemd.paper.measure import MEASURES, measure
from aemd.paper.methods import METHODS, Parameters, estimate, tune_parameters
from aemd.paper.protocol import CONDITIONS, INTERVAL_S, Condition, Scales, disturbance_scales, make_record

__all__ = ["Interval", "PaperResult", "SweepRow", "run_paper"]

Interval = tuple[float, float, float]
"""Lower end of the 95 % confidence interval, mean, upper end."""

TUNINGS = 10  # different historical samples that the seeds share out among themselves
FIRST_TUNING = 1_000_000  # their seeds: none that is judged
SWEPT_PASSES = (1, 3, 10, 30, 100)
SWEPT_SEEDS = 40  # enough for two digits, and the sweep is for the eye
RESAMPLINGS = 1000  # of the bootstrap
CHUNK = 10  # seeds a worker takes at a time


@dataclass(frozen=True, slots=True)
class SweepRow:
    """AEM or REM with the stop rule switched off (delta = 0), so that each window takes r_max passes."""

    method: str
    condition: str
    r_max: int
    variance_mV2: float
    mse_mV2: float
    repeats: float
    """Correlation of the estimate with itself one window ago: 1 where it is frozen."""


@dataclass(frozen=True, slots=True)
class PaperResult:
    """What came out."""

    seeds: int
    scales: Scales
    figures: Mapping[str, Mapping[str, Mapping[str, Interval]]]
    """By condition, method and measure (a field of Measured)."""
    ratios: Mapping[str, Mapping[str, Mapping[str, Interval]]]
    """Mean squared error of one method over that of another, by condition, method and other method."""
    sweep: tuple[SweepRow, ...]
    parameters: tuple[Mapping[str, ImmOptions], ...]
    """Of each historical sample."""


def run_paper(
    seeds: int = 200, jobs: int | None = None, progress: Callable[[int, int], None] | None = None
) -> PaperResult:
    """Run all tests.

    Args:
        seeds: records of each test, at least 2.
        jobs: processes; without it, one for each processor. With 1 nothing leaves this process.
        progress: called with the steps done and their number, from this thread.

    Raises:
        ValueError: fewer than 2 seeds have no confidence interval.
    """
    if seeds < 2:
        raise ValueError(f"seeds = {seeds}: must be at least 2")
    tunings = min(TUNINGS, seeds)
    chunks = [range(first, min(first + CHUNK, seeds)) for first in range(0, seeds, CHUNK)]
    swept = range(min(seeds, SWEPT_SEEDS))
    total = tunings + len(chunks) + 2 * len(SWEPT_PASSES)
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    with _Workers(jobs or os.cpu_count() or 1) as workers:
        parameters = workers.map(tune_parameters, [(FIRST_TUNING + i,) for i in range(tunings)], step)
        runs = workers.map(_run_seeds, [(chunk, [parameters[s % tunings] for s in chunk]) for chunk in chunks], step)
        swept_by = [(method, r_max, swept) for method in ("REM", "AEM") for r_max in SWEPT_PASSES]
        sweep = workers.map(_sweep, swept_by, step)
    values = np.concatenate(runs)
    drawn = np.random.default_rng(0).integers(0, seeds, (RESAMPLINGS, seeds))
    return PaperResult(
        seeds=seeds,
        scales=disturbance_scales(),
        figures={
            condition: {
                method: {name: _interval(values[:, i, j, k], drawn) for k, name in enumerate(MEASURES)}
                for j, method in enumerate(METHODS)
            }
            for i, condition in enumerate(CONDITIONS)
        },
        ratios={
            condition: _ratios(values[:, i, :, MEASURES.index("mse_mV2")], drawn)
            for i, condition in enumerate(CONDITIONS)
        },
        sweep=tuple(row for rows in sweep for row in rows),
        parameters=tuple(parameters),
    )


class _Workers:
    """Processes, or none: the same results, in the order of the work."""

    def __init__(self, jobs: int) -> None:
        # Started afresh: a fork of a process with threads, such as one that shows progress, may hang.
        self._pool = ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) if jobs > 1 else None

    def __enter__(self) -> "_Workers":
        return self

    def __exit__(self, *exception: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def map(self, function: Callable[..., Any], work: list[tuple[Any, ...]], step: Callable[[], None]) -> list[Any]:
        """Return the function's result for each piece of work."""
        results = []
        if self._pool is None:
            for arguments in work:
                results.append(function(*arguments))
                step()
            return results
        futures = [self._pool.submit(function, *arguments) for arguments in work]
        for _ in as_completed(futures):
            step()
        return [future.result() for future in futures]


def _run_seeds(seeds: range, parameters: list[Parameters]) -> NDArray[np.float64]:
    """Return the figures of some seeds, shape (seeds, conditions, methods, measures)."""
    values = np.empty((len(seeds), len(CONDITIONS), len(METHODS), len(MEASURES)))
    for place, (seed, found) in enumerate(zip(seeds, parameters, strict=True)):
        for i, condition in enumerate(CONDITIONS):
            record = make_record(condition, seed)
            for j, method in enumerate(METHODS):
                values[place, i, j] = astuple(measure(condition, record, estimate(method, condition, record, found)))
    return values


def _sweep(method: str, r_max: int, seeds: range) -> list[SweepRow]:
    """Return what becomes of AEM or REM when each window takes r_max passes."""
    rows = []
    tests: tuple[Condition, ...] = ("static", "dynamic")
    for condition in tests:
        measured, repeats = [], []
        for seed in seeds:
            record = make_record(condition, seed)
            estimates = make_estimator(method.lower(), {"delta": 0.0, "r_max": r_max}, INTERVAL_S).push(record.block)
            measured.append(measure(condition, record, estimates))
            value_V, at = estimates["value_V"], np.flatnonzero(estimates["window"])
            step_V2 = np.mean((value_V[at] - value_V[at - estimates["window"][at].astype(int)]) ** 2)
            repeats.append(1 - step_V2 / (2 * np.var(value_V[at])))
        rows.append(
            SweepRow(
                method=method,
                condition=condition,
                r_max=r_max,
                variance_mV2=float(np.mean([m.variance_mV2 for m in measured])),
                mse_mV2=float(np.mean([m.mse_mV2 for m in measured])),
                repeats=float(np.mean(repeats)),
            )
        )
    return rows


def _interval(values: NDArray[np.float64], drawn: NDArray[np.int64]) -> Interval:
    """Return the mean and its 95 % confidence interval: quantiles of the bootstrap over seeds."""
    low, high = np.quantile(values[drawn].mean(axis=1), [0.025, 0.975])
    return float(low), float(np.mean(values)), float(high)


def _ratios(errors: NDArray[np.float64], drawn: NDArray[np.int64]) -> dict[str, dict[str, Interval]]:
    """Return the ratios of the mean errors of all pairs of methods, with the same bootstrap for both.

    Args:
        errors: mean squared errors, shape (seeds, methods).
        drawn: numbers of the seeds in each resampling.
    """
    means, resampled = errors.mean(axis=0), errors[drawn].mean(axis=1)
    found: dict[str, dict[str, Interval]] = {}
    for i, method in enumerate(METHODS):
        found[method] = {}
        for j, other in enumerate(METHODS):
            if i != j and means[j] > 0:
                low, high = np.quantile(resampled[:, i] / resampled[:, j], [0.025, 0.975])
                found[method][other] = (float(low), float(means[i] / means[j]), float(high))
    return found
