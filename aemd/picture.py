"""The picture of a recording: readings, estimates with their band, windows, gaps."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from aemd.block import NOT_A_VALUE, READING, Block, Estimates
from aemd.errors import RecordingError
from aemd.record.reader import Recording

__all__ = ["draw"]

BINS = 2000
"""Columns of the picture: more readings than this are drawn as the least and the greatest of each column's."""
LARGEST = 1e100
"""Beyond it the arithmetic of axes overflows; what is drawn as this is off every chart."""
SPANS = 500
"""At most so many gaps are marked, and so many readings without a value."""
TIME_UNITS = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"))
MARKS = ("gap", "no_value")
PREFIXES = ((1e3, "m"), (1e6, "µ"), (1e9, "n"))
GAP_COLOUR, RAW_COLOUR, ESTIMATE_COLOUR = "tab:red", "0.65", "tab:blue"


def draw(path: Path, picture: Path) -> None:
    """Draw a recording's readings, estimates with their two-sigma band, and windows into a picture file.

    Raises:
        RecordingError: the recording cannot be read, holds nothing, or the picture cannot be written.
    """
    columns, unit = _columns(path)
    if not columns["time_s"].size:
        raise RecordingError(f"{path}: holds no reading; there is nothing to draw")
    factor, prefix = _prefix(columns["raw"], unit)
    with_estimate = bool(np.isfinite(columns["estimate"]).any())
    figure = Figure(figsize=(10, 6.5 if with_estimate else 4), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    ratios = [4, 1] if with_estimate else [1]
    axes = figure.subplots(len(ratios), 1, sharex=True, squeeze=False, height_ratios=ratios)[:, 0]
    start_s, span_s = columns["time_s"][0], columns["time_s"][-1] - columns["time_s"][0]
    divisor, time_unit = next((pair for pair in TIME_UNITS if span_s >= 3 * pair[0]), (1.0, "s"))
    time = (columns["time_s"] - start_s) / divisor
    axes[0].plot(*_envelope(time, columns["raw"] * factor), color=RAW_COLOUR, lw=0.8, label="readings")
    if with_estimate:
        band = 2 * columns["sigma"] * factor
        middle = columns["estimate"] * factor
        at, low = _thin(time, middle - band, np.fmin)
        _, high = _thin(time, middle + band, np.fmax)
        axes[0].fill_between(at, low, high, color=ESTIMATE_COLOUR, alpha=0.2, lw=0, label="±2 sigma")
        axes[0].plot(*_envelope(time, middle), color=ESTIMATE_COLOUR, lw=1.2, label="estimate")
        axes[1].plot(*_envelope(time, columns["window"]), color="tab:green", lw=0.8, drawstyle="steps-post")
        axes[1].set_ylabel("window (readings)")
        axes[1].set_ylim(bottom=0)
    for number, after in enumerate(np.flatnonzero(columns["gap"])[:SPANS]):
        # Two places back is the last reading before: between them stands the break in the lines.
        axes[0].axvspan(time[after - 2], time[after], color=GAP_COLOUR, alpha=0.15, lw=0, label=_once("lost", number))
    for number, at in enumerate(time[np.flatnonzero(columns["no_value"])][:SPANS]):
        axes[0].axvline(at, ymax=0.03, color=GAP_COLOUR, lw=1, label=_once("no value", number))
    axes[0].set_ylim(*_limits(columns["raw"] * factor, columns["estimate"] * factor, columns["sigma"] * factor))
    axes[0].ticklabel_format(axis="y", useOffset=False)
    axes[0].set_ylabel(f"value ({prefix}{unit})")
    axes[-1].set_xlabel(f"time since the first reading ({time_unit})")
    axes[0].set_title(path.name, loc="left", fontsize="medium")
    axes[0].legend(loc="upper right", fontsize="small", ncols=5)
    for axis in axes:
        axis.grid(visible=True, alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    try:
        figure.savefig(picture)
    except (OSError, ValueError) as error:
        raise RecordingError(f"{picture}: cannot write the picture: {error}; name a .png, .pdf or .svg") from error


def _columns(path: Path) -> tuple[dict[str, NDArray[np.float64]], str]:
    """Read what the picture needs of a recording, paired by index."""
    parts: list[tuple[Block, Estimates]] = []
    with Recording(path) as recording:
        unit = recording.description.unit
        parts.extend((batch.readings, estimates) for batch, estimates in recording.batches_with_estimates())
    readings = np.concatenate([part[0] for part in parts]) if parts else np.empty(0, READING)
    if not readings.size:
        return {"time_s": np.empty(0)}, unit
    estimates = np.concatenate([part[1] for part in parts])
    usable = (readings["status"] & NOT_A_VALUE) == 0
    value = np.where(usable, np.clip(readings["value_V"], -LARGEST, LARGEST), np.nan)
    columns = {
        "time_s": (readings["t_ns"] - readings["t_ns"][0]) * 1e-9,
        "raw": value,
        "gap": np.diff(readings["index"], prepend=readings["index"][0] - 1) > 1,
        "no_value": (readings["status"] & NOT_A_VALUE) != 0,
    }
    place = np.searchsorted(readings["index"], estimates["index"])
    for name, field in (("estimate", "value_V"), ("sigma", "sigma_V"), ("window", "window")):
        columns[name] = np.full(readings.size, np.nan)
        columns[name][place] = np.clip(estimates[field], -LARGEST, LARGEST)
    # A line that ran on over a gap would show readings that nobody took.
    breaks = np.flatnonzero(columns["gap"])
    return {
        name: np.insert(column, breaks, column[breaks] if name == "time_s" else 0.0 if name in MARKS else np.nan)
        for name, column in columns.items()
    }, unit


def _once(label: str, number: int) -> str | None:
    """Return the label for the first of many alike, so that the legend has it once."""
    return label if number == 0 else None


def _limits(
    raw: NDArray[np.float64], estimate: NDArray[np.float64], sigma: NDArray[np.float64]
) -> tuple[float | None, float | None]:
    """Return the ends of the value axis: all of readings and estimates, and of the band what does not dwarf them."""
    values = np.concatenate([raw, estimate])
    values = values[np.isfinite(values)]
    span = float(np.ptp(values)) if values.size else 0.0
    if span == 0:
        return None, None
    band = np.median(2 * sigma[np.isfinite(sigma)]) if np.isfinite(sigma).any() else 0.0
    margin = 0.05 * span + min(float(band), 0.5 * span)
    return float(values.min()) - margin, float(values.max()) + margin


def _prefix(values: NDArray[np.float64], unit: str) -> tuple[float, str]:
    """Choose the SI prefix in which values of volts read best; other units keep theirs."""
    finite = np.abs(values[np.isfinite(values)])
    top = float(finite.max()) if finite.size else 1.0
    if unit != "V" or top >= 1 or top == 0:
        return 1.0, ""
    return next((pair for pair in PREFIXES if top * pair[0] >= 1), PREFIXES[-1])


def _thin(time: NDArray[np.float64], values: NDArray[np.float64], pick: np.ufunc) -> tuple[Any, Any]:
    """Keep one value a column of the picture: the least or the greatest, as `pick` says."""
    step = -(-time.size // BINS)
    starts = np.arange(0, time.size, step)
    return time[starts], pick.reduceat(values, starts)


def _envelope(time: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[Any, Any]:
    """Return a line that shows every extreme of the values at the picture's resolution."""
    if time.size <= 2 * BINS:
        return time, values
    at, low = _thin(time, values, np.fmin)
    _, high = _thin(time, values, np.fmax)
    return np.repeat(at, 2), np.column_stack([low, high]).ravel()
