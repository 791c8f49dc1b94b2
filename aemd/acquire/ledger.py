"""The books of one acquisition: each reading's number, instant and status, and what happened to the stream.

A look brings readings and the count of those that were waiting. Normally the numbers simply go on. When the instrument
says that it overwrote readings it does not say how many; the clock does: so many must have been finished by now, so
many are here, the difference is lost. The count is taken once more after some were taken out, because a memory that
is full may lose readings between its count and the taking; one with room does not.

After a lost link three more things are told: how many readings were torn on the wire (`tear`, exact); that sampling
has stopped, so that counts say nothing of the clock (`end`, `go_on`); and that it began anew (`restart`), in a new run
whose first number leaves room for what the old one would have made meanwhile, as the clock counts it.
"""

import numpy as np

from aemd.acquire.clock import DeviceClock
from aemd.acquire.instrument import Drain
from aemd.block import READING, Block, Event, Status

__all__ = ["Ledger"]

NEARLY_FULL = 0.99  # of the memory; 50 ms at 10,000 readings/s and 50,000 of memory, longer than a look takes
CLOCK_FIRST_NS = 1_000_000_000  # the start-up's fast looks are over by then
CLOCK_EVERY_NS = 600_000_000_000  # often enough to see the rate follow the room's temperature
SLACK_READINGS = 2  # by which a count may differ from the clock's
SLACK_RATE = 1e-3  # and this fraction of those since the last look: beyond it no clock is wrong
SPELLS = {
    "overload": (
        int(Status.OVERLOAD_HIGH | Status.OVERLOAD_LOW), "input beyond the range", "input within the range again",
    ),
    "invalid": (int(Status.INVALID), "readings that are not a number", "readings are numbers again"),
}  # fmt: skip


