"""The wire to the meter: text out, lines and blocks back, every failure one InstrumentError.

What was measured of pyvisa-py 0.8 and is guarded against here:

- A socket to a refused port opens without an error; the first exchange fails. So opening is not proof: identify.
- A peer that has gone is reported as a timeout, and with an infinite timeout never. So every timeout is finite, after
  one VXI-11's socket is asked whether its other end is closed, and a raw socket is read here (`socket_reader`).
- With the termination character on, each 0x0A inside a binary block costs a read. So blocks are read with it off, by
  exact count.
- A late answer is given to the next question. So a link that failed refuses questions until it is drained or cleared,
  and whoever does that makes sure of the next answer (`agilent34410.dialogue`).
- Clearing a socket whose other end is closed never returns. So a socket is drained here, with an end in sight.
- VXI-11 connects within 100 ms unless told otherwise. So the open timeout is always given.
- A VXI-11 read subtracts the time so far once for each piece. So a block is asked for in one piece, and is small.
- A VXI-11 link that cannot be made leaves its socket to the garbage collector, and takes 5 s to be given up where the
  other end hangs up. So the socket is closed here, and the door is tried first (`agilent34410.knock`); the 5 s remain
  where it takes the connection and hangs up later than 50 ms.
- Closing a VXI-11 link to a dead peer blocks for 5 s. So a dead link's socket is shut before it is closed.
- USB-TMC has no clear. So it is written out (`agilent34410.usbtmc`).
- Without the socket option TCP_NODELAY, which has no VISA attribute that works, a question after a mere command waits
  for that command's acknowledgement, up to 40 ms. So commands are sent as part of a question.
- Failures come as VisaIOError, OSError, ValueError (a USB device that was unplugged), EOFError, RPCError, and of
  opening also as a bare Exception. So every Exception of an exchange is the link's failure.
"""

import os
import re
import select
import socket
import struct
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from threading import Lock
from traceback import walk_tb
from typing import Any, Protocol, cast

import pyvisa
from pyvisa.constants import InterfaceType, StatusCode
from pyvisa.errors import VisaIOError
from pyvisa.resources import MessageBasedResource
from pyvisa.rname import InvalidResourceName

from aemd.acquire.reach import name_obstacle
from aemd.errors import InstrumentError
from agilent34410.knock import knock
from agilent34410.socket_reader import SilenceError, SocketReader, count_digits, read_size
from agilent34410.usbtmc import clear_usbtmc

__all__ = ["Link", "open_link"]

LONGEST_ANSWER = 4096  # bytes of a line; the meter's longest, an error text, has under 300
QUIET_S = 0.1  # nothing for so long: the line is empty
MOST_DRAIN_S = 1.0  # a peer that is not quiet by then will not be
ROUND_A_BLOCK = 64  # bytes: its head, and what answers a further question of the same line
CREATING_LINK = re.compile(r"error creating link: ([0-9]+)")  # as pyvisa-py says it
LINK_REFUSALS = {3: "no answer, or no such device", 9: "it has given out all it has", 11: "another has locked it"}
"""Errors of create_link (VXI-11, table B.2); 3 is also what pyvisa-py makes of silence."""
NO_LINGER = struct.pack("ii", 1, 0)  # struct linger: on, 0 s


class Link(Protocol):
    """A line to an instrument that speaks SCPI. Not thread-safe."""

    @property
    def resource(self) -> str:
        """Its VISA resource, for messages."""

    @property
    def is_open(self) -> bool:
        """Whether it can be drained, cleared and used again; a line whose other end has gone cannot."""

    def write(self, command: str) -> None:
        """Send one line.

        Raises:
            InstrumentError: the link failed; it must be drained or cleared, or opened again.
        """

    def query(self, command: str) -> str:
        """Send one line and return the line that answers it, stripped.

        Raises:
            InstrumentError: no answer within the timeout, or the link failed; it must be drained, cleared or reopened.
        """

    def query_block(self, command: str, most: int) -> tuple[bytes, str]:
        """Send one line; return the content of the definite-length block (`#3800...`) that answers, and what follows.

        Args:
            command: the line.
            most: bytes that the content has at most.

        Raises:
            InstrumentError: no whole block within the timeout, or the link failed; it must be drained, cleared or
                reopened.
        """

    def drain(self) -> None:
        """Throw away what comes until it is quiet, so that the line may be tried again.

        Raises:
            InstrumentError: it is not quiet, or the link failed.
        """

    def clear(self) -> None:
        """Clear the instrument's interface (device clear), where the line has such a thing; else drain.

        Raises:
            InstrumentError: it could not be cleared.
        """

    def close(self) -> None:
        """Close the line; twice is fine."""


