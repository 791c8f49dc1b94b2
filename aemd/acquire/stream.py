"""What the thread at the instrument does, as a generator: look, take, stamp; and come back when the link is lost.

    start ─> look ─> look ─> ... ─> stop ─> take the rest
               │ InstrumentError
               └> recover, with pauses that double ─> what was torn is a gap
                    still sampling:  go on; the readings made meanwhile wait in the instrument's memory
                    sampling no more: take what is left FIRST, then start anew (which clears the memory); the
                                      readings that would have been made meanwhile are a gap, counted by the clock

The ladder itself (drain, clear, resynchronise, reopen) is the driver's, because what a link needs depends on the link
and on the instrument's language. What is done with the readings, the time and the patience is here, alike for all.

There is no thread and no clock of its own here: who waits moves the time, so a day passes as fast as it is computed.
"""

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass

import numpy as np

from aemd.acquire.cadence import Cadence
from aemd.acquire.clock import DeviceClock
from aemd.acquire.instrument import BusyError, Clock, Drain, Instrument, Recoverable
from aemd.acquire.ledger import Ledger
from aemd.acquire.wall_clock import WallClock
from aemd.block import READING, Block, Event
from aemd.errors import InstrumentError

__all__ = ["Delivery", "Stream"]

MOST_AT_ONCE = 1 << 13  # 64 KiB of readings: a backlog comes in pieces, so that its first readings are not late
PATIENCE_S = 5.0
PATIENCE_INTERVALS = 5  # without a reading, however long an interval is
FRESH_STARTS = 3  # of an instrument that answers and takes no readings, in a row
SHORTEST_PAUSE_S = 0.05  # after the second attempt to recover, doubled with each
LONGEST_PAUSE_S = 5.0  # an instrument that is back is found within this
GROWTH_INTERVALS = 2.5  # a reading comes within these, if it comes
LONGEST_GROWTH_S = 2.0
LAST_ATTEMPTS = 4  # to recover a link that is lost at the stop: one for each rung, and one
LAST_NS = 10_000_000_000  # after it no attempt begins: whoever told it to stop waits
STOPPED = "the instrument had stopped"
SETTINGS_LOST = "the instrument had lost its settings"
TAKEN_OVER = "another program had taken the instrument over"
TORN = "they left the instrument's memory and never arrived whole"


@dataclass(frozen=True, slots=True)
class Delivery:
    """What one look brought."""

    block: Block
    events: tuple[Event, ...]
    received_ns: int


class _SilentError(InstrumentError):
    """The instrument answers and takes no readings."""


