"""The live view's own thread: takes what is in the inbox some times a second, and makes what is sent to who looks.

What is sent is made once and kept until the next tick: eight browsers with the same view cost one conversion. A viewer
holds a place (the newest bins it has), so one that is slow gets, when it comes back, the bins since then in one piece:
at most what its screen holds, and nothing that is no longer news.
"""

import json
import math
import os
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from aemd import __version__
from aemd.acquire.instrument import Clock
from aemd.live.health import Disk, Health, Sources, look_at_disk
from aemd.live.history import History
from aemd.live.inbox import Inbox
from aemd.live.pyramid import Pyramid, bin_ns

__all__ = ["About", "Feed", "Place", "to_json"]

TICK_S = 0.1  # up to ten frames a second
READINGS = 3  # that are worth a frame
LONGEST_TICK_S = 0.25
IDLE_TICK_S = 0.5  # while nobody looks: the history is kept, and nothing is sent
SLOW_S = 1.0  # histogram, Allan deviation, disk


@dataclass(frozen=True, slots=True)
class About:
    """What is known before the first reading."""

    instrument: str
    """Model and serial number."""
    resource: str
    estimator: str
    interval_s: float
    factor: float = 1.0
    """Sensor units per volt."""
    offset: float = 0.0
    """Sensor units at zero volts."""
    unit: str = "V"
    resolution_V: float = 0.0
    """Last digit of a reading; 0 if unknown."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a viewer is: its newest bins, and the newest second's figures it has."""

    readings: int = -1
    estimates: int = -1
    second: int = -1


def to_json(value: Any) -> bytes:
    """Return compact JSON; what is not finite is null.

    >>> to_json({"a": [1.5, math.nan]})
    b'{"a":[1.5,null]}'
    """

    def plain(item: Any) -> Any:
        if isinstance(item, float):
            return item if math.isfinite(item) else None
        if isinstance(item, Mapping):
            return {key: plain(inner) for key, inner in item.items()}
        if isinstance(item, list | tuple):
            return [plain(inner) for inner in item]
        return item

    try:
        return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()
    except ValueError:
        return json.dumps(plain(value), separators=(",", ":")).encode()


