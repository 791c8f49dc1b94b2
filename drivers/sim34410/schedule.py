"""When readings begin and when they are in the memory: arithmetic on integer nanoseconds of the meter's own clock."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["GRID_NS", "REARM_NS", "Schedule", "on_grid_ns"]

GRID_NS = 20_000
"""Step of the sample timer: "about 20 us" for DC volts (PRH page 797)."""

REARM_NS = 200_000
"""From the end of a trigger's last reading to the next immediate trigger. The manual is silent; a choice, of the size
of the trigger delay, so that a new timing epoch after SAMPle:COUNt readings is there to be noticed."""


def on_grid_ns(interval_s: float, step_ns: int = GRID_NS) -> int:
    """Return the first tick of the sample timer that is not below `interval_s`, ns (to 1 ns of rounding)."""
    return -(-(round(interval_s * 1e9)) // step_ns) * step_ns


@dataclass(frozen=True, slots=True)
class Schedule:
    """The readings that follow one trigger, or a row of immediate triggers.

    Reading i of trigger j begins at first + j period + delay + i interval, and is in the memory `reading` later. The
    next trigger comes `rearm` after the last reading is there, whatever the interval: a new timing epoch.
    """

    first_ns: int
    """The first trigger."""
    delay_ns: int
    """From a trigger to its first reading."""
    interval_ns: int
    """From the beginning of a reading to that of the next; not shorter than `reading_ns`."""
    reading_ns: int
    """From the beginning of a reading, its zero included, until it is in the memory."""
    samples: int
    """Readings for each trigger."""
    triggers: int | None
    """Triggers in a row; None for no end."""

    @property
    def period_ns(self) -> int:
        """From trigger to trigger."""
        return self._busy_ns + REARM_NS

    @property
    def total(self) -> int | None:
        """Readings altogether; None for no end."""
        return None if self.triggers is None else self.triggers * self.samples

    @property
    def end_ns(self) -> int | None:
        """When the last reading is in the memory; None for never."""
        if self.triggers is None:
            return None
        return self.first_ns + (self.triggers - 1) * self.period_ns + self._busy_ns

    @property
    def _busy_ns(self) -> int:
        return self.delay_ns + (self.samples - 1) * self.interval_ns + self.reading_ns

    def finished(self, now_ns: int) -> int:
        """Return how many readings are in the memory at `now_ns`, or were and have been taken out."""
        trigger, since_ns = divmod(now_ns - self.first_ns, self.period_ns)
        if trigger < 0:
            return 0
        ready = (since_ns - self.delay_ns - self.reading_ns) // self.interval_ns + 1
        count = trigger * self.samples + min(max(ready, 0), self.samples)
        return count if self.total is None else min(count, self.total)

    def begin_ns(self, first: int, last: int) -> NDArray[np.int64]:
        """Return when the readings `first` to `last` (exclusive) begin, shape (last - first,)."""
        trigger, sample = np.divmod(np.arange(first, last, dtype=np.int64), self.samples)
        return np.asarray(self.first_ns + trigger * self.period_ns + self.delay_ns + sample * self.interval_ns)
