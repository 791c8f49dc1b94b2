"""Clocks: the meter's own, which is off and drifts, and one that moves only when told, for a day in seconds."""

from dataclasses import dataclass
from math import pi
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

__all__ = ["DeviceClock", "SteppedClock"]

_DAY_NS = 86_400 * 10**9

Instants = TypeVar("Instants", float, NDArray[np.float64])
"""One or many; of one, Python's own number is asked for ten times faster than an array without dimensions."""


class SteppedClock:
    """Host monotonic time, ns, that stands still until somebody waits."""

    def __init__(self, now_ns: int = 1_000_000_000_000) -> None:
        self.now_ns = now_ns

    def __call__(self) -> int:
        """Return the time, ns; a `Clock`."""
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        """Move on; in the place of `time.sleep`."""
        self.now_ns += max(0, round(seconds * 1e9))

    def sleep_until(self, instant_ns: int) -> None:
        """Move on to an instant; one that is over changes nothing."""
        self.now_ns = max(self.now_ns, instant_ns)


@dataclass(frozen=True, slots=True)
class DeviceClock:
    """The meter's clock x(t) against the host's t, both from power on.

        x(t) = t + e t + d t^2 / 2 + w P / 2 pi (1 - cos(2 pi t / P))

    with the constant error e, the drift d and a wander w of period P, as a room that warms and cools by day makes it.
    The rates are parts per million and small, so x rises everywhere.
    """

    error_ppm: float = 0.0
    """e: how much it runs fast."""
    drift_ppm_per_day: float = 0.0
    """d."""
    wander_ppm: float = 0.0
    """w: amplitude of its rate."""
    wander_period_s: float = 86_400.0
    """P."""

    def meter_ns(self, host_ns: int) -> int:
        """Return what the meter's clock shows, ns, so long after power on, ns."""
        return host_ns + round(float(self._ahead_ns(float(host_ns))))

    def host_ns(self, meter_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return when the meter's clock shows this, ns after power on, to 1 ns; any shape.

        By t = x - (x(t) - t) iterated: an error shrinks by the clock's rate error, 1e-3 at most, in each step.
        """
        host_ns = meter_ns.astype(np.float64)
        ahead_ns = self._ahead_ns(host_ns)
        for _ in range(5):
            ahead_ns = self._ahead_ns(meter_ns - ahead_ns)
        return np.asarray(meter_ns - np.rint(ahead_ns).astype(np.int64))

    def _ahead_ns(self, host_ns: Instants) -> Instants:
        ahead_ns = host_ns * 1e-6 * (self.error_ppm + 0.5 * self.drift_ppm_per_day * host_ns / _DAY_NS)
        if self.wander_ppm:
            turns_per_ns = 2 * pi / (self.wander_period_s * 1e9)
            ahead_ns = ahead_ns + self.wander_ppm * 1e-6 / turns_per_ns * (1 - np.cos(turns_per_ns * host_ns))
        return ahead_ns
