"""Is the acquisition well? Counts seen over time, and a verdict in one line."""

import shutil
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from aemd.record.counts import Counts

__all__ = ["Disk", "Health", "Sources", "look_at_disk"]

PATIENCE_S = 5.0
PATIENCE_INTERVALS = 5
"""Without a reading, however long an interval is; without progress in writing."""
RATE_S = 10.0
RATE_INTERVALS = 3
"""Over which the rate is taken, at least."""
QUIET_S = 1.0
"""And PATIENCE_INTERVALS: where no reading comes for longer, that time counts, too."""


@dataclass(frozen=True, slots=True)
class Sources:
    """Where the live view finds what it does not get as readings; asked from its own thread."""

    counts: Counts
    """Of the readings that came through the estimator; only read here."""
    unwritten: Callable[[], int]
    """Readings that came through the estimator and are not yet with the recorder."""
    file: Callable[[], Path | None]
    """The recording as it is now named."""
    not_written: Callable[[], int] = lambda: 0
    """Readings that will be in no file: the disk was full or failed."""
    not_recording: Callable[[], str] = lambda: ""
    """Why what comes now is not written; empty while it is."""


@dataclass(frozen=True, slots=True)
class Disk:
    """The recording and the room for it."""

    file: Path | None
    file_bytes: int
    free_bytes: int


def look_at_disk(file: Path | None) -> Disk:
    """Ask the file system; what it does not tell is 0."""
    if file is None:
        return Disk(None, 0, 0)
    try:
        size = file.stat().st_size
    except OSError:
        size = 0
    try:
        free = shutil.disk_usage(file.parent).free
    except OSError:
        free = 0
    return Disk(file, size, free)


class Health:
    """Watches two counters: readings come, and they get written."""

    def __init__(self, interval_s: float, now_ns: int) -> None:
        self._patience_ns = round(max(PATIENCE_S, PATIENCE_INTERVALS * interval_s) * 1e9)
        self._started_ns = now_ns
        self._came = self._written = 0
        self._came_ns = self._written_ns = now_ns
        self._waiting = 0
        self._span_ns = round(max(RATE_S, RATE_INTERVALS * interval_s) * 1e9)
        self._quiet_ns = round(max(QUIET_S, PATIENCE_INTERVALS * interval_s) * 1e9)
        self._seen: deque[tuple[int, int, int]] = deque([(now_ns, 0, 0)])

    def see(self, came: int, waiting: int, now_ns: int, newest_ns: int) -> None:
        """Note how many readings have come so far, how many wait to be written, and the newest one's instant."""
        written = came - waiting
        if came != self._came:
            self._came, self._came_ns = came, now_ns
        if written != self._written or not waiting:
            self._written, self._written_ns = written, now_ns
        self._waiting = waiting
        if not self._seen[-1][1]:  # nothing had come: the rate is that since the first did
            self._seen.clear()
        self._seen.append((now_ns, came, newest_ns))
        while len(self._seen) > 2 and now_ns - self._seen[1][0] >= self._span_ns:
            self._seen.popleft()

    @property
    def rate_hz(self) -> float:
        """Readings per second of the last seconds, by their own instants; it falls while none comes."""
        (_, before, begin_ns), (now_ns, now, end_ns) = self._seen[0], self._seen[-1]
        quiet_ns = now_ns - self._came_ns
        span_ns = end_ns - begin_ns + (quiet_ns if quiet_ns > self._quiet_ns else 0)
        return (now - before) / (span_ns * 1e-9) if span_ns > 0 else 0.0

    def uptime_s(self, now_ns: int) -> float:
        """Return how long this has been watched, s."""
        return (now_ns - self._started_ns) * 1e-9

    def complaint(self, now_ns: int) -> str:
        """Return what is wrong in one line; empty if nothing is."""
        if now_ns - self._came_ns > self._patience_ns:
            return f"acquisition: no reading for {(now_ns - self._came_ns) * 1e-9:.0f} s"
        if now_ns - self._written_ns > self._patience_ns:
            waited_s = (now_ns - self._written_ns) * 1e-9
            return f"writing: {self._waiting} readings wait, none written for {waited_s:.0f} s"
        return ""
