"""What the live view remembers of the stream, in constant memory: bins of time, running statistics, newest values."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aemd.block import NOT_A_VALUE, Batch, Estimates, Event, Status
from aemd.live.allan import RunningAllan
from aemd.live.pyramid import Pyramid

__all__ = ["History", "Newest", "make_histogram"]

RECENT = 1 << 12  # readings in a histogram: 4.6 min at 15 Hz
CLASSES = 41  # of a histogram; odd, so that one is in the middle
EVENTS = 50
QUIET_EVENTS = ("clock", "epoch")
"""Of the instrument's ordinary life: in the recording, not on the page."""
OVERLOAD = Status.OVERLOAD_HIGH | Status.OVERLOAD_LOW

Values = NDArray[np.float64]


@dataclass(slots=True)
class Newest:
    """The last reading and the last estimate; NaN and -1 while there is none."""

    index: int = -1
    t_ns: int = 0
    value_V: float = np.nan
    status: int = 0
    estimate_index: int = -1
    estimate_V: float = np.nan
    sigma_V: float = np.nan
    u_V: float = np.nan
    window: int = 0
    passes: int = 0


@dataclass(slots=True)
class _Recent:
    """The last values of a stream with their indexes."""

    index: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    values: Values = field(default_factory=lambda: np.empty(0))

    def add(self, index: NDArray[np.int64], values: Values) -> None:
        self.index = np.concatenate((self.index, index))[-RECENT:]
        self.values = np.concatenate((self.values, values))[-RECENT:]


class History:
    """Takes what the pipeline made. Not thread-safe."""

    def __init__(self) -> None:
        self.readings = Pyramid(least=["lo"], greatest=["hi"], total=["bad"])
        self.estimates = Pyramid(
            least=["lo", "band_lo", "u_lo", "w_lo"],
            greatest=["hi", "band_hi", "u_hi", "w_hi"],
            total=["sum", "count"],
        )
        self.raw_allan = RunningAllan()
        self.estimate_allan = RunningAllan()
        self.newest = Newest()
        self.overloads = 0
        self.events: deque[Event] = deque(maxlen=EVENTS)
        self._raw = _Recent()
        self._estimated = _Recent()

    def add(self, items: Sequence[tuple[Batch, Estimates]]) -> None:
        """Take batches with the estimates that came with them, oldest first; many at once cost little more than one."""
        blocks = [batch.readings for batch, _ in items if batch.readings.size]
        if blocks:
            self._add_readings(np.concatenate(blocks))
        estimates = [estimates for _, estimates in items if estimates.size]
        if estimates:
            self._add_estimates(np.concatenate(estimates))
        self.events.extend(event for batch, _ in items for event in batch.events if event.kind not in QUIET_EVENTS)

    def _add_readings(self, readings: NDArray[np.void]) -> None:
        index, status = readings["index"], readings["status"]
        unusable = (status & NOT_A_VALUE) != 0
        values = np.where(unusable, np.nan, readings["value_V"])
        self.readings.add(readings["t_ns"], {"lo": values, "hi": values, "bad": unusable.astype(np.float64)})
        self.raw_allan.add(index, values)
        self.overloads += int(np.count_nonzero(status & OVERLOAD))
        self._raw.add(index[~unusable], values[~unusable])
        newest, last = self.newest, readings[-1]
        newest.index, newest.t_ns, newest.status = int(last["index"]), int(last["t_ns"]), int(last["status"])
        newest.value_V = float(values[-1])

    def _add_estimates(self, estimates: Estimates) -> None:
        value, sigma, u, window = (estimates[name] for name in ("value_V", "sigma_V", "u_V", "window"))
        window = window.astype(np.float64)
        columns = {
            "lo": value, "hi": value, "band_lo": value - sigma, "band_hi": value + sigma, "u_lo": u, "u_hi": u,
            "w_lo": window, "w_hi": window, "sum": value, "count": np.ones(value.size),
        }  # fmt: skip
        self.estimates.add(estimates["t_ns"], columns)
        self.estimate_allan.add(estimates["index"], value)
        self._estimated.add(estimates["index"], value)
        newest, last = self.newest, estimates[-1]
        newest.estimate_index, newest.window = int(last["index"]), int(last["window"])
        newest.estimate_V, newest.sigma_V, newest.u_V = (float(last[name]) for name in ("value_V", "sigma_V", "u_V"))
        newest.passes = int(last["passes"])

    def histograms(self) -> dict[str, Any]:
        """Return those of the recent readings, and of what is left of each after its estimate."""
        _, raw, estimated = np.intersect1d(self._raw.index, self._estimated.index, True, True)  # noqa: FBT003
        residuals = self._raw.values[raw] - self._estimated.values[estimated]
        return {"readings": make_histogram(self._raw.values), "residuals": make_histogram(residuals)}

    def allan(self) -> dict[str, Any]:
        """Return the running Allan deviations of readings and estimates."""
        names = ("length", "deviation_V", "pairs")
        return {
            "readings": dict(zip(names, self.raw_allan.deviations(), strict=True)),
            "estimates": dict(zip(names, self.estimate_allan.deviations(), strict=True)),
        }


def make_histogram(values: Values) -> dict[str, Any]:
    """Return classes that show the bulk well however far a shock is off: what lies beyond is in the outermost ones.

    Args:
        values: finite, shape (n,), V.

    Returns:
        from_V, step_V, counts, and the median and spread_V (half the width of the middle 68 %, a normal
        distribution's standard deviation); empty of fewer than two values.
    """
    if values.size < 2:
        return {}
    low, median, high = (float(edge) for edge in np.quantile(values, [0.16, 0.5, 0.84]))
    spread = (high - low) / 2
    if spread == 0:
        spread = float(np.ptp(values)) / 8 or max(abs(median) * 1e-9, 1e-12)
    step = 8 * spread / CLASSES
    begin = median - 4 * spread
    classes = np.clip((values - begin) / step, 0, CLASSES - 1).astype(np.int64)
    counts = np.bincount(classes, minlength=CLASSES).tolist()
    return {"from_V": begin, "step_V": step, "counts": counts, "median_V": median, "spread_V": spread}
