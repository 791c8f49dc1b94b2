"""The wire to the meter: text out, lines and blocks back, every failure one InstrumentError.

What was measured of pyvisa-py 0.8 and is guarded against here:

- A socket to a refused port opens without an error; the first exchange fails. So opening is not proof: identify.
- A peer that has gone is reported as a timeout, and with an infinite timeout never. So every timeout is finite.
- With the termination character on, each 0x0A inside a binary block costs a read. So blocks are read with it off, by
  exact count.
- A late answer is given to the next question. So a link that failed once is closed, not used again.
- TCP_NODELAY cannot be set, so a question after a mere command waits for that command's acknowledgement, up to 40 ms.
  So commands are sent as part of a question.
- Failures come as VisaIOError, OSError, ValueError or EOFError, and of opening also as a bare Exception.
"""

import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Lock
from typing import Protocol, cast

import pyvisa
from pyvisa.constants import StatusCode
from pyvisa.errors import VisaIOError
from pyvisa.resources import MessageBasedResource
from pyvisa.rname import ResourceName

from aemd.errors import InstrumentError

__all__ = ["Link", "open_link"]

LONGEST_ANSWER = 4096  # bytes of a line; the meter's longest, an error text, has under 300
_LINK_FAILURES = (VisaIOError, OSError, ValueError, EOFError)


class Link(Protocol):
    """A line to an instrument that speaks SCPI. Not thread-safe."""

    @property
    def resource(self) -> str:
        """Its VISA resource, for messages."""

    def write(self, command: str) -> None:
        """Send one line.

        Raises:
            InstrumentError: the link failed; it can only be closed.
        """

    def query(self, command: str) -> str:
        """Send one line and return the line that answers it, stripped.

        Raises:
            InstrumentError: no answer within the timeout, or the link failed; it can only be closed.
        """

    def query_block(self, command: str) -> bytes:
        """Send one line and return the content of the definite-length block (`#3800...`) that answers it.

        Raises:
            InstrumentError: no whole block within the timeout, or the link failed; it can only be closed.
        """

    def close(self) -> None:
        """Close the line; twice is fine."""


def open_link(resource: str, timeout_s: float) -> Link:
    """Open a line to a VISA resource such as `TCPIP0::192.168.1.5::5025::SOCKET`.

    Nothing is exchanged yet, so the first query finds out whether somebody listens.

    Raises:
        InstrumentError: the resource is malformed or cannot be opened.
    """
    return _VisaLink(resource, timeout_s)


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

    def __init__(self, resource: str, timeout_s: float) -> None:
        self.resource = resource
        self._timeout_s = timeout_s
        timeout_ms = max(1, round(timeout_s * 1000))
        manager = _manager.enter()
        try:
            _find_host(resource)
            session = cast("MessageBasedResource", manager.open_resource(resource, open_timeout=timeout_ms))
        except Exception as error:  # pyvisa-py raises a bare Exception when it cannot connect
            _manager.leave()
            raise InstrumentError(
                f"{resource}: cannot open: {_one_line(error)}; is it a VISA resource such as"
                " TCPIP0::192.168.1.5::5025::SOCKET, and is the instrument on?"
            ) from error
        self._session: MessageBasedResource | None = session
        session.timeout = timeout_ms
        session.write_termination = "\n"
        session.read_termination = "\n"
        session.chunk_size = 1 << 20  # a whole block in one read

    def write(self, command: str) -> None:
        with self._failures(command) as session:
            session.write(command)

    def query(self, command: str) -> str:
        with self._failures(command) as session:
            session.write(command)
            # Not `session.read`, which goes on for as long as bytes come: a peer that never ends its line is no meter.
            with session.ignore_warning(StatusCode.success_max_count_read):
                answer, _ = session.visalib.read(session.session, LONGEST_ANSWER)
            if not answer.endswith(b"\n"):
                raise ValueError(f"no end of line within {LONGEST_ANSWER} bytes")
            return answer.decode("ascii", errors="backslashreplace").strip()

    def query_block(self, command: str) -> bytes:
        with self._failures(command) as session:
            session.write(command)
            session.read_termination = None
            try:
                return _read_block(session)
            finally:
                session.read_termination = "\n"

    def close(self) -> None:
        session, self._session = self._session, None
        if session is None:
            return
        with suppress(*_LINK_FAILURES):  # a dead line cannot be closed better than this
            session.close()
        _manager.leave()

    @contextmanager
    def _failures(self, command: str) -> Iterator[MessageBasedResource]:
        if self._session is None:
            raise InstrumentError(f"{self.resource}: {command}: the link is closed; open it again")
        try:
            yield self._session
        except _LINK_FAILURES as error:
            self.close()
            if isinstance(error, VisaIOError) and error.error_code == StatusCode.error_timeout:
                what = f"no whole answer within {self._timeout_s:g} s"
            else:
                what = (getattr(error, "strerror", None) or _one_line(error)).lower()
            raise InstrumentError(
                f"{self.resource}: {command}: {what}; check that the instrument is on, the cable and the address"
            ) from error


def _find_host(resource: str) -> None:
    """Look the resource's host up, if it has one: pyvisa-py leaves a socket open when it cannot find it."""
    host = getattr(ResourceName.from_string(resource), "host_address", None)
    if host is not None:
        socket.getaddrinfo(host, None)


def _read_block(session: MessageBasedResource) -> bytes:
    """Read `#`, the number of digits, that many digits, that many bytes, and the newline."""
    mark = session.read_bytes(2)
    if mark[:1] != b"#" or mark[1:] not in b"123456789":
        raise ValueError(f"the answer begins with {mark!r} instead of a block's #")
    size = int(session.read_bytes(int(mark[1:])))
    return session.read_bytes(size + 1)[:size]


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
