"""The picture of a recording: readings, estimates with their band, windows, gaps."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console

from aemd.block import NOT_A_VALUE
from aemd.display import advancing
from aemd.errors import RecordingError
from aemd.record.reader import Recording
from aemd.record.source import Readings, Selection, open_readings

__all__ = ["draw"]

Floats = NDArray[np.float64]

BINS = 2000
"""Columns of the picture: more than two readings in each are drawn as their least and their greatest."""
PIECE_POINTS = 200
"""A line is painted in pieces of so many points: painted whole, one that goes up and down in every column takes some
tens of megabytes, and more the farther it goes. Each piece begins with the last point of the one before: those that
matplotlib makes itself (agg.path.chunksize) do not, and what happens between them is not drawn."""
LARGEST = 1e100
"""Beyond it the arithmetic of axes overflows; what is drawn as this is off every chart."""
SPANS = 500
"""At most so many gaps are marked, and so many readings without a value."""
TIME_UNITS = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"))
LINES = ("raw", "estimate", "sigma", "window")
PREFIXES = ((1e3, "m"), (1e6, "µ"), (1e9, "n"))
GAP_COLOUR, RAW_COLOUR, ESTIMATE_COLOUR = "tab:red", "0.65", "tab:blue"


def draw(path: Path, picture: Path, *, selection: Selection | None = None, console: Console | None = None) -> None:
    """Draw a recording's readings, estimates with their two-sigma band, and windows into a picture file.

    Memory does not grow with the recording: of a long one, what is drawn is gathered while it is read.

    Args:
        path: the recording.
        picture: the new file.
        selection: which number of the file is the reading, where it is not a recording of ours.
        console: where progress is shown; None for nowhere.

    Raises:
        RecordingError: the recording cannot be read, holds nothing, or the picture cannot be written.
    """
    with open_readings(path, selection) as recording:
        unit = recording.description.unit
        shown = _gather(recording, console)
    if shown is None:
        raise RecordingError(f"{path}: holds no reading; there is nothing to draw")
    raw, estimate, sigma, window = (shown.lines[name] for name in LINES)
    factor, prefix = _prefix(raw[1], unit)
    with_estimate = bool(np.isfinite(estimate[1]).any())
    figure = Figure(figsize=(10, 6.5 if with_estimate else 4), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    ratios = [4, 1] if with_estimate else [1]
    axes = figure.subplots(len(ratios), 1, sharex=True, squeeze=False, height_ratios=ratios)[:, 0]
    divisor, time_unit = next((pair for pair in TIME_UNITS if shown.span_s >= 3 * pair[0]), (1.0, "s"))
    _paint(axes[0], raw[0] / divisor, raw[1] * factor, color=RAW_COLOUR, lw=0.8, label="readings")
    if with_estimate:
        time, band, middle = estimate[0] / divisor, 2 * sigma[1] * factor, estimate[1] * factor
        step = 2 if shown.is_binned else 1
        axes[0].fill_between(
            time[::step],
            (middle - band)[::step],
            (middle + band)[step - 1 :: step],
            color=ESTIMATE_COLOUR,
            alpha=0.2,
            lw=0,
            label="±2 sigma",
        )
        _paint(axes[0], time, middle, color=ESTIMATE_COLOUR, lw=1.2, label="estimate")
        _paint(axes[1], window[0] / divisor, window[1], color="tab:green", lw=0.8, drawstyle="steps-post")
        axes[1].set_ylabel("window (readings)")
        axes[1].set_ylim(bottom=0)
    for number, (before_s, after_s) in enumerate(shown.gaps):
        axes[0].axvspan(
            before_s / divisor, after_s / divisor, color=GAP_COLOUR, alpha=0.15, lw=0, label=_once("lost", number)
        )
    for number, at_s in enumerate(shown.no_value):
        axes[0].axvline(at_s / divisor, ymax=0.03, color=GAP_COLOUR, lw=1, label=_once("no value", number))
    axes[0].set_ylim(*_limits(raw[1] * factor, estimate[1] * factor, sigma[1] * factor))
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


@dataclass(frozen=True, slots=True)
class _Shown:
    """What is drawn."""

    span_s: float
    lines: Mapping[str, tuple[Floats, Floats]]
    """Time, s since the first reading, and value of each line; NaN where it breaks. sigma is at estimate's times."""
    gaps: list[tuple[float, float]]
    """Last reading before each gap, and first after it, s."""
    no_value: list[float]
    """Readings without a value, s."""
    is_binned: bool
    """Whether a line's points are, in turns, the least and the greatest value of each column."""


