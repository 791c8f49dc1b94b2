"""The one thread that speaks to the instrument, and the stream of batches that it makes.

    instrument ──> Stream ──block──> Ring ──pop──> batches()
                   I/O thread                      the caller's thread

The thread takes what is waiting as far as the ring has room, and leaves the rest in the instrument's memory. A link
that fails is recovered (`aemd.acquire.stream`) until `give_up_s` are over; then everything acquired is delivered, and
`batches` raises.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from threading import Event as Flag
from threading import Thread
from types import TracebackType
from typing import Self

from aemd.acquire.cadence import choose_poll_s
from aemd.acquire.instrument import Clock, Instrument, host_ns
from aemd.acquire.ring import Ring
from aemd.acquire.stream import Stream
from aemd.block import Batch, Event

__all__ = ["Acquisition", "Counts", "choose_poll_s"]

RING_READINGS = 1 << 17  # 13 s at 10,000 readings/s, 3.7 MB
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
    """Numbered and never taken; the last index + 1 is acquired + lost, unless these are the last."""


@dataclass(frozen=True, slots=True)
class _Delivery:
    count: int
    events: tuple[Event, ...]
    received_ns: int


class Acquisition:
    """One run of an instrument: enter the context, iterate `batches`, call `stop` from anywhere.

    Args:
        instrument: opened and configured; stays the caller's to close, after this context.
        most_readings: end after exactly so many; None for until `stop`.
        poll_s: time between two looks; None for a choice from the interval.
        give_up_s: how long a link may be down before that ends the acquisition; None for without end.
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
        give_up_s: float | None = None,
        ring_readings: int = RING_READINGS,
        clock: Clock = host_ns,
        utc: Clock = time.time_ns,
    ) -> None:
        self._ring = Ring(ring_readings)
        self._deliveries: SimpleQueue[_Delivery | None] = SimpleQueue()
        self._stops: SimpleQueue[None] = SimpleQueue()  # its put is reentrant, which Event.set is not: see `stop`
        self._abandoned = Flag()
        self._failure: BaseException | None = None
        self._stream = Stream(
            instrument,
            wait=self._wait,
            room=lambda: self._ring.free,
            is_abandoned=self._abandoned.is_set,
            most_readings=most_readings,
            poll_s=poll_s,
            give_up_s=give_up_s,
            clock=clock,
            utc=utc,
        )
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
        return Counts(acquired, delivered, acquired - delivered, self._stream.ledger.lost)

    @property
    def turns(self) -> int:
        """Looks at the instrument so far; while this grows the I/O thread is alive."""
        return self._stream.turns

    @property
    def outages(self) -> int:
        """How often the link was lost so far."""
        return self._stream.outages

    def clock_facts(self) -> dict[str, str]:
        """Return what is known of the instrument's clock now, as a recording keeps it."""
        return {
            "stamps": "middle of the aperture, by the instrument's timer held against the host's monotonic clock",
            "utc_minus_monotonic_ns": str(self._stream.utc_offset_ns),
            "uncertainty_s": repr(self._stream.fit.uncertainty_ns * 1e-9),
            "rate": repr(self._stream.fit.rate),
            "rate_uncertainty": repr(self._stream.fit.rate_uncertainty),
            "restarts": str(self._stream.fit.restarts),
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
            for delivery in self._stream.deliveries():
                self._ring.push(delivery.block)
                self._deliveries.put(_Delivery(delivery.block.size, delivery.events, delivery.received_ns))
        except BaseException as error:  # noqa: BLE001 - it is raised again in the thread that iterates `batches`
            self._failure = error
        finally:
            self._deliveries.put(None)

    def _wait(self, seconds: float) -> bool:
        try:
            self._stops.get(timeout=seconds)
        except Empty:
            return False
        return True