def open_link(resource: str, timeout_s: float, serial: Mapping[str, Any] | None = None) -> Link:
    """Open a line to a VISA resource.

    `TCPIP0::192.168.1.5::5025::SOCKET`, `TCPIP0::192.168.1.5::inst0::INSTR` (VXI-11; `192.168.1.5,1024` names its port
    where no port mapper does), `USB0::0x0957::0x0607::MY47006594::INSTR`, `ASRL/dev/ttyUSB0::INSTR`. Nothing is
    exchanged yet, so the first query finds out whether somebody listens.

    Args:
        resource: the VISA resource.
        timeout_s: longest wait for an answer, s.
        serial: pyvisa's attributes of a serial line (baud_rate, parity...); not used by others.

    Raises:
        InstrumentError: the resource is malformed or cannot be opened.
    """
    return _VisaLink(resource, timeout_s, serial or {})


class _Manager:
    """pyvisa's one resource manager per process, closed with the last link: closing it closes everybody's links."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._users = 0
        self._manager: pyvisa.ResourceManager | None = None

    def enter(self) -> pyvisa.ResourceManager:
        with self._lock:
            if self._manager is None:
                self._manager = pyvisa.ResourceManager("@py")
            self._users += 1
            return self._manager

    def leave(self) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0 and self._manager is not None:
                self._manager.close()
                self._manager = None


_manager = _Manager()


class _VisaLink:
    """A pyvisa session with the traps above closed."""

    def __init__(self, resource: str, timeout_s: float, serial: Mapping[str, Any]) -> None:
        self.resource = resource
        self._timeout_s = timeout_s
        self._failed = False
        timeout_ms = max(1, round(timeout_s * 1000))
        attributes = serial if resource.upper().startswith("ASRL") else {}
        manager = _manager.enter()
        try:
            knock(resource, timeout_s)
            opened = manager.open_resource(resource, open_timeout=timeout_ms, **attributes)
        except Exception as error:
            _close_sockets_left_by(error)
            _manager.leave()
            way_out = name_obstacle(resource) or "check that the instrument is on, the cable and the address"
            if isinstance(error, InvalidResourceName):
                way_out = "write it like TCPIP0::192.168.1.5::5025::SOCKET"
            name = resource or "no resource"
            raise InstrumentError(f"{name}: cannot open: {_why(error)}; {way_out}") from error
        session = cast("MessageBasedResource", opened)
        self._session: MessageBasedResource | None = session
        library: Any = session.visalib
        self._inner: Any = library.sessions[session.session]  # pyvisa-py's own, for what VISA cannot say
        session.timeout = timeout_ms
        session.write_termination = "\n"
        session.read_termination = "\n"
        line = self._inner.interface
        self._reader = SocketReader(line, timeout_s) if isinstance(line, socket.socket) else None
        # On USB-TMC and VXI-11 one read is one message; a socket and a serial line have no ends of messages.
        self._is_message_based = session.interface_type == InterfaceType.usb or hasattr(self._inner, "link")

    @property
    def is_open(self) -> bool:
        return self._session is not None

    def write(self, command: str) -> None:
        with self._failures(command) as session:
            session.write(command)

    def query(self, command: str) -> str:
        with self._failures(command) as session:
            session.write(command)
            answer = self._read_line(session)
            if not answer.endswith(b"\n"):
                raise ValueError(f"no end of line within {LONGEST_ANSWER} bytes")
            return answer.decode("ascii", errors="backslashreplace").strip()

    def query_block(self, command: str, most: int) -> tuple[bytes, str]:
        with self._failures(command) as session:
            session.write(command)
            content, rest = self._read_block(session, most)
            if not rest.endswith(b"\n"):
                rest += self._read_line(session)
            return content, rest.decode("ascii", errors="backslashreplace").strip()

    def drain(self) -> None:
        with self._failures("drain", trying=True) as session:
            end_s = time.monotonic() + MOST_DRAIN_S
            while self._throw_away(session):
                if time.monotonic() > end_s:
                    raise ValueError("it goes on sending what nobody asked for")

    def clear(self) -> None:
        with self._failures("clear", trying=True) as session:
            if session.interface_type == InterfaceType.usb:
                clear_usbtmc(self._inner.interface, self._timeout_s)
                return
            if self._is_message_based or session.interface_type == InterfaceType.gpib:
                session.clear()
                return
        self.drain()  # a socket and a serial line have no device clear

    def close(self) -> None:
        self._close(dead=False)

    def _read_line(self, session: MessageBasedResource) -> bytes:
        return self._read(session, LONGEST_ANSWER) if self._reader is None else self._reader.read_line(LONGEST_ANSWER)

    def _read_block(self, session: MessageBasedResource, most: int) -> tuple[bytes, bytes]:
        if self._reader is not None:
            return self._reader.read_block(most)
        session.read_termination = None
        try:
            return self._read_message(session, most) if self._is_message_based else _read_stream(session, most)
        finally:
            session.read_termination = "\n"

    def _read(self, session: MessageBasedResource, most: int) -> bytes:
        # Not `session.read`, which goes on for as long as bytes come: a peer that never ends its line is no meter.
        with session.ignore_warning(StatusCode.success_max_count_read, StatusCode.success_termination_character_read):
            return bytes(session.visalib.read(session.session, most)[0])

    def _read_message(self, session: MessageBasedResource, most: int) -> tuple[bytes, bytes]:
        message = self._read(session, most + ROUND_A_BLOCK)
        digits = count_digits(message[:2])
        size = read_size(message[2 : 2 + digits], most)
        content = message[2 + digits : 2 + digits + size]
        if len(content) < size:
            raise ValueError(f"{len(content)} bytes came of a block of {size}")
        return content, message[2 + digits + size :]

    def _throw_away(self, session: MessageBasedResource) -> bool:
        """Discard what is there or comes soon; tell whether there was anything."""
        if session.interface_type == InterfaceType.usb:
            return False  # pyvisa-py aborts a transfer that timed out, which empties the endpoint
        if self._is_message_based:
            session.timeout = QUIET_S * 1000
            try:
                return bool(self._read(session, 1 << 20))
            except VisaIOError as error:
                if error.error_code != StatusCode.error_timeout:
                    raise
                return False
            finally:
                session.timeout = self._timeout_s * 1000
        line = self._inner.interface
        if self._reader is not None:
            self._reader.forget()
            if not select.select([line], [], [], QUIET_S)[0]:
                return False
            if not line.recv(1 << 16):
                raise EOFError("the other end has closed the connection")
            return True
        if session.interface_type == InterfaceType.asrl:
            time.sleep(QUIET_S)
            waiting = bool(line.in_waiting)
            line.reset_input_buffer()
            return waiting
        return False

    @contextmanager
    def _failures(self, command: str, *, trying: bool = False) -> Iterator[MessageBasedResource]:
        if self._session is None:
            raise InstrumentError(f"{self.resource}: {command}: the link is closed; open it again")
        if self._failed and not trying:
            raise InstrumentError(f"{self.resource}: {command}: the link has failed; drain it or open it again")
        try:
            yield self._session
            self._failed = False
        except Exception as error:
            self._failed = True
            if _is_silence(error):
                what = f"no whole answer within {self._timeout_s:g} s"
                if self._is_hung_up():
                    what += ", and the other end has closed the connection"
                    self._close(dead=True)
            else:
                what = _why(error).lower()
                if trying or not _is_nonsense(error):
                    self._close(dead=True)
            raise InstrumentError(
                f"{self.resource}: {command}: {what}; check that the instrument is on, the cable and the address"
            ) from error

    def _is_hung_up(self) -> bool:
        line = getattr(self._inner.interface, "sock", self._inner.interface)
        if not isinstance(line, socket.socket):
            return False
        try:
            return not line.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except OSError:
            return True

    def _close(self, *, dead: bool) -> None:
        session, self._session = self._session, None
        if session is None:
            return
        line = getattr(self._inner.interface, "sock", self._inner.interface)
        if (dead or self._failed) and isinstance(line, socket.socket):
            with suppress(OSError):
                # What it still holds must not be sent any more: a question that arrives when the cable is back would
                # take readings out of the meter behind the back of the link that has taken this one's place.
                line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, NO_LINGER)
                line.shutdown(socket.SHUT_RDWR)
        with suppress(Exception):  # a dead line cannot be closed better than this
            session.close()
        self._inner = None
        _manager.leave()


def _read_stream(session: MessageBasedResource, most: int) -> tuple[bytes, bytes]:
    """Read `#`, the number of digits, that many digits, that many bytes, and the byte after them."""
    digits = count_digits(session.read_bytes(2))
    size = read_size(session.read_bytes(digits), most)
    block = session.read_bytes(size + 1, chunk_size=size + 1)  # in one read
    return block[:size], block[size:]


def _is_silence(error: Exception) -> bool:
    return isinstance(error, SilenceError) or (
        isinstance(error, VisaIOError) and error.error_code == StatusCode.error_timeout
    )


def _is_nonsense(error: Exception) -> bool:
    """Tell whether it came of what was read rather than of the line; a device that is gone is a ValueError, too."""
    return (type(error) is ValueError and "[Errno" not in str(error)) or isinstance(error, UnicodeError)


def _close_sockets_left_by(error: BaseException) -> None:
    """Close the sockets of pyvisa-py's objects that `error` came through: nobody else has them any more."""
    failure: BaseException | None = error
    while failure is not None:
        for frame, _line in walk_tb(failure.__traceback__):
            owner = frame.f_locals.get("self")
            left = getattr(getattr(owner, "interface", owner), "sock", None)
            if isinstance(left, socket.socket):
                left.close()
        failure = failure.__context__


def _why(error: BaseException) -> str:
    """Return what a failure is, in one line: of the system's, its own words for the number, which some wrap up."""
    text = error.description if isinstance(error, VisaIOError) else str(error)
    if isinstance(error, OSError) and error.strerror:
        text = os.strerror(error.errno).lower() if error.errno and error.errno > 0 else error.strerror.lower()
    elif found := CREATING_LINK.fullmatch(text):
        text = f"it gives out no link: {LINK_REFUSALS.get(int(found[1]), f'error {found[1]}')}"
    return " ".join(text.split()).rstrip(".") or type(error).__name__
