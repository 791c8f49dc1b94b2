"""Figures 4 and 5 with all their panels, from one record of each test."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from aemd.block import Estimates
from aemd.paper.methods import BETTER, PAPERS, Parameters, estimate
from aemd.paper.protocol import READINGS, SHOCK_GROUPS, Condition, Record, make_record

__all__ = ["draw_figures"]

SEED = 1  # of the records that are drawn
COLOURS = {
    "readings": "0.75",
    "KF": "tab:orange",
    "LMS": "tab:green",
    "REM": "tab:red",
    "AEM": "tab:blue",
    BETTER: "black",
}
SLOW_DETAIL = (200, 350)  # readings, as in Figure 4c
LIMIT_MV = 4.0  # as in Figure 5b


def draw_figures(parameters: Parameters, folder: Path) -> tuple[Path, Path]:
    """Draw Figures 4 and 5; return their files.

    Args:
        parameters: of the better estimator, tuned on other records.
        folder: where to; made if it is not there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    return _figure_4(parameters, folder / "figure4.png"), _figure_5(parameters, folder / "figure5.png")


def _figure_4(parameters: Parameters, path: Path) -> Path:
    record, estimates = _estimates("static", parameters)
    figure, axes = _canvas(4)
    last = max(np.flatnonzero(record.disturbed), key=lambda k: record.disturbed[k : k + 40].sum())
    shocks = max(0, int(last) - 10), min(READINGS, int(last) + 45)
    _plot(axes[0], record, estimates, (0, READINGS))
    axes[0].set_title("4 (a) static test: estimated input")
    _plot(axes[1], record, estimates, shocks)
    axes[1].set_title(f"4 (b) abrupt disturbance: the group of {max(g.shocks for g in SHOCK_GROUPS)} shocks")
    _plot(axes[2], record, estimates, SLOW_DETAIL)
    middle = 1e3 * record.slow_V[slice(*SLOW_DETAIL)]
    axes[2].set_ylim(middle.min() - 0.3, middle.max() + 0.3)
    axes[2].plot(np.arange(*SLOW_DETAIL), middle, "k:", lw=1, label="slow fluctuation")
    axes[2].set_title("4 (c) slow fluctuation")
    _windows(axes[3], estimates["AEM"], "4 (d) window of AEM")
    return _save(figure, axes, path)


def _figure_5(parameters: Parameters, path: Path) -> Path:
    record, estimates = _estimates("dynamic", parameters)
    figure, axes = _canvas(3)
    _plot(axes[0], record, estimates, (0, READINGS))
    axes[0].set_title("5 (a) dynamic test: estimated input")
    _plot(axes[1], record, estimates, (0, READINGS))
    axes[1].plot(1e3 * record.truth_V, "k:", lw=1, label="truth")
    axes[1].set_ylim(-LIMIT_MV, LIMIT_MV)
    axes[1].set_title(f"5 (b) the same from -{LIMIT_MV:g} to {LIMIT_MV:g} mV")
    _windows(axes[2], estimates["AEM"], "5 (c) window of AEM")
    return _save(figure, axes, path)


def _estimates(condition: Condition, parameters: Parameters) -> tuple[Record, dict[str, Estimates]]:
    record = make_record(condition, SEED)
    return record, {method: estimate(method, condition, record, parameters) for method in (*PAPERS, BETTER)}


def _canvas(rows: int) -> tuple[Figure, Any]:
    figure = Figure(figsize=(11, 2.8 * rows), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, 1)


def _plot(axis: Any, record: Record, estimates: dict[str, Estimates], span: tuple[int, int]) -> None:
    at, part = np.arange(*span), slice(*span)
    axis.plot(at, 1e3 * record.block["value_V"][part], color=COLOURS["readings"], lw=0.8, label="readings")
    for method, rows in estimates.items():
        axis.plot(at, 1e3 * rows["value_V"][part], color=COLOURS[method], lw=0.9, label=method)
    axis.set_xlim(*span)
    axis.set_ylabel("mV")


def _windows(axis: Any, estimates: Estimates, title: str) -> None:
    axis.plot(estimates["window"], color=COLOURS["AEM"], lw=0.8, drawstyle="steps-post", label="AEM")
    axis.set_xlim(0, READINGS)
    axis.set_ylim(0, 16)
    axis.set_ylabel("readings")
    axis.set_title(title)


def _save(figure: Figure, axes: Any, path: Path) -> Path:
    axes[-1].set_xlabel("reading")
    for axis in axes:
        axis.legend(loc="upper right", fontsize="x-small", ncols=7)
    figure.savefig(path)
    return path