def _gather(recording: Readings, console: Console | None) -> _Shown | None:
    """Read what the picture needs; None of a recording without readings."""
    if isinstance(recording, Recording):
        counted = recording.statistics()
        count, t0_ns, t1_ns = counted.readings, counted.t0_ns, counted.t1_ns
    else:
        count, t0_ns, t1_ns = _count(recording)
    if not count:
        return None
    span_s = (t1_ns - t0_ns) * 1e-9
    # Every reading of a short recording is a point; of a long one, those of a column of the picture are its extremes.
    is_binned = count > 2 * BINS
    make: Callable[[], _Points | _Bins] = (lambda: _Bins(span_s)) if is_binned else _Points
    lines = {name: make() for name in LINES}
    gaps, no_value = list[tuple[float, float]](), list[float]()
    last_index: int | None = None
    last_estimate: int | None = None
    last_s = 0.0
    with advancing(count, console) as bar:
        for batch, estimates in recording.batches_with_estimates():
            block = batch.readings
            bar(len(block))
            time_s = (block["t_ns"] - t0_ns) * 1e-9
            usable = (block["status"] & NOT_A_VALUE) == 0
            if len(block):
                before_s = np.concatenate([[last_s], time_s[:-1]])
                lost = _gaps(block["index"], last_index)
                values = np.where(usable, np.clip(block["value_V"], -LARGEST, LARGEST), np.nan)
                lines["raw"].add(np.insert(time_s, lost, time_s[lost]), np.insert(values, lost, np.nan))
                gaps += zip(before_s[lost].tolist(), time_s[lost].tolist(), strict=True)
                no_value += time_s[~usable].tolist()
                gaps, no_value = gaps[:SPANS], no_value[:SPANS]
                last_index, last_s = int(block["index"][-1]), float(time_s[-1])
            at_s = (estimates["t_ns"] - t0_ns) * 1e-9
            breaks = _gaps(estimates["index"], last_estimate)
            for name, field in (("estimate", "value_V"), ("sigma", "sigma_V"), ("window", "window")):
                values = np.clip(estimates[field].astype(np.float64), -LARGEST, LARGEST)
                lines[name].add(np.insert(at_s, breaks, at_s[breaks]), np.insert(values, breaks, np.nan))
            last_estimate = int(estimates["index"][-1]) if len(estimates) else last_estimate
    return _Shown(
        span_s, {name: line.line(widest=name == "sigma") for name, line in lines.items()}, gaps, no_value, is_binned
    )


def _gaps(index: NDArray[np.int64], last: int | None) -> NDArray[np.intp]:
    """Return the places before which numbers are missing, and a line breaks: it would show readings that nobody took.

    Args:
        index: the numbers of a batch's readings or estimates; there may be none.
        last: the one before them; None for the first batch.
    """
    return np.flatnonzero(np.diff(index, prepend=index[:1] - 1 if last is None else last) > 1)


def _count(recording: Readings) -> tuple[int, int, int]:
    """Return the number of readings, and the first and the last instant."""
    count, t0_ns, t1_ns = 0, 0, 0
    for batch in recording.batches():
        t0_ns = t0_ns if count else int(batch.readings["t_ns"][0])
        t1_ns = int(batch.readings["t_ns"][-1])
        count += len(batch.readings)
    return count, t0_ns, t1_ns


class _Points:
    """A line through every point."""

    def __init__(self) -> None:
        self._parts: list[tuple[Floats, Floats]] = []

    def add(self, time_s: Floats, values: Floats) -> None:
        self._parts.append((time_s, values))

    def line(self, *, widest: bool) -> tuple[Floats, Floats]:  # noqa: ARG002 - every value is there
        times, values = zip(*self._parts, strict=True)
        return np.concatenate(times), np.concatenate(values)


class _Bins:
    """A line through the least and the greatest value of each column of the picture; a break where one is empty."""

    def __init__(self, span_s: float) -> None:
        self._per_s = BINS / span_s if span_s > 0 else 0.0
        self._low, self._high = np.full(BINS, np.nan), np.full(BINS, np.nan)

    def add(self, time_s: Floats, values: Floats) -> None:
        if not len(values):
            return
        place = np.clip((time_s * self._per_s).astype(np.int64), 0, BINS - 1)
        starts = np.concatenate([[0], np.flatnonzero(np.diff(place)) + 1])
        np.fmin.at(self._low, place[starts], np.fmin.reduceat(values, starts))
        np.fmax.at(self._high, place[starts], np.fmax.reduceat(values, starts))

    def line(self, *, widest: bool) -> tuple[Floats, Floats]:
        middle_s = (np.arange(BINS) + 0.5) / (self._per_s or 1.0)
        low = self._high if widest else self._low
        return np.repeat(middle_s, 2), np.column_stack([low, self._high]).ravel()


def _paint(axes: Axes, x: Floats, y: Floats, *, label: str | None = None, **look: Any) -> None:
    for number, begin in enumerate(range(0, max(len(x) - 1, 1), PIECE_POINTS)):
        piece = slice(begin, begin + PIECE_POINTS + 1)
        axes.plot(x[piece], y[piece], label=_once(label, number), **look)


def _once(label: str | None, number: int) -> str | None:
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
