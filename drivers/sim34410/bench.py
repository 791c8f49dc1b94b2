"""The meter on its bench: the lines that lead to it, and the faults that come in time.

Every front end (socket, VXI-11, USB, serial, and the line without a socket) opens its lines here, so a fault is the
same on all of them. A `Line` takes bytes and holds the replies that are due; it knows no socket and no thread.

Time is the clock's. What was due while nobody looked is made up for in its order, each at its own instant.
"""

import heapq
import logging
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from threading import RLock
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim34410.faults import LINKS, READINGS, Fault, Message, ReadingFaults, Spoiler
from sim34410.meter import Meter
from sim34410.session import Session

__all__ = ["Bench", "Line", "Link"]

_LOG = logging.getLogger(__name__)

Link = Literal["socket", "vxi11", "usb", "serial"]

CLEARS_AFTER_NS = 2_000_000_000
"""From the end of the last VXI-11 link until the meter clears itself: 2 s, as measured on the kin 34461A by the author
of Bench Buddy (its README), who found that a raw socket's end leaves the meter sampling. Not verified on a 34410A. A
link that is opened before that keeps the meter as it is: a choice."""

UNTERMINATED, INTERRUPTED = -420, -410


class Bench:
    """One meter, its lines and its faults. All that touches them holds `lock`, where there are several threads."""

    def __init__(
        self,
        meter: Meter,
        clock: Callable[[], int],
        faults: Iterable[Fault] = (),
        *,
        vxi11_clears: bool = True,
    ) -> None:
        """Take a meter that has just been made, on the same clock; faults count from now.

        Args:
            meter: the meter.
            clock: host monotonic time, ns.
            faults: what will go wrong.
            vxi11_clears: whether the end of the last VXI-11 link stops the sampling and clears the memory.
        """
        self.meter = meter
        self.clock = clock
        self.lock = RLock()
        self.hang_ups = 0
        """How often every connection was ended."""
        self._vxi11_clears = vxi11_clears
        self._lines: set[Line] = set()
        self._spoiler = Spoiler()
        self._links_down: list[Fault] = []
        self._due: list[tuple[int, int, Callable[[int], None]]] = []
        self._scheduled = 0
        self._instant_ns: int | None = None
        self._on_ns = clock()
        self.add(faults)

    def add(self, faults: Iterable[Fault]) -> None:
        """Have more go wrong; those of readings replace the ones given before."""
        faults = tuple(faults)
        if any(fault.kind in READINGS for fault in faults):
            self.meter.disturb = ReadingFaults(faults, self._on_ns).disturb
        for fault in faults:
            if fault.kind not in READINGS:
                self._at(self._on_ns + round(fault.at_s * 1e9), partial(self._begin, fault))

    @property
    def truth(self) -> NDArray[np.void]:
        """Array of TRUTH (n,) of the last readings and of what became of them; may be asked while it is served."""
        with self.lock:
            self.advance()
            return self.meter.truth

    @property
    def is_plugged(self) -> bool:
        """Whether the cable is in and the meter has booted."""
        self.advance()
        return not any(fault.kind != "refuse" for fault in self._links_down)

    @property
    def is_open(self) -> bool:
        """Whether a new link would be taken."""
        self.advance()
        return not self._links_down

    @property
    def wake_ns(self) -> int | None:
        """Host instant of the next event of the schedule; None for none."""
        return self._due[0][0] if self._due else None

    def open_line(self, link: Link) -> "Line":
        """Return a new line to the meter.

        Raises:
            ConnectionRefusedError: it takes none at the moment.
        """
        if not self.is_open:
            raise ConnectionRefusedError("the meter takes no connection")
        line = Line(self, link)
        self._lines.add(line)
        return line

    def advance(self) -> None:
        """Let happen what is due by now, and make the readings that are finished."""
        now_ns = self.clock()
        while self._due and self._due[0][0] <= now_ns:
            instant_ns, _, action = heapq.heappop(self._due)
            self._instant_ns = instant_ns
            with self.meter.at(instant_ns):
                self.meter.advance()
                action(instant_ns)
        self._instant_ns = None
        self.meter.advance()

    def hear(self) -> bool:
        """Return whether what arrives now is heard."""
        return not self._spoiler.is_deaf(self.clock())

    def spoil(self, reply: bytes) -> Message | None:
        """Return what becomes of a reply; None when it is lost."""
        return self._spoiler.spoil(reply, self.clock())

    def forget(self, line: "Line", *, noticed: bool = True) -> None:
        """Take a line out; `noticed` tells whether the meter knows that it has ended."""
        self._lines.discard(line)
        if noticed and line.link == "vxi11" and self._vxi11_clears and not self._has_vxi11():
            now_ns = self.clock() if self._instant_ns is None else self._instant_ns
            self._at(now_ns + CLEARS_AFTER_NS, lambda _: None if self._has_vxi11() else self._clear())

    # -- what goes wrong ---------------------------------------------------------------------------------------------

    def _begin(self, fault: Fault, now_ns: int) -> None:
        _LOG.info("fault kind=%s at=%.3f lasts=%.3f", fault.kind, fault.at_s, fault.lasts_s)
        end_ns = now_ns + round(fault.lasts_s * 1e9)
        if fault.kind in LINKS:
            self._links_down.append(fault)
            self._at(end_ns, lambda _: self._links_down.remove(fault))
            if fault.kind != "refuse":
                self._hang_up(noticed=False)
            if fault.kind == "power":
                self.meter.switch_off_and_on()
        elif fault.kind == "close":
            self._hang_up(noticed=True)
        elif fault.kind == "clear":
            self._clear()
        elif fault.kind == "errors":
            for number in range(fault.count):
                self._at(now_ns + number * (end_ns - now_ns) // fault.count, lambda _: self.meter.report(-113))
        else:
            self._spoiler.arm(fault, end_ns)

    def _hang_up(self, *, noticed: bool) -> None:
        self.hang_ups += 1
        for line in list(self._lines):
            line.hang_up(noticed=noticed)

    def _clear(self) -> None:
        self.meter.clear_device()
        self.meter.memory.clear()

    def _has_vxi11(self) -> bool:
        return any(line.link == "vxi11" for line in self._lines)

    def _at(self, instant_ns: int, action: Callable[[int], None]) -> None:
        self._scheduled += 1  # among equal instants, first come, first served
        heapq.heappush(self._due, (instant_ns, self._scheduled, action))


class Line:
    """One client's line: bytes in, replies out when they are due."""

    def __init__(self, bench: Bench, link: Link) -> None:
        """Use `Bench.open_line`."""
        self.link = link
        self.is_closed = False
        """The meter has hung up, or the client has gone."""
        self._bench = bench
        self._session = Session(bench.meter, needs_remote=link == "serial" and bench.meter.member.needs_remote)
        self._messages: deque[Message] = deque()
        self._has_lost = False
        self._is_messages = link in ("vxi11", "usb")

    def receive(self, received: bytes) -> None:
        """Take bytes from the client, in any pieces."""
        self._bench.advance()
        if self.is_closed:
            return
        self._has_lost = not self._bench.hear()
        if self._has_lost:
            return
        self._forget_what_was_read()
        if self._is_messages and self._messages:  # IEEE 488.2, 6.3.2.3: a new message ends an answer that was not read
            self._messages.clear()
            self._bench.meter.report(INTERRUPTED)
        self._pass_on(self._session.handle(received))

    @property
    def message(self) -> Message | None:
        """The reply that can be read now; what is read has to be taken from its content. None when there is none."""
        self.look()
        self._forget_what_was_read()
        first = self._messages[0] if self._messages else None
        return first if first and first.due_ns <= self._bench.clock() else None

    def take(self) -> bytes:
        """Return all that has arrived by now, on a line that knows no messages."""
        taken = bytearray()
        while (message := self.message) is not None:
            taken += message.content
            self._messages.popleft()
        return bytes(taken)

    @property
    def is_answering(self) -> bool:
        """Whether there is something to be read, now or later."""
        self._forget_what_was_read()
        return bool(self._messages) or self._session.waiting

    @property
    def wake_ns(self) -> int | None:
        """Host instant at which there may be more to read; None when it is not known."""
        if self._messages:
            return self._messages[0].due_ns
        return self._session.wake_ns

    def look(self) -> None:
        """See what has happened by now."""
        self._bench.advance()
        if self._session.waiting and not self.is_closed:  # by time, or another client's command ended the wait
            self._pass_on(self._session.handle(b""))

    def clear(self) -> None:
        """Do what Device Clear does: empty the line's buffers, stop what the meter is doing. What it stored stays."""
        self._bench.advance()
        self._session.clear()
        self._messages.clear()
        self._bench.meter.clear_device()

    def interrupt(self) -> None:
        """Forget the reply that is being read (the abort of a transfer)."""
        self._messages.clear()

    def unterminated(self) -> None:
        """Note that the client reads though it asked nothing, unless the meter believes to have answered."""
        if not self._has_lost:
            self._bench.meter.report(UNTERMINATED)

    @property
    def status_byte(self) -> int:
        """The status byte, with bit 4 where a message is available."""
        self.look()
        return self._bench.meter.status_byte | 16 * (self.message is not None)

    def hang_up(self, *, noticed: bool = True) -> None:
        """End the line from the meter's side, or because the cable is out, which the meter does not notice."""
        if not self.is_closed:
            self.is_closed = True
            self._messages.clear()
            self._session.clear()
            self._bench.forget(self, noticed=noticed)

    def close(self) -> None:
        """End the line, as the client does; twice is fine."""
        self.hang_up()

    def _forget_what_was_read(self) -> None:
        while self._messages and not self._messages[0].content:
            self._messages.popleft()

    def _pass_on(self, reply: bytes) -> None:
        if not reply:
            return
        message = self._bench.spoil(reply)
        if message is None:
            self._has_lost = True
            return
        self._messages.append(message)  # and waits for those before it, late or not
