"""The one thread that speaks to the instrument, and the stream of batches that it makes.

    instrument ──drain──> Ledger ──block──> Ring ──pop──> batches()
                 I/O thread                        the caller's thread

The thread looks at fixed times, takes what is waiting as far as the ring has room, and leaves the rest in the
instrument's memory. A failed link ends the acquisition: everything acquired is delivered, then `batches` raises.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil
from queue import Empty, SimpleQueue
from threading import Event as Flag
from threading import Thread
from types import TracebackType
from typing import Self

from aemd.acquire.clock import DeviceClock
from aemd.acquire.instrument import Clock, Drain, Instrument
from aemd.acquire.ledger import Ledger
from aemd.acquire.ring import Ring
from aemd.block import Batch, Event
from aemd.errors import InstrumentError

__all__ = ["Acquisition", "Counts", "choose_poll_s"]

RING_READINGS = 1 << 17  # 13 s at 10,000 readings/s, 3.7 MB
MOST_AT_ONCE = 1 << 13  # 64 KiB of readings: a backlog comes in pieces, so that its first readings are not late
GOLDEN = 0.618033988749895  # no other fraction of the interval spreads the looks' phases more evenly over it
SHORTEST_POLL_S = 0.010  # a look costs about 0.5 ms of a core
LONGEST_POLL_S = 0.25  # so soon a stop is heard and a failure is seen
EAGER_POLL_S = 0.002
EAGER_LOOKS = 500  # 1 s of them, after a start or a new epoch, until the offset is known
EAGER_BEFORE = 2  # readings before the end of an epoch
WELL_KNOWN_NS = 1_000_000
PATIENCE_S = 5.0
PATIENCE_INTERVALS = 5  # without a reading, however long an interval is
LIVENESS_S = 1.0  # how often the consumer's wait makes sure that there is still somebody to wait for


@dataclass(frozen=True, slots=True)
class Counts:
    """Where the readings are: acquired = delivered + in_flight."""

    acquired: int
    """Taken out of the instrument."""
    delivered: int
    """Given out by `batches`."""
    in_flight: int
    """In the ring."""
    lost: int
    """Overwritten in the instrument before they were taken; the last index + 1 is acquired + lost."""


@dataclass(frozen=True, slots=True)
class _Delivery:
    count: int
    events: tuple[Event, ...]
    received_ns: int


def choose_poll_s(interval_s: float) -> float:
    """Return the time between two looks: a golden section of the interval, or a whole fraction of it if that is long.

    >>> [round(choose_poll_s(interval_s), 4) for interval_s in (1e-4, 0.1, 1.0)]
    [0.01, 0.0618, 0.206]
    """
    section_s = GOLDEN * interval_s
    return max(section_s / ceil(section_s / LONGEST_POLL_S), SHORTEST_POLL_S)


class Acquisition:
    """One run of an instrument: enter the context, iterate `batches`, call `stop` from anywhere.

    Args:
        instrument: opened and configured; stays the caller's to close, after this context.
        most_readings: end after exactly so many; None for until `stop`.
        poll_s: time between two looks; None for a choice from the interval.
        ring_readings: capacity of the ring, a power of two.
        clock: host monotonic time, the same that the instrument was given.
        utc: the wall clock, ns since 1970; asked once.
    """

    def __init__(
        self,
        instrument: Instrument,
        *,
        most_readings: int | None = None,
        poll_s: float | None = None,
        ring_readings: int = RING_READINGS,
        clock: Clock = time.monotonic_ns,
        utc: Clock = time.time_ns,
    ) -> None:
        self._instrument = instrument
        self._most_readings = most_readings
        self._poll_s = choose_poll_s(instrument.interval_s) if poll_s is None else poll_s
        self._clock = clock
        self._ring = Ring(ring_readings)
        self._fit = DeviceClock(instrument.interval_s, instrument.sample_delay_s, instrument.epoch_readings)
        self._offset_ns = utc() - clock()
        self._ledger = Ledger(self._fit, self._offset_ns, instrument.epoch_readings, instrument.memory_readings)
        self._deliveries: SimpleQueue[_Delivery | None] = SimpleQueue()
        self._stops: SimpleQueue[None] = SimpleQueue()  # its put is reentrant, which Event.set is not: see `stop`
        self._abandoned = Flag()
        self._failure: BaseException | None = None
        self._eager_looks = EAGER_LOOKS
        self._turns = 0
        self._epoch = 0
        self._next_look_ns = 0
        self._newest_ns = 0
        self._stopped = False
        self._thread = Thread(target=self._run, name="aemd-acquire", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop, and wait until the instrument is left alone; what is not delivered by now is given up."""
        self._abandoned.set()
        self.stop()
        self._thread.join()

    @property
    def counts(self) -> Counts:
        """Where the readings are now; may be asked by any thread."""
        delivered = self._ring.popped  # before `pushed`, so that none seems to be delivered before it is acquired
        acquired = self._ring.pushed
        return Counts(acquired, delivered, acquired - delivered, self._ledger.lost)

    @property
    def turns(self) -> int:
        """Looks at the instrument so far; while this grows the I/O thread is alive."""
        return self._turns

    def clock_facts(self) -> dict[str, str]:
        """Return what is known of the instrument's clock now, as a recording keeps it."""
        return {
            "stamps": "middle of the aperture, by the instrument's timer held against the host's monotonic clock",
            "utc_minus_monotonic_ns": str(self._offset_ns),
            "uncertainty_s": repr(self._fit.uncertainty_ns * 1e-9),
            "rate": repr(self._fit.rate),
            "rate_uncertainty": repr(self._fit.rate_uncertainty),
            "restarts": str(self._fit.restarts),
        }

    def stop(self) -> None:
        """End sampling; `batches` ends once everything that the instrument holds is delivered.

        May be called by any thread, by a signal handler, and more than once.
        """
        self._stops.put(None)

    def batches(self) -> Iterator[Batch]:
        """Yield what each look brought, in order, until the acquisition ends.

        Raises:
            InstrumentError: the instrument or its link failed; everything acquired before has been yielded.
        """
        while (delivery := self._next_delivery()) is not None:
            yield Batch(self._ring.pop(delivery.count), delivery.events, received_ns=delivery.received_ns)
        if self._failure is not None:
            raise self._failure

    def _next_delivery(self) -> _Delivery | None:
        while True:
            try:
                return self._deliveries.get(timeout=LIVENESS_S)
            except Empty:
                if not self._thread.is_alive() and self._deliveries.empty():
                    return None

    # -- the I/O thread ----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._sample()
        except BaseException as error:  # noqa: BLE001 - it is raised again in the thread that iterates `batches`
            self._failure = error
        finally:
            self._deliveries.put(None)

    def _sample(self) -> None:
        asked_ns = self._clock()
        self._instrument.start()
        self._next_look_ns = self._clock()
        self._ledger.begin(asked_ns, self._next_look_ns)
        left = 0
        self._newest_ns = self._next_look_ns
        while self._missing() and not self._told_to_stop(wait=not (left and self._ring.free)):
            left = self._look()
        asked_ns = self._clock()
        self._instrument.stop()
        self._stopped = True
        self._ledger.end(asked_ns, self._clock())
        left = 1
        while left and self._missing() and not self._abandoned.is_set():
            if self._ring.free:
                left = self._look()
            else:
                self._abandoned.wait(self._poll_s)

    def _missing(self) -> int:
        """Return how many readings are still wanted; as many as the ring holds where there is no end."""
        if self._most_readings is None:
            return self._ring.capacity
        return self._most_readings - self._ring.pushed

    def _told_to_stop(self, *, wait: bool) -> bool:
        """Tell whether `stop` was called, by the time of the next look if there is one to wait for."""
        now_ns = self._clock()
        if wait:
            poll_s = min(self._poll_s, EAGER_POLL_S) if self._is_eager() else self._poll_s
            # From the time that was due, so that the cadence holds; from now, if that has already passed.
            self._next_look_ns = max(now_ns, self._next_look_ns + round(poll_s * 1e9))
        try:
            self._stops.get(timeout=max(0, self._next_look_ns - now_ns) * 1e-9)
        except Empty:
            return False
        return True

    def _is_eager(self) -> bool:
        """Tell whether to look often for a while: a timing epoch is about to begin or has begun and is ill known."""
        epoch_readings, index = self._instrument.epoch_readings, self._ledger.next_index
        epoch = index // epoch_readings if epoch_readings else 0
        if epoch != self._epoch:
            self._epoch, self._eager_looks = epoch, EAGER_LOOKS
        near_its_end = bool(epoch_readings) and epoch_readings - index % epoch_readings <= EAGER_BEFORE
        if self._eager_looks and (near_its_end or self._fit.uncertainty_ns > WELL_KNOWN_NS):
            self._eager_looks -= 1
            return True
        return False

    def _look(self) -> int:
        """Take what is waiting as far as there is room for it; return how many readings are left in the instrument."""
        self._turns += 1
        most = min(self._ring.free, self._missing(), MOST_AT_ONCE)
        drain = self._instrument.drain(most)
        recount = self._instrument.drain(0) if self._ledger.needs_recount(drain) else None
        self._refuse_silence(drain)
        block, events = self._ledger.enter(drain, recount)
        if block.size or events:
            self._ring.push(block)
            self._deliveries.put(_Delivery(block.size, events, drain.received_ns))
        return drain.waiting - block.size

    def _refuse_silence(self, drain: Drain) -> None:
        """Raise where the instrument answers and yet takes no readings, rather than wait for ever."""
        if drain.waiting or self._stopped:
            self._newest_ns = drain.answered_ns
        patience_s = max(PATIENCE_S, PATIENCE_INTERVALS * self._instrument.interval_s)
        if drain.answered_ns - self._newest_ns > patience_s * 1e9:
            raise InstrumentError(
                f"the instrument has taken no reading for {patience_s:.3g} s, at an interval of"
                f" {self._instrument.interval_s:g} s; look at its display, and start again"
            )
