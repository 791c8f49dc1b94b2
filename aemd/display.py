"""What a person sees while readings flow: a live line on a terminal, plain lines elsewhere."""

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar
from rich.table import Table
from rich.text import Text

from aemd.acquire.instrument import Clock
from aemd.block import NOT_A_VALUE, Batch, Estimates

if TYPE_CHECKING:  # they bring the compiler, which who only looks at a running acquisition has no need to wait for
    from aemd.config import Scale
    from aemd.pipeline import Tally

__all__ = ["Progress", "advancing", "counting", "format_quantity", "showing", "sparkline"]

BARS = "▁▂▃▄▅▆▇█"
SPARK_READINGS = 48
"""Latest readings in the sparkline: three seconds at 15 Hz."""
QUIET_EVENTS = ("clock", "epoch")
"""Of the instrument's ordinary life: in the recording, not on the screen."""
FIRST_LINE_S = 10.0
LONGEST_LINE_S = 3600.0
"""Between plain lines, doubled from the first on: soon for who has just started it, few for a log of months."""


def sparkline(values: Sequence[float]) -> str:
    """Draw values as bars between their least and greatest; a blank where a value is not finite.

    >>> sparkline([0.0, 1.0, math.nan, 7.0])
    '▁▂ █'
    """
    finite = [value for value in values if math.isfinite(value)]
    low, high = (min(finite), max(finite)) if finite else (0.0, 0.0)
    step = (high - low) / (len(BARS) - 1)
    return "".join(
        " " if not math.isfinite(value) else BARS[round((value - low) / step) if step > 0 else 0] for value in values
    )


def format_quantity(value: float, unit: str, digits: int = 6) -> str:
    """Write a quantity with an SI prefix and so many significant digits.

    >>> format_quantity(-0.00123456789, "V"), format_quantity(0.0, "V", 3), format_quantity(math.nan, "V")
    ('-1.23457 mV', '+0.00 V', 'no value')
    """
    if not math.isfinite(value):
        return "no value"
    if value == 0:
        return f"{value:+.{digits - 1}f} {unit}"
    exponent = math.floor(math.log10(abs(value)))
    thousands = max(-4, min(0, exponent // 3)) if unit == "V" else 0
    scaled = value / 1000.0**thousands
    whole = max(1, exponent - 3 * thousands + 1)
    return f"{scaled:+.{max(0, digits - whole)}f} {['', 'm', 'µ', 'n', 'p'][-thousands]}{unit}"


class Progress:
    """A sink that keeps what a person wants to see of the last moments."""

    def __init__(self, tally: "Tally", scale: "Scale", clock: Clock) -> None:
        self._tally = tally
        self._scale = scale
        self._clock = clock
        self._recent: deque[float] = deque(maxlen=SPARK_READINGS)
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=64)
        self._raw_V = math.nan
        self._estimate_V = math.nan
        self._sigma_V = math.nan
        self._window = 0
        self._events: deque[str] = deque(maxlen=3)

    def write(self, batch: Batch, estimates: Estimates) -> None:
        """Remember the newest of a batch."""
        readings = batch.readings
        if readings.size:
            self._raw_V = float(readings["value_V"][-1])
            tail = readings[-SPARK_READINGS:]
            usable = (tail["status"] & NOT_A_VALUE) == 0
            self._recent.extend(np.where(usable, tail["value_V"], math.nan).tolist())
            now = self._clock()
            if not self._arrivals or now - self._arrivals[-1][0] > 100_000_000:
                self._arrivals.append((now, self._tally.counts.readings))
        if estimates.size:
            self._estimate_V = float(estimates["value_V"][-1])
            self._sigma_V = float(estimates["sigma_V"][-1])
            self._window = int(estimates["window"][-1])
        self._events.extend(event.message for event in batch.events if event.kind not in QUIET_EVENTS)

    @property
    def rate_hz(self) -> float:
        """Readings per second of the last seconds, as they arrive."""
        if len(self._arrivals) < 2:
            return 0.0
        (start_ns, first), (end_ns, last) = self._arrivals[0], self._arrivals[-1]
        return (last - first) / ((end_ns - start_ns) * 1e-9)

    def line(self) -> str:
        """Return the state as one line of key=value."""
        return (
            f"readings={self._tally.counts.readings} lost={self._tally.counts.lost} rate_hz={self.rate_hz:.3f} "
            f'raw="{self._show(self._raw_V)}" estimate="{self._show(self._estimate_V)}" window={self._window}'
        )

    def __rich__(self) -> Table:
        """Return the state as a small table for a terminal."""
        grid = Table.grid(padding=(0, 2))
        lost = Text(f"{self._tally.counts.lost} lost", style="red" if self._tally.counts.lost else "")
        grid.add_row(f"{self._tally.counts.readings} readings", f"{self.rate_hz:.2f} /s", lost)
        grid.add_row("raw", Text(self._show(self._raw_V)), sparkline(self._recent))
        sigma = format_quantity(abs(self._scale.factor) * self._sigma_V, self._scale.unit, 2).lstrip("+")
        grid.add_row("estimate", Text(self._show(self._estimate_V)), Text(f"± {sigma}   window {self._window}"))
        for message in self._events:
            grid.add_row("event", Text(message))
        return grid

    def _show(self, value_V: float) -> str:
        return format_quantity(self._scale.offset + self._scale.factor * value_V, self._scale.unit, 7)


class _Lines:
    """A sink that prints a progress line now and then, for logs and pipes."""

    def __init__(self, progress: Progress, console: Console, clock: Clock) -> None:
        self._progress = progress
        self._console = console
        self._clock = clock
        self._pause_s = FIRST_LINE_S
        self._next_ns = clock() + int(self._pause_s * 1e9)

    def write(self, batch: Batch, estimates: Estimates) -> None:
        self._progress.write(batch, estimates)
        for event in batch.events:
            if event.kind not in QUIET_EVENTS:
                self._print(f'event={event.kind} message="{event.message}"')
        if self._clock() >= self._next_ns:
            self._pause_s = min(2 * self._pause_s, LONGEST_LINE_S)
            self._next_ns += int(self._pause_s * 1e9)
            self._print(self._progress.line())

    def _print(self, text: str) -> None:
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)


@contextmanager
def showing(tally: "Tally", scale: "Scale", console: Console, clock: Clock) -> Iterator[Progress | _Lines]:
    """Give a sink that shows progress on the console: in place on a terminal, as lines elsewhere."""
    progress = Progress(tally, scale, clock)
    if console.is_terminal:
        with Live(progress, console=console, refresh_per_second=5, transient=True):
            yield progress
    else:
        yield _Lines(progress, console, clock)


@contextmanager
def advancing(total: int | None, console: Console | None) -> Iterator[Callable[[int], None]]:
    """Give a function that moves a progress bar on by so many readings; no bar where there is no terminal."""
    with _bar("readings", console) as bar:
        task = None if bar is None else bar.add_task("", total=total)
        yield lambda readings: None if bar is None or task is None else bar.advance(task, readings)


@contextmanager
def counting(what: str, console: Console | None) -> Iterator[Callable[[int, int], None]]:
    """Give a function that is told of the steps done and their number, and shows them where there is a terminal."""
    with _bar(what, console) as bar:
        task = None if bar is None else bar.add_task("", total=None)
        yield lambda done, total: None if bar is None or task is None else bar.update(task, completed=done, total=total)


@contextmanager
def _bar(what: str, console: Console | None) -> Iterator[ProgressBar | None]:
    if console is None or not console.is_terminal:
        yield None
        return
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with ProgressBar(*columns, console=console, transient=True) as bar:
        yield bar
