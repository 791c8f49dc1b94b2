"""The live view on a terminal, over ssh: readings and estimate in braille dots, values, health."""

import math
import select
import sys
import termios
import tty
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from aemd.display import format_quantity, sparkline
from aemd.errors import UsageError
from aemd.report import as_json
from aemd.watch.remote import format_bytes, frames

__all__ = ["draw_braille", "watch"]

SPAN_S = 60.0
DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
"""Bits of a braille pattern by row and column (Unicode 15, block 2800)."""
LABEL_COLUMNS = 13
OTHER_ROWS = 9
"""Of the terminal: everything but the plot."""

Mask = NDArray[np.bool_]
Values = NDArray[np.float64]


def draw_braille(masks: list[tuple[Mask, str]]) -> list[Text]:
    """Draw dots in lines of braille; where several masks meet in a character, it has the last one's style.

    Args:
        masks: dots, shape (4 rows, 2 columns) for each character, and their style.

    >>> dots = np.zeros((4, 4), bool)
    >>> dots[0, 0] = dots[3] = True
    >>> draw_braille([(dots, "")])[0].plain
    '⣁⣀'
    """
    rows, columns = masks[0][0].shape[0] // 4, masks[0][0].shape[1] // 2
    codes, styles = np.zeros((rows, columns), np.int64), np.full((rows, columns), -1)
    for number, (mask, _) in enumerate(masks):
        cells = mask.reshape(rows, 4, columns, 2).transpose(0, 2, 1, 3)
        codes |= (cells * DOTS).sum(axis=(2, 3))
        styles[cells.any(axis=(2, 3))] = number
    lines = []
    for row in range(rows):
        line = Text()
        for code, style in zip(codes[row].tolist(), styles[row].tolist(), strict=True):
            line.append(chr(0x2800 + code) if code else " ", masks[style][1] if style >= 0 else "")
        lines.append(line)
    return lines


def fill_dots(shape: tuple[int, int], x: Values, low: Values, high: Values, limits: tuple[float, float]) -> Mask:
    """Return dots from the least to the greatest value of each column.

    Args:
        shape: rows and columns of dots.
        x: where each stands, 0 to 1, shape (n,).
        low: least value of each, shape (n,).
        high: greatest value of each, shape (n,).
        limits: values at the bottom and at the top.
    """
    rows, columns = shape
    inside = (x >= 0) & (x < 1) & np.isfinite(low) & np.isfinite(high)
    at = (x[inside] * columns).astype(np.int64)
    scale = (rows - 1) / (limits[1] - limits[0])
    top, bottom = (
        np.clip(np.rint((limits[1] - values[inside]) * scale), 0, rows - 1).astype(np.int64) for values in (high, low)
    )
    mask = np.zeros(shape, bool)
    for column, first, last in zip(at.tolist(), top.tolist(), bottom.tolist(), strict=True):
        mask[first : last + 1, column] = True
    return mask


@dataclass(slots=True)
class _Seen:
    """What came down the stream."""

    bin_ms: float = 1.0
    readings: dict[int, tuple[float, float]] = field(default_factory=dict)
    estimates: dict[int, tuple[float, float]] = field(default_factory=dict)
    now: dict[str, Any] = field(default_factory=dict)
    status: dict[str, Any] = field(default_factory=dict)
    recent: deque[float] = field(default_factory=lambda: deque(maxlen=48))

    def take(self, frame: dict[str, Any]) -> None:
        if not frame:
            return
        if frame["fresh"]:
            self.readings.clear()
            self.estimates.clear()
        self.bin_ms = frame["bin_ms"]
        self.status = frame.get("status", self.status)
        if frame["now"]["index"] != self.now.get("index"):
            value = frame["now"]["value_V"]
            self.recent.append(math.nan if value is None else value)
        self.now = frame["now"]
        for cells, columns, names in (
            (self.readings, frame["readings"], ("lo", "hi")),
            (self.estimates, frame["estimates"], ("mean", "mean")),
        ):
            for n, low, high in zip(columns["n"], columns[names[0]], columns[names[1]], strict=True):
                cells[n] = (math.nan if low is None else low, math.nan if high is None else high)
            oldest = max(cells, default=0) - SPAN_S * 1e3 / self.bin_ms - 1
            for n in [n for n in cells if n < oldest]:
                del cells[n]

    def as_arrays(self, which: str) -> tuple[Values, Values, Values]:
        cells: dict[int, tuple[float, float]] = getattr(self, which)
        low, high = np.array(list(cells.values())).reshape(-1, 2).T
        end = max([*self.readings, *self.estimates]) + 1
        return 1 - (end - np.array(list(cells), float) - 0.5) * self.bin_ms / (SPAN_S * 1e3), low, high