class Ledger:
    """Turns looks into blocks and events. Instants go in as host monotonic ns and come out as UTC.

    Args:
        clock: the fit, told of every look.
        utc_offset_ns: UTC minus host monotonic, taken once, so that setting the host's clock moves nothing.
        epoch_readings: readings after which the instrument starts its timer anew; 0 for never.
        memory_readings: readings that the instrument's memory holds.
    """

    def __init__(self, clock: DeviceClock, utc_offset_ns: int, epoch_readings: int, memory_readings: int) -> None:
        self.next_index = 0
        self.lost = 0
        self.run_index = 0
        """Number of the first reading since sampling began, or began anew."""
        self._clock = clock
        self._utc_offset_ns = utc_offset_ns
        self._epoch_readings = epoch_readings
        self._memory_readings = memory_readings
        self._overflowed = False
        self._late = False
        self._without_value = dict.fromkeys(SPELLS, False)
        self._ended: tuple[int, int] | None = None
        self._looked_ns = 0
        self._counted = 0
        self._gap_is_before = False
        self._restarts = 0
        self._clock_event_due_ns = 0

    def begin(self, asked_ns: int, answered_ns: int) -> None:
        """Sampling began between the two instants, with nothing finished."""
        self._clock.observe(0, asked_ns, answered_ns)
        self._looked_ns = answered_ns
        self._clock_event_due_ns = answered_ns + CLOCK_FIRST_NS

    def end(self, asked_ns: int, answered_ns: int) -> None:
        """Sampling ended between the two instants; looks from now on say nothing about the clock."""
        self._ended = asked_ns, answered_ns

    def go_on(self) -> None:
        """Sampling had not ended after all."""
        self._ended = None

    def tear(self, count: int, why: str) -> tuple[Event, ...]:
        """Note that exactly `count` readings left the instrument and never came; it holds only later ones."""
        return self._lose(count, f"{count} readings lost: {why}")

    def restart(self, asked_ns: int, answered_ns: int, why: str) -> tuple[Event, ...]:
        """Sampling began anew between the two instants; whatever would have been made since the last one is missing."""
        events = self.miss(asked_ns, answered_ns, why)
        self._clock.restart(self.next_index, asked_ns, answered_ns)
        self._clock_event_due_ns = answered_ns + CLOCK_FIRST_NS
        self.run_index = self.next_index
        self._ended = None
        self._overflowed = self._late = False
        self._counted, self._looked_ns = self.next_index, answered_ns
        return events

    def miss(self, asked_ns: int, answered_ns: int, why: str) -> tuple[Event, ...]:
        """Count as lost whatever would have been finished by now, at the interval that was."""
        least, largest = self._clock.finished(asked_ns, answered_ns)
        missed = (least + largest) // 2 - self.next_index
        doubt = (largest - least + 1) // 2 + 1
        if self._epoch_readings and missed > 0:
            doubt += missed // self._epoch_readings
        return self._lose(missed, f"about {missed} readings missed, give or take {doubt}: {why}")

    def is_short(self, asked_ns: int, answered_ns: int) -> bool:
        """Tell whether readings are missing once all that was left was taken: nobody says so but the clock.

        Args:
            asked_ns: until when it was to sample, at least.
            answered_ns: when it had ended.
        """
        if not np.isfinite(self._clock.uncertainty_ns):
            return False
        least, largest = self._clock.finished(asked_ns, answered_ns)
        return self.next_index < least - self._slack(asked_ns) and least <= largest

    def needs_recount(self, drain: Drain) -> bool:
        """Tell whether `enter` wants another look, one that takes nothing, before it numbers these readings."""
        full = drain.waiting >= NEARLY_FULL * self._memory_readings
        return drain.values_V.size > 0 and (drain.overflowed or self._overflowed or full)

    def enter(self, drain: Drain, recount: Drain | None = None) -> tuple[Block, tuple[Event, ...]]:
        """Number, stamp and flag the readings of one look.

        Args:
            drain: the look.
            recount: the look after it, where `needs_recount` says so.
        """
        looks = (drain,) if recount is None else (drain, recount)
        self._overflowed |= any(look.overflowed for look in looks)
        self._late |= any(look.late for look in looks)
        count = drain.values_V.size
        still_waiting = looks[-1].waiting - (count if recount is None else 0)
        lost, doubt, cause = 0, 0, "the instrument's memory was full and overwrote them"
        if self._overflowed and count:
            lost, doubt = self._count_lost(count + still_waiting, looks[-1])
        elif count and self._ended is None and np.isfinite(self._clock.uncertainty_ns):
            lost, doubt = self._count_vanished(count + still_waiting, looks[-1])
            cause = "they were in the instrument's memory and are gone; did another program read or clear it?"
        first_index = self.next_index + lost
        counted = first_index + count + still_waiting
        too_low = self._ended is not None or (self._overflowed and not count) or self._stands_still(counted, looks[-1])
        if not too_low:
            self._clock.observe(counted, looks[-1].asked_ns, looks[-1].answered_ns)
            self._counted, self._looked_ns = counted, looks[-1].answered_ns

        block = np.empty(count, dtype=READING)
        block["index"] = np.arange(first_index, first_index + count)
        block["t_ns"] = self._clock.stamp(first_index, count) + self._utc_offset_ns
        block["value_V"] = drain.values_V
        block["status"] = drain.status
        events = [Event(self._utc(drain.received_ns), "instrument", text) for look in looks for text in look.messages]
        if count:
            events += (
                self._gap(block, lost, doubt, cause) + self._timing(block) + self._spells(block) + self._epoch(block)
            )
            self.next_index = first_index + count
            self.lost += lost
            self._overflowed = False
        events += self._clock_news(drain.received_ns)
        return block, tuple(events)

    def _count_lost(self, here: int, look: Drain) -> tuple[int, int]:
        """Return how many readings are missing before those that are here, by the clock, and by how many it may err."""
        asked_ns, answered_ns = self._ended or (look.asked_ns, look.answered_ns)
        least, largest = self._clock.finished(asked_ns, answered_ns)
        finished = (least + largest) // 2
        doubt = (largest - least + 1) // 2
        if self._epoch_readings:  # each new epoch within the gap began an unknown fraction of an interval off
            since, since_next = finished - self.run_index, self.next_index - self.run_index
            doubt += since // self._epoch_readings - since_next // self._epoch_readings
        self._clock.doubt(doubt)
        return max(1, finished - self.next_index - here), doubt

    def _stands_still(self, counted: int, look: Drain) -> bool:
        """Tell whether no reading came though one must have: sampling has stopped, which says nothing of a clock."""
        return counted == self._counted and counted < self._clock.finished(look.asked_ns, look.answered_ns)[0]

    def _count_vanished(self, here: int, look: Drain) -> tuple[int, int]:
        """Return how many readings are missing though nobody said so, and by how many that may err."""
        least, largest = self._clock.finished(look.asked_ns, look.answered_ns)
        counted = self.next_index + here
        slack = self._slack(look.answered_ns)
        if counted > largest + slack:  # the host's monotonic clock stood still: it was suspended
            self._clock.forget_offset()
        if counted >= least - slack or least > largest:
            return 0, 0
        doubt = (largest - least + 1) // 2
        self._clock.doubt(doubt)
        return (least + largest) // 2 - counted, doubt

    def _slack(self, now_ns: int) -> float:
        """Return by how many readings a count may differ from the clock's before readings have vanished."""
        return SLACK_READINGS + SLACK_RATE * (now_ns - self._looked_ns) / self._clock.interval_ns

    def _lose(self, count: int, message: str) -> tuple[Event, ...]:
        if count <= 0:
            return ()
        first = self.next_index
        self.next_index += count
        self.lost += count
        self._gap_is_before = True
        return (Event(self._utc(self._clock.instant(first)), "gap", message, first, first + count - 1),)

    def _gap(self, block: Block, lost: int, doubt: int, cause: str) -> list[Event]:
        if lost or self._gap_is_before:
            block["status"][0] |= np.uint32(Status.GAP)
            self._gap_is_before = False
        if not lost:
            return []
        first, last = self.next_index, self.next_index + lost - 1
        back_ns = round((block["index"][0] - first) * self._clock.interval_ns)
        within = f", give or take {doubt}" if doubt else ""
        message = f"{lost} readings lost{within}: {cause}"
        return [Event(int(block["t_ns"][0]) - back_ns, "gap", message, first, last)]

    def _timing(self, block: Block) -> list[Event]:
        if not self._late:
            return []
        self._late = False
        block["status"] |= np.uint32(Status.TIMING)
        return [Event(int(block["t_ns"][0]), "timing", "the instrument could not keep its interval near here")]

    def _spells(self, block: Block) -> list[Event]:
        """Tell of the begin and the end of readings without a value; several spells within one block count as one."""
        events = []
        for kind, (bits, begin, end) in SPELLS.items():
            there = np.flatnonzero(block["status"] & bits)
            if there.size and not self._without_value[kind]:
                events.append(Event(int(block["t_ns"][there[0]]), kind, begin))
            if there.size or self._without_value[kind]:
                after = there[-1] + 1 if there.size else 0
                self._without_value[kind] = after == block.size
                if not self._without_value[kind]:
                    events.append(Event(int(block["t_ns"][after]), kind, end))
        return events

    def _epoch(self, block: Block) -> list[Event]:
        if not self._epoch_readings:
            return []
        since = block["index"] - self.run_index
        starts = np.flatnonzero((since % self._epoch_readings == 0) & (block["index"] > 0))
        return [Event(int(block["t_ns"][at]), "epoch", "the instrument started its timer anew") for at in starts]

    def _clock_news(self, now_ns: int) -> list[Event]:
        clock = self._clock
        if clock.restarts > self._restarts:
            self._restarts = clock.restarts
            self._clock_event_due_ns = now_ns + CLOCK_FIRST_NS
            message = "the instrument's clock and the host's ran apart faster than thought; fitted anew"
            return [Event(self._utc(now_ns), "clock", message)]
        if now_ns < self._clock_event_due_ns or not np.isfinite(clock.uncertainty_ns):
            return []
        self._clock_event_due_ns = now_ns + CLOCK_EVERY_NS
        message = (
            f"stamps within {clock.uncertainty_ns * 1e-6:.3f} ms;"
            f" rate {clock.rate * 1e6:+.2f} ppm within {clock.rate_uncertainty * 1e6:.2f} ppm"
        )
        return [Event(self._utc(now_ns), "clock", message)]

    def _utc(self, t_ns: int) -> int:
        return t_ns + self._utc_offset_ns
