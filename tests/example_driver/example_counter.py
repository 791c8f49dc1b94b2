"""A driver in sixty lines: an "instrument" that counts, at equal intervals, into a memory that never is full.

What aemd wants of a driver is `Options`, a frozen dataclass of what the config's [instrument] may hold besides `driver`
and `resource`, and `open_instrument`. Everything else of it is in `aemd.acquire.instrument.Instrument`; this is all.
Without a method `recover` a failure ends the acquisition; see `aemd.acquire.instrument.Recoverable`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from aemd.acquire.instrument import Clock, Drain
from aemd.errors import InstrumentError


@dataclass(frozen=True, slots=True)
class Options:
    """Settings, with their bounds and units; an unknown key in the config is refused by these."""

    interval_s: float = 0.01
    """Time between readings, s."""


def open_instrument(resource: str, options: Options, clock: Clock) -> "Counter":
    """Open, identify, configure."""
    if not resource.startswith("COUNTER::"):
        raise InstrumentError(f"{resource}: not a counter; the resource must be COUNTER::name")
    return Counter({"manufacturer": "nobody", "model": "counter", "resource": resource}, options.interval_s, clock)


@dataclass
class Counter:
    """The instrument: reading number i is i microvolts."""

    identity: Mapping[str, str]
    interval_s: float
    clock: Clock
    settings: Mapping[str, str] = field(default_factory=dict)
    sample_delay_s: float = 0.0
    epoch_readings: int = 0
    memory_readings: int = 1_000_000
    taken: int = 0
    started_ns: int = 0
    ended_ns: int | None = None

    def start(self) -> None:
        """Begin sampling."""
        self.started_ns, self.taken, self.ended_ns = self.clock(), 0, None

    def drain(self, most: int) -> Drain:
        """Take what is there, oldest first."""
        now_ns = self.clock()
        made = int(((self.ended_ns or now_ns) - self.started_ns) / (self.interval_s * 1e9))
        waiting = made - self.taken
        values_V = 1e-6 * np.arange(self.taken, self.taken + min(most, waiting))
        self.taken += values_V.size
        return Drain(values_V, np.zeros(values_V.size, np.uint32), waiting, now_ns, self.clock(), self.clock())

    def stop(self) -> None:
        """End sampling; what is there stays."""
        self.ended_ns = self.clock()

    def close(self) -> None:
        """Nothing to give back."""