class Stream:
    """One run of an instrument; iterate `deliveries` once.

    Args:
        instrument: opened and configured.
        wait: wait so many seconds (0 for not at all) or until told to stop; tells whether that was.
        room: how many readings may be delivered now.
        is_abandoned: whether nobody will ever take more than `room`.
        most_readings: end after exactly so many; None for until told to stop.
        poll_s: time between two looks; None for a choice from the interval.
        give_up_s: how long to try to recover before the failure is raised; None for without end.
        clock: host monotonic time, the same that the instrument was given.
        utc: the wall clock, ns since 1970. Its offset is taken once; when it is set later, that is an event and moves
            no stamp.
    """

    def __init__(
        self,
        instrument: Instrument,
        *,
        wait: Callable[[float], bool],
        room: Callable[[], int],
        is_abandoned: Callable[[], bool] = lambda: False,
        most_readings: int | None = None,
        poll_s: float | None = None,
        give_up_s: float | None = None,
        clock: Clock,
        utc: Clock,
    ) -> None:
        self.turns = 0
        """Looks and attempts so far; while this grows the instrument is attended to."""
        self.outages = 0
        """How often the link was lost."""
        self._wall_clock = WallClock(clock, utc)
        self.utc_offset_ns = self._wall_clock.offset_ns
        """UTC minus host monotonic, taken once."""
        self.fit = DeviceClock(instrument.interval_s, instrument.sample_delay_s, instrument.epoch_readings)
        self.ledger = Ledger(self.fit, self.utc_offset_ns, instrument.epoch_readings, instrument.memory_readings)
        self._instrument = instrument
        self._wait = wait
        self._room = room
        self._is_abandoned = is_abandoned
        self._most_readings = most_readings
        self._cadence = Cadence(self.fit, instrument.interval_s, instrument.epoch_readings, poll_s)
        self._give_up_s = give_up_s
        self._clock = clock
        self._taken = 0
        self._left = 0
        self._next_look_ns = 0
        self._newest_ns = 0
        self._fresh_starts = 0
        self._half_started = False
        self._told_to_stop = False
        self._sampling = False
        self._is_lost = False
        self._lost_ns = 0
        self._last_attempts = LAST_ATTEMPTS
        self._told_of: set[type[InstrumentError]] = set()
        self._is_probing = False

    def deliveries(self) -> Iterator[Delivery]:
        """Yield what each look brought, in order, until told to stop or all is there.

        Raises:
            InstrumentError: the instrument does not start, or has no way back after a failure, or did not come back in
                time; everything taken before has been yielded.
        """
        asked_ns = self._clock()
        self._instrument.start()
        self._begun()
        self.ledger.begin(asked_ns, self._next_look_ns)
        while self._missing() and not self._pause():
            try:
                delivery = self._look()
            except InstrumentError as error:
                yield from self._come_back(error)
                continue
            if delivery is not None:
                yield delivery
        yield from self._end()

    def _begun(self) -> None:
        self._sampling = True
        self._next_look_ns = self._newest_ns = self._clock()
        self._cadence.begin()

    def _missing(self) -> int:
        """Return how many readings are still wanted; as many as there is room for where there is no end."""
        return self._room() + 1 if self._most_readings is None else self._most_readings - self._taken

    # -- looking -----------------------------------------------------------------------------------------------------

    def _pause(self) -> bool:
        """Wait until the time of the next look, if there is one to wait for; tell whether to stop."""
        if self._told_to_stop:
            return True
        now_ns = self._clock()
        if not (self._left and self._room()):
            self._next_look_ns = self._cadence.next_look_ns(now_ns, self._next_look_ns, self.ledger)
        self._told_to_stop = self._wait(max(0, self._next_look_ns - now_ns) * 1e-9)
        return self._told_to_stop

    def _look(self) -> Delivery | None:
        """Take what is waiting as far as there is room for it."""
        self.turns += 1
        began_ns = self._clock()
        # After a failure a single reading is risked first: a line that tears one block may tear the next.
        most = min(self._room(), self._missing(), 1 if self._is_probing else MOST_AT_ONCE)
        drain = self._instrument.drain(most)
        self._cadence.note_lag((drain.asked_ns + drain.answered_ns) // 2 - began_ns)
        recount = self._recount(drain)
        block, events = self.ledger.enter(drain, recount)
        self._left = drain.waiting - block.size
        self._is_probing = self._is_probing and not block.size
        self._taken += block.size
        if drain.waiting or not self._sampling:
            self._newest_ns = drain.answered_ns
            self._fresh_starts = 0 if block.size else self._fresh_starts
        self._refuse_silence(drain)
        events += tuple(self._event("clock", message) for message in self._wall_clock.news(drain.received_ns))
        return Delivery(block, events, drain.received_ns) if block.size or events else None

    def _recount(self, drain: Drain) -> Drain | None:
        if not self.ledger.needs_recount(drain):
            return None
        try:
            return self._instrument.drain(0)
        except InstrumentError:  # what was taken must be entered all the same; the next look finds the link as it is
            return None

    def _refuse_silence(self, drain: Drain) -> None:
        """Raise where the instrument answers and yet takes no readings, rather than wait for ever."""
        patience_s = max(PATIENCE_S, PATIENCE_INTERVALS * self._instrument.interval_s)
        # Not until the answer, between which and its question this process may have been put to sleep.
        if drain.asked_ns - self._newest_ns > patience_s * 1e9:
            raise _SilentError(
                f"the instrument has taken no reading for {patience_s:.3g} s, at an interval of"
                f" {self._instrument.interval_s:g} s; look at its display"
            )

    # -- coming back -------------------------------------------------------------------------------------------------

    def _come_back(self, error: InstrumentError) -> Iterator[Delivery]:
        """Recover from a failure; give up only when told to.

        Raises:
            InstrumentError: there is no way back, or the time for it is over.
        """
        instrument = self._instrument
        is_silent = isinstance(error, _SilentError)
        self._fresh_starts += is_silent
        if not isinstance(instrument, Recoverable) or self._fresh_starts > FRESH_STARTS:
            raise error
        self.outages += 1
        self._is_probing = True
        began_ns = self._clock()
        self._told_of = {InstrumentError, type(error)}
        yield self._told("link", f"{'silent' if is_silent else 'lost'}: {error}")
        pause_s = 0.0
        while not (self._told_to_stop or self._wait(pause_s)):
            self.turns += 1
            self._last_attempts = max(1, self._last_attempts - 1)  # what was long lost is looked for once
            try:
                yield from self._resume(instrument, began_ns, afresh=is_silent, was_busy=BusyError in self._told_of)
            except InstrumentError as latest:
                if type(latest) not in self._told_of:  # another instrument, another program: somebody must see to it
                    self._told_of.add(type(latest))
                    yield self._told("link", f"lost: {latest}")
                error = latest
            else:
                self._told_of, self._last_attempts = set(), LAST_ATTEMPTS
                return
            away_s = (self._clock() - began_ns) * 1e-9
            if self._give_up_s is not None and away_s > self._give_up_s:
                yield from self._miss("the link was down")
                raise InstrumentError(f"{error}; gave up after {away_s:.3g} s without it")
            pause_s = min(max(2 * pause_s, SHORTEST_PAUSE_S), LONGEST_PAUSE_S)
        self._told_to_stop, self._is_lost, self._lost_ns = True, True, began_ns

    def _resume(self, instrument: Recoverable, began_ns: int, *, afresh: bool, was_busy: bool) -> Iterator[Delivery]:
        """Make one attempt to go on where the link was lost.

        Raises:
            InstrumentError: it failed; nothing is lost by it that was not.
        """
        asked_ns = self._clock()
        recovery = instrument.recover(afresh=afresh)
        torn = self.ledger.tear(recovery.torn, TORN)
        if torn:
            yield self._delivery(torn)
        why = SETTINGS_LOST
        if was_busy:
            why = TAKEN_OVER
        elif afresh or recovery.settings_kept:
            why = STOPPED
        is_going = recovery.sampling
        if not is_going and not self._half_started:
            self._sampling = False
            self.ledger.end(asked_ns, self._clock())
            if recovery.settings_kept:
                yield from self._take_rest()
                is_going = yield from self._grows()
        if is_going and not self._half_started:
            self._sampling = True
            self.ledger.go_on()
            self._next_look_ns = self._newest_ns = self._clock()
            yield from self._back(began_ns, recovery.how)
            return
        if self._missing() <= 0 or self._told_to_stop:
            return
        asked_ns = self._clock()
        self._half_started = True  # from here on the memory is, or may be, the new run's
        self._instrument.start()
        self._half_started = False
        missed = self.ledger.restart(asked_ns, self._clock(), why)
        self._begun()
        yield self._delivery(missed)
        yield from self._back(began_ns, f"{recovery.how}; sampling anew, because {why}")

    def _grows(self) -> Generator[Delivery, None, bool]:
        """Tell whether readings come in, whatever the instrument says of its state."""
        before = self._taken + self._left
        self._told_to_stop |= self._wait(min(GROWTH_INTERVALS * self._instrument.interval_s, LONGEST_GROWTH_S))
        yield from self._take_rest()
        return self._taken + self._left > before

    def _back(self, began_ns: int, how: str) -> Iterator[Delivery]:
        """Look; only an instrument that can be looked at is back."""
        delivery = self._look()
        yield self._told("link", f"back after {(self._clock() - began_ns) * 1e-9:.3f} s: {how}")
        if delivery is not None:
            yield delivery

    # -- the end -----------------------------------------------------------------------------------------------------

    def _end(self) -> Iterator[Delivery]:
        """Stop the instrument and take what it holds; with a link that stays lost, count what is missing."""
        instrument, asked_ns = self._instrument, self._clock()
        until_ns = asked_ns + LAST_NS
        why = "told to stop while the link was down" if self._is_lost else "the link went down during the stop"
        left = 0 if self._half_started else self._last_attempts  # what is in the memory may be either run's
        while left > 0 and self._clock() < until_ns:
            self.turns += 1
            try:
                if self._is_lost and isinstance(instrument, Recoverable):
                    left -= 1
                    sampled_ns = yield from self._find_again(instrument, asked_ns)
                    if sampled_ns is None:
                        return
                    asked_ns = sampled_ns
                yield from self._stop(asked_ns)
            except InstrumentError as error:
                if not isinstance(instrument, Recoverable):
                    raise
                self._is_probing = True
                if not self._is_lost:
                    self._is_lost, self._lost_ns = True, self._clock()
                    until_ns = self._lost_ns + LAST_NS
                if type(error) not in self._told_of:
                    self._told_of.add(type(error))
                    yield self._told("link", f"lost: {error}")
                if isinstance(error, BusyError):
                    why = TAKEN_OVER
                    break
            else:
                return
        yield from self._miss(why)

    def _find_again(self, instrument: Recoverable, asked_ns: int) -> Generator[Delivery, None, int | None]:
        """Make one attempt to reach a lost instrument that is to be stopped.

        Returns:
            Until when it sampled, at least, if it did until it was told to stop; None if nothing it holds is ours.

        Raises:
            InstrumentError: it failed.
        """
        began_ns = self._clock()
        recovery = instrument.recover()
        torn = self.ledger.tear(recovery.torn, TORN)
        if torn:
            yield self._delivery(torn)
        if not recovery.settings_kept:
            why = TAKEN_OVER if BusyError in self._told_of else SETTINGS_LOST
            yield from self._miss(why, asked_ns)
            return None
        self._sampling = recovery.sampling
        if recovery.sampling:
            asked_ns, self._newest_ns = began_ns, self._clock()
            self.ledger.go_on()  # the look that follows tells how its clock has run since
        else:
            self.ledger.end(asked_ns, self._clock())
        yield from self._back(self._lost_ns, recovery.how)
        self._is_lost = False
        self._told_of.clear()
        return asked_ns

    def _stop(self, asked_ns: int) -> Iterator[Delivery]:
        """Stop the instrument, which was to sample until `asked_ns` at least, and take what it holds.

        An instrument that had stopped by itself a moment ago, or had been cleared, obeys as one that had not: that it
        holds fewer readings than it must have made is all there is to see.
        """
        self._instrument.stop()
        self._sampling = False
        ended_ns = self._clock()
        self.ledger.end(asked_ns, ended_ns)
        yield from self._take_rest()
        if not self._left and self._missing() > 0 and self.ledger.is_short(asked_ns, ended_ns):
            yield self._delivery(self.ledger.miss(asked_ns, ended_ns, STOPPED))

    def _take_rest(self) -> Iterator[Delivery]:
        """Take what is in the memory of an instrument that has stopped."""
        self._left = 1
        while self._left and self._missing() > 0:
            if self._room():
                delivery = self._look()
                if delivery is not None:
                    yield delivery
            elif self._is_abandoned():
                return
            else:
                self._told_to_stop |= self._wait(self._cadence.poll_s)

    def _miss(self, why: str, since_ns: int | None = None) -> Iterator[Delivery]:
        if self._missing() > 0:
            now_ns = self._clock()
            yield self._delivery(self.ledger.miss(now_ns if since_ns is None else since_ns, now_ns, why))

    # ----------------------------------------------------------------------------------------------------------------

    def _told(self, kind: str, message: str) -> Delivery:
        return self._delivery((self._event(kind, message),))

    def _event(self, kind: str, message: str) -> Event:
        return Event(self._clock() + self.utc_offset_ns, kind, message)

    def _delivery(self, events: tuple[Event, ...]) -> Delivery:
        return Delivery(np.empty(0, READING), events, self._clock())
