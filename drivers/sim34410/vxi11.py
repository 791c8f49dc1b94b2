"""The meter's VXI-11 server: TCP/IP Instrument Protocol, VXI-11 revision 1.0, with the device name `inst0`.

Core and abort channel are on one port of their own, so no port mapper is needed; clients that can name the port
(`TCPIP0::127.0.0.1,PORT::inst0::INSTR` in pyvisa-py) need no rights. There is no interrupt channel: `device_enable_srq`
is taken and without effect, `create_intr_chan` refused.
"""

from collections.abc import Callable
from dataclasses import dataclass

from sim34410.bench import Bench, Line
from sim34410.rpc import (
    GARBAGE_ARGUMENTS,
    PROCEDURE_UNAVAILABLE,
    PROGRAM_UNAVAILABLE,
    Arguments,
    Call,
    Records,
    answer,
    opaque,
    parse_call,
    refuse,
    uint,
)
from sim34410.status import ScpiError

__all__ = ["Vxi11Conversation", "Vxi11Links"]

CORE, ABORT = 0x0607AF, 0x0607B0
"""Programs of the two channels (VXI-11, B.6)."""

MOST_WRITE_BYTES = 16_384
"""A client has to cut longer messages; it is told when it creates a link."""

NO_ERROR, NOT_ACCESSIBLE, INVALID_LINK, NOT_SUPPORTED = 0, 3, 4, 8
LOCKED, NOT_LOCKED, TIMED_OUT, ABORTED = 11, 12, 15, 23
"""Error codes (VXI-11, table B.2)."""

WAIT_LOCK, END, TERMINATION_SET = 1, 8, 128
"""Flags of an operation (VXI-11, B.5.3)."""

REQUEST_COUNT, CHARACTER, END_REACHED = 1, 2, 4
"""Reasons for the end of a read (VXI-11, B.6.3)."""

MOST_LINKS = 16
OUT_OF_RESOURCES = 9


@dataclass(frozen=True, slots=True)
class _Pending:
    """A call that cannot be answered yet."""

    call: Call
    end_ns: int
    try_again: Callable[[], bytes | None]
    at_the_end: Callable[[], bytes]


class Vxi11Links:
    """The links of all connections, and which of them holds the lock."""

    def __init__(self, bench: Bench, port: int) -> None:
        """Take the meter and the port, which clients are told as that of the abort channel."""
        self.bench = bench
        self.port = port
        self.lines: dict[int, Line] = {}
        self.owner: int | None = None
        """Link that holds the lock."""
        self.aborted: set[int] = set()
        self._last = 0

    def open(self) -> int:
        """Return a new link's number.

        Raises:
            ConnectionRefusedError: the meter takes none.
        """
        line = self.bench.open_line("vxi11")
        self._last += 1
        self.lines[self._last] = line
        return self._last

    def close(self, link: int) -> None:
        """End a link, and its lock."""
        self.lines.pop(link).close()
        if self.owner == link:
            self.owner = None