class Feed:
    """History and health of a running acquisition, and their frames; `tick` by one thread, the rest by any."""

    def __init__(
        self, inbox: Inbox, about: About, sources: Sources, clock: Clock = time.monotonic_ns, utc: Clock = time.time_ns
    ) -> None:
        self.about = about
        self._inbox, self._sources, self._clock, self._utc = inbox, sources, clock, utc
        self._history = History()
        self._health = Health(about.interval_s, clock())
        self._started_ns = utc()
        self._tick_s = min(max(TICK_S, READINGS * about.interval_s), LONGEST_TICK_S)
        self._news = threading.Condition()  # between the live view's own threads
        self._ticks = 0
        self._ticked_ns = self._slow_ns = clock()
        self._second = 0
        self._slow: dict[str, Any] = {}
        self._disk = Disk(None, 0, 0)
        self._frames: dict[tuple[int, Place, bool], tuple[bytes, Place]] = {}
        self._viewers = 0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="aemd-live", daemon=True)
        self._look_slowly()

    def start(self) -> None:
        """Begin to tick in a thread of its own."""
        self._thread.start()

    def close(self) -> None:
        """End the thread and wake whoever waits for a frame. Twice is fine."""
        self._closed.set()
        with self._news:
            self._news.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    @property
    def is_closed(self) -> bool:
        """Whether no frame will come any more."""
        return self._closed.is_set()

    def _run(self) -> None:
        while not self._closed.wait(self._tick_s if self._viewers else IDLE_TICK_S):
            self.tick()

    def tick(self) -> None:
        """Take what waits into the history, and let whoever waits have a frame of it."""
        items = self._inbox.take()
        counts = self._sources.counts
        with self._news:
            now_ns = self._clock()
            if items:
                self._history.add(items)
            self._health.see(counts.readings, self._sources.unwritten(), now_ns, counts.t1_ns)
            if now_ns - self._slow_ns >= SLOW_S * 1e9:
                self._slow_ns = now_ns
                self._look_slowly()
            self._frames.clear()
            self._ticks += 1
            self._ticked_ns = now_ns
            self._news.notify_all()

    def _look_slowly(self) -> None:
        self._disk = look_at_disk(self._sources.file())
        self._second += 1
        self._slow = {"histogram": self._history.histograms(), "allan": self._history.allan()}

    def watching(self, change: int) -> None:
        """Count a viewer in (1) or out (-1)."""
        with self._news:
            self._viewers += change

    def wait(self, tick: int, timeout_s: float) -> int:
        """Wait until there was another tick than this one; return its number, the same one after the timeout."""
        with self._news:
            self._news.wait_for(lambda: self._ticks != tick or self._closed.is_set(), timeout_s)
            return self._ticks

    def frame(self, span_ns: int, columns: int, place: Place) -> tuple[bytes, Place]:
        """Return what is new since a place, as JSON, and the place of who has got it."""
        level = Pyramid.choose_level(span_ns, columns)
        with self._news:
            history = self._history
            oldest = (history.readings.newest_ns - span_ns) // bin_ns(level)
            since = Place(max(place.readings, oldest), max(place.estimates, oldest), place.second)
            fresh = place.readings < 0
            key = (level, since, fresh)
            if key not in self._frames:
                self._frames[key] = self._make_frame(level, since, fresh=fresh)
            return self._frames[key]

    def _make_frame(self, level: int, since: Place, *, fresh: bool) -> tuple[bytes, Place]:
        frame = self._columns(level, since.readings, since.estimates, None)
        frame["fresh"] = fresh
        frame["now"] = self._now()
        if since.second != self._second:
            frame["status"] = self.status()
            frame |= self._slow
        reached = Place(
            max([since.readings, *frame["readings"]["n"][-1:]]),
            max([since.estimates, *frame["estimates"]["n"][-1:]]),
            self._second,
        )
        return to_json(frame), reached

    def window(self, begin_ns: int, end_ns: int, columns: int) -> bytes:
        """Return a stretch of the past as JSON, as finely as it is remembered and as the columns can show."""
        with self._news:
            age_ns = self._history.readings.newest_ns - begin_ns
            level = Pyramid.choose_level(end_ns - begin_ns, columns, age_ns)
            width = bin_ns(level)
            return to_json(self._columns(level, begin_ns // width, begin_ns // width, end_ns // width))

    def _columns(self, level: int, readings: int, estimates: int, last: int | None) -> dict[str, Any]:
        numbers, raw = self._history.readings.cells(level, readings, last)
        estimated, columns = self._history.estimates.cells(level, estimates, last)
        columns["mean"] = columns.pop("sum") / columns.pop("count")
        return {
            "bin_ms": bin_ns(level) * 1e-6,
            "readings": {"n": numbers.tolist()} | {name: values.tolist() for name, values in raw.items()},
            "estimates": {"n": estimated.tolist()} | {name: values.tolist() for name, values in columns.items()},
        }

    def _now(self) -> dict[str, Any]:
        return asdict(self._history.newest) | {"rate_hz": self._health.rate_hz}

    def complaint(self) -> str:
        """Return what is wrong in one line; empty if nothing is."""
        now_ns = self._clock()
        if now_ns - self._ticked_ns > 10 * IDLE_TICK_S * 1e9:
            return f"live view: no tick for {(now_ns - self._ticked_ns) * 1e-9:.0f} s"
        if why := self._health.complaint(now_ns):
            return why + (self._of_the_link() if why.startswith("acquisition") else "")
        why = self._sources.not_recording()
        return f"recording: stopped, {self._sources.not_written()} readings not written: {why}" if why else ""

    def _of_the_link(self) -> str:
        """Return what a lost link adds to a complaint; empty while it is there."""
        told = [event.message for event in list(self._history.events) if event.kind == "link"]
        if not told or told[-1].startswith("back"):
            return ""
        return "; the link is lost, and tried again and again: what the meter keeps meanwhile will follow"

    def status(self) -> dict[str, Any]:
        """Return the state in plain values, for programs."""
        counts, newest, about, disk = self._sources.counts, self._history.newest, self.about, self._disk
        scale: Callable[[float], float] = lambda value_V: about.offset + about.factor * value_V  # noqa: E731 - short
        return {
            "aemd": __version__,
            "pid": os.getpid(),
            "health": self.complaint() or "ok",
            **asdict(about),
            "started_s": self._started_ns * 1e-9,
            "uptime_s": self._health.uptime_s(self._clock()),
            "readings": counts.readings,
            "rate_hz": self._health.rate_hz,
            "lost": counts.lost,
            "not_written": self._sources.not_written(),
            "gaps": counts.gaps,
            "overloads": self._history.overloads,
            "unwritten": self._sources.unwritten(),
            "skipped_by_view": self._inbox.skipped,
            "file": None if disk.file is None else str(disk.file),
            "file_bytes": disk.file_bytes,
            "disk_free_bytes": disk.free_bytes,
            "last": {
                "index": newest.index,
                "time_s": newest.t_ns * 1e-9,
                "value_V": newest.value_V,
                "value": scale(newest.value_V),
                "status": newest.status,
            },
            "estimate": {
                "index": newest.estimate_index,
                "value_V": newest.estimate_V,
                "value": scale(newest.estimate_V),
                "sigma_V": newest.sigma_V,
                "sigma": abs(about.factor) * newest.sigma_V,
                "u_V": newest.u_V,
                "window": newest.window,
            },
            "viewers": self._viewers,
            "events": [
                {"time_s": event.t_ns * 1e-9, "kind": event.kind, "message": event.message}
                for event in list(self._history.events)  # in one go: the other thread adds to them
            ],
        }