def watch(url: str, *, json: bool) -> None:
    """Show a live view until q, Ctrl-C, or the end of the acquisition.

    Args:
        url: of the live view.
        json: print its state instead, as one line of JSON a second.

    Raises:
        UsageError: there is no terminal to show it on.
        InstrumentError: nobody answers there.
    """
    console = Console()
    if json:
        for frame in frames(url, SPAN_S, 16):
            if "status" in frame:
                print(" ".join(as_json(frame["status"]).split()), flush=True)  # noqa: T201 - it is the result
        return
    if not console.is_terminal:
        raise UsageError("watch: stdout is no terminal; use `aemd status`, or --json")
    seen = _Seen()
    try:
        with _keys() as pressed, Live(console=console, screen=True, auto_refresh=False) as live:
            for frame in frames(url, SPAN_S, 8 * max(8, console.width - LABEL_COLUMNS)):
                seen.take(frame)
                if seen.status:
                    live.update(_draw(seen, console.width, console.height), refresh=True)
                if pressed("q"):
                    return
    except KeyboardInterrupt:
        return
    console.print("the acquisition has ended")


@contextmanager
def _keys() -> Iterator[Any]:
    """Give a function that tells whether a key was pressed; always no where nobody can."""
    if not sys.stdin.isatty():
        yield lambda _key: False
        return
    handle = sys.stdin.fileno()
    before = termios.tcgetattr(handle)
    tty.setcbreak(handle)
    try:
        yield lambda key: bool(select.select([handle], [], [], 0)[0]) and key in sys.stdin.readline(1)
    finally:
        termios.tcsetattr(handle, termios.TCSADRAIN, before)


def _draw(seen: _Seen, width: int, height: int) -> Group:
    status, now = seen.status, seen.now
    say = _Quantities(status)
    well = status["health"] == "ok"
    head = Table.grid(expand=True, padding=(0, 1))
    head.add_column()
    head.add_column(justify="right")
    head.add_row(Text(f"aemd  {status['instrument']}", "bold"), Text(status["health"], "green" if well else "bold red"))
    values = Table.grid(padding=(0, 2))
    values.add_row("reading", Text(say.value(now["value_V"], 7), "bold"), sparkline(seen.recent))
    sigma = say.difference(now["sigma_V"], 3).lstrip("+")
    tail = f"± {sigma}   u {say.difference(now['u_V'], 4)}   window {now['window']}"
    values.add_row(Text("estimate", "cyan"), Text(say.value(now["estimate_V"], 7), "bold cyan"), tail)
    lost = Text(f"{status['lost']} lost", "bold red" if status["lost"] else "")
    if status["not_written"]:
        lost.append(f"   {status['not_written']} not written", "bold red")
    health = Table.grid(padding=(0, 3))
    health.add_row(
        f"{status['readings']} readings", f"{status['rate_hz']:.2f} /s", lost, f"{status['overloads']} overloads",
        f"{format_bytes(status['disk_free_bytes'])} free",
    )  # fmt: skip
    file = Text(f"{status['file'] or '-'}  {format_bytes(status['file_bytes'])}", "dim", overflow="ellipsis")
    event = Text(status["events"][-1]["message"] if status["events"] else "", "yellow", overflow="ellipsis")
    plot = _plot(seen, say, max(2, height - OTHER_ROWS), max(8, width - LABEL_COLUMNS))
    return Group(head, values, Text(), *plot, health, file, event, Text("q ends", "dim"))


def _plot(seen: _Seen, say: "_Quantities", rows: int, columns: int) -> list[Text]:
    if not seen.readings or not seen.estimates:
        return [Text()] * rows
    (x, low, high), (at, mean, _) = seen.as_arrays("readings"), seen.as_arrays("estimates")
    known = np.concatenate([low, high, mean])
    known = known[np.isfinite(known)]
    least, most = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    room = 0.05 * (most - least) or max(abs(most) * 1e-6, 1e-9)
    limits = least - room, most + room
    shape = 4 * rows, 2 * columns
    masks = [
        (fill_dots(shape, x, low, high, limits), "bright_black"), (fill_dots(shape, at, mean, mean, limits), "cyan"),
    ]  # fmt: skip
    lines = draw_braille(masks)
    for row, value in {0: limits[1], rows - 1: limits[0]}.items():
        lines[row] = Text.assemble((f"{say.value(value, 5):>{LABEL_COLUMNS - 1}} ", "dim"), lines[row])
    return [line if row in {0, rows - 1} else Text(" " * LABEL_COLUMNS) + line for row, line in enumerate(lines)]


class _Quantities:
    """Volts in the sensor's unit."""

    def __init__(self, status: dict[str, Any]) -> None:
        self._factor, self._offset, self._unit = status["factor"], status["offset"], status["unit"]

    def value(self, value_V: float | None, digits: int) -> str:
        known = math.nan if value_V is None else self._offset + self._factor * value_V
        return format_quantity(known, self._unit, digits)

    def difference(self, value_V: float | None, digits: int) -> str:
        return format_quantity(math.nan if value_V is None else self._factor * value_V, self._unit, digits)