class Vxi11Conversation:
    """One connection: calls in, answers out, in order."""

    def __init__(self, links: Vxi11Links) -> None:
        self._links = links
        self._bench = links.bench
        self._records = Records()
        self._own: set[int] = set()
        self._pending: _Pending | None = None
        self._unsent = bytearray()
        self._hang_ups = self._bench.hang_ups
        self._failed = False
        self._procedures: dict[int, Callable[[Call, Arguments], bytes | None]] = {
            10: self._create_link,
            11: self._write,
            12: self._read,
            13: self._read_status,
            14: self._trigger,
            15: self._clear,
            16: self._obeyed,  # device_remote
            17: self._obeyed,  # device_local
            18: self._lock,
            19: self._unlock,
            20: self._obeyed,  # device_enable_srq
            22: lambda *_: uint(NOT_SUPPORTED) + opaque(b""),  # device_docmd
            23: self._destroy_link,
            25: lambda *_: uint(NOT_SUPPORTED),  # create_intr_chan
            26: lambda *_: uint(NOT_SUPPORTED),  # destroy_intr_chan
        }

    @property
    def is_closed(self) -> bool:
        """Whether the connection has to end: the meter hung up, or the client speaks another language."""
        return self._failed or self._hang_ups != self._bench.hang_ups

    @property
    def wake_ns(self) -> int | None:
        """Host instant at which there may be more to send."""
        if self._pending is None:
            return None
        wakes = [line.wake_ns for link, line in self._links.lines.items() if link in self._own]
        now_ns = self._bench.clock()  # what is over is half an answer, whose rest never comes
        return min([self._pending.end_ns, *(wake for wake in wakes if wake is not None and wake > now_ns)])

    def receive(self, received: bytes) -> None:
        """Take bytes from the client."""
        self._records.feed(received)

    def take(self) -> bytes:
        """Obey what has arrived, and return what is to be sent by now."""
        try:
            while self._pending is None or self._has_settled():
                record = self._records.next()
                if record is None:
                    break
                self._obey(parse_call(record))
        except ValueError:
            self._failed = True
        unsent, self._unsent = bytes(self._unsent), bytearray()
        return unsent

    def close(self) -> None:
        """End the connection's links, as its end does (VXI-11, B.4.4)."""
        for link in self._own & self._links.lines.keys():
            self._links.close(link)
        self._own.clear()

    # -- calls -------------------------------------------------------------------------------------------------------

    def _obey(self, call: Call) -> None:
        if call.program == ABORT and call.procedure == 1:
            procedure: Callable[[Call, Arguments], bytes | None] | None = self._abort
        elif call.program == CORE:
            procedure = self._procedures.get(call.procedure)
        else:
            self._unsent += refuse(call, PROGRAM_UNAVAILABLE)
            return
        if call.procedure == 0:
            self._unsent += answer(call, b"")
        elif procedure is None:
            self._unsent += refuse(call, PROCEDURE_UNAVAILABLE)
        else:
            try:
                results = procedure(call, Arguments(call.arguments))
            except ValueError:
                self._unsent += refuse(call, GARBAGE_ARGUMENTS)
                return
            if results is not None:
                self._unsent += answer(call, results)

    def _has_settled(self) -> bool:
        """Try the pending call again; return whether it is answered now."""
        pending = self._pending
        if pending is None:
            return True
        results = pending.try_again()
        if results is None and self._bench.clock() >= pending.end_ns:
            results = pending.at_the_end()
        if results is None:
            return False
        self._pending = None
        self._unsent += answer(pending.call, results)
        return True

    def _wait(
        self, call: Call, timeout_ms: int, try_again: Callable[[], bytes | None], at_the_end: Callable[[], bytes]
    ) -> bytes | None:
        """Return what `try_again` does, at once or within the timeout; then what `at_the_end` does."""
        results = try_again()
        if results is None:
            self._pending = _Pending(call, self._bench.clock() + timeout_ms * 1_000_000, try_again, at_the_end)
        return results

    def _create_link(self, call: Call, arguments: Arguments) -> bytes | None:
        arguments.uint()  # the client's own number
        wants_lock, lock_timeout_ms = arguments.uint(), arguments.uint()
        device = arguments.opaque()
        nothing = uint(0, 0, 0)
        if device.lower() != b"inst0":
            return uint(NOT_ACCESSIBLE) + nothing
        if len(self._links.lines) >= MOST_LINKS:
            return uint(OUT_OF_RESOURCES) + nothing

        def try_again() -> bytes | None:
            if wants_lock and self._links.owner is not None:
                return None
            try:
                link = self._links.open()
            except ConnectionRefusedError:
                return uint(NOT_ACCESSIBLE) + nothing
            self._own.add(link)
            if wants_lock:
                self._links.owner = link
            return uint(NO_ERROR, link, self._links.port, MOST_WRITE_BYTES)

        return self._wait(call, lock_timeout_ms, try_again, lambda: uint(LOCKED) + nothing)

    def _write(self, call: Call, arguments: Arguments) -> bytes | None:
        link, _, lock_timeout_ms, flags = (arguments.uint() for _ in range(4))
        content = arguments.opaque()

        def write(line: Line) -> bytes:
            ends = flags & END and not content.endswith(b"\n")
            line.receive(content + b"\n" if ends else content)
            return uint(NO_ERROR, len(content))

        return self._unlocked(call, link, flags, lock_timeout_ms, write, uint(0))

    def _read(self, call: Call, arguments: Arguments) -> bytes | None:
        link, size, io_timeout_ms, _, flags, termination = (arguments.uint() for _ in range(6))
        if link not in self._own or link not in self._links.lines:
            return uint(INVALID_LINK, 0) + opaque(b"")
        if self._links.owner not in (None, link):
            return uint(LOCKED, 0) + opaque(b"")
        line = self._links.lines[link]
        self._links.aborted.discard(link)
        if not line.is_answering:
            line.unterminated()

        def try_again() -> bytes | None:
            if link in self._links.aborted:
                return uint(ABORTED, 0) + opaque(b"")
            message = line.message
            if message is None:
                return None
            content = bytes(message.content[:size])
            reason = 0
            if flags & TERMINATION_SET and (found := content.find(termination & 0xFF)) >= 0:
                content, reason = content[: found + 1], CHARACTER
            if len(content) == len(message.content):
                if not message.whole and len(content) < size:
                    return None  # the rest never comes
                reason |= END_REACHED * message.whole
            reason |= REQUEST_COUNT * (len(content) == size)
            del message.content[: len(content)]
            return uint(NO_ERROR, reason) + opaque(content)

        def at_the_end() -> bytes:
            if line.message is not None:
                line.interrupt()
            return uint(TIMED_OUT, 0) + opaque(b"")

        return self._wait(call, io_timeout_ms, try_again, at_the_end)

    def _read_status(self, call: Call, arguments: Arguments) -> bytes | None:
        link, flags, lock_timeout_ms, _ = (arguments.uint() for _ in range(4))
        return self._unlocked(
            call, link, flags, lock_timeout_ms, lambda line: uint(NO_ERROR, line.status_byte), uint(0)
        )

    def _trigger(self, call: Call, arguments: Arguments) -> bytes | None:
        def trigger(_: Line) -> bytes:
            try:
                self._bench.meter.trigger()
            except ScpiError as error:
                self._bench.meter.report(error.code)
            return uint(NO_ERROR)

        link, flags, lock_timeout_ms, _ = (arguments.uint() for _ in range(4))
        return self._unlocked(call, link, flags, lock_timeout_ms, trigger)

    def _clear(self, call: Call, arguments: Arguments) -> bytes | None:
        def clear(line: Line) -> bytes:
            line.clear()
            return uint(NO_ERROR)

        link, flags, lock_timeout_ms, _ = (arguments.uint() for _ in range(4))
        return self._unlocked(call, link, flags, lock_timeout_ms, clear)

    def _obeyed(self, _: Call, arguments: Arguments) -> bytes:
        return uint(NO_ERROR if arguments.uint() in self._own else INVALID_LINK)

    def _lock(self, call: Call, arguments: Arguments) -> bytes | None:
        def lock(_: Line) -> bytes:
            self._links.owner = link
            return uint(NO_ERROR)

        link, flags, lock_timeout_ms = (arguments.uint() for _ in range(3))
        return self._unlocked(call, link, flags, lock_timeout_ms, lock)

    def _unlock(self, _: Call, arguments: Arguments) -> bytes:
        link = arguments.uint()
        if link not in self._own:
            return uint(INVALID_LINK)
        if self._links.owner != link:
            return uint(NOT_LOCKED)
        self._links.owner = None
        return uint(NO_ERROR)

    def _destroy_link(self, _: Call, arguments: Arguments) -> bytes:
        link = arguments.uint()
        if link not in self._own:
            return uint(INVALID_LINK)
        self._own.discard(link)
        if link in self._links.lines:
            self._links.close(link)
        return uint(NO_ERROR)

    def _abort(self, _: Call, arguments: Arguments) -> bytes:
        link = arguments.uint()
        if link not in self._links.lines:
            return uint(INVALID_LINK)
        self._links.aborted.add(link)
        return uint(NO_ERROR)

    def _unlocked(
        self,
        call: Call,
        link: int,
        flags: int,
        lock_timeout_ms: int,
        action: Callable[[Line], bytes],
        nothing: bytes = b"",
    ) -> bytes | None:
        """Return what an action on a link's line answers, once no other link holds the lock.

        `nothing` is what follows the error where the action could not be done.
        """
        if link not in self._own or link not in self._links.lines:
            return uint(INVALID_LINK) + nothing
        line = self._links.lines[link]

        def try_again() -> bytes | None:
            return action(line) if self._links.owner in (None, link) else None

        timeout_ms = lock_timeout_ms if flags & WAIT_LOCK else 0
        return self._wait(call, timeout_ms, try_again, lambda: uint(LOCKED) + nothing)
