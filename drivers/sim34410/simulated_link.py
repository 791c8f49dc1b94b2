"""A line to the simulated meter without a socket, on a clock that is moved by waiting: a day in seconds.

It has the methods of a driver's line to an instrument and fails as one through pyvisa-py fails, as far as that was
measured of pyvisa-py 0.8: a refused socket opens and its first exchange fails; a peer that has gone is a timeout after
the whole timeout, and a broken pipe when written to again; an answer that comes too late is read by the next question,
until the line is cleared or opened again. Every failure is one InstrumentError.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from aemd.errors import InstrumentError
from sim34410.bench import Bench, Line, Link
from sim34410.clock import SteppedClock

__all__ = ["SimulatedLink"]

_STEP_NS = 50_000_000  # between two looks while nothing is announced: another client may end a wait


class SimulatedLink:
    """A line to the meter on a bench. Not thread-safe."""

    def __init__(
        self,
        bench: Bench,
        clock: SteppedClock,
        timeout_s: float = 2.0,
        link: Link = "socket",
        *,
        latency_s: float = 0.4e-3,
        jitter_s: float = 0.2e-3,
        bytes_per_s: float = 1.28e6,
        seed: int = 1,
    ) -> None:
        """Open a line; that of a socket opens even where nobody listens, as pyvisa-py's does.

        Args:
            bench: the meter and its faults, on the same clock.
            clock: what waiting moves.
            timeout_s: longest wait for an answer, s.
            link: which of the meter's interfaces.
            latency_s: least time from a command to the meter, and from the meter to the answer, s.
            jitter_s: mean of what comes on top each way, exponentially distributed, s.
            bytes_per_s: how fast an answer comes; by default 160,000 readings/s in REAL,64, as in Agilent's note on
                throughput.
            seed: of the jitter.

        Raises:
            InstrumentError: the link cannot be opened (of all but a socket and a serial line).
        """
        self.resource = f"SIM::{link}"
        self._bench = bench
        self._clock = clock
        self._timeout_ns = round(timeout_s * 1e9)
        self._link: Link = link
        self._latency_s, self._jitter_s, self._bytes_per_s = latency_s, jitter_s, bytes_per_s
        self._rng = np.random.default_rng(seed)
        self._received = bytearray()
        self._is_open = True
        self._has_failed = False
        self._has_been_told = False
        self._line: Line | None = None
        try:
            self._line = bench.open_line(link)
        except ConnectionRefusedError as error:
            if link not in ("socket", "serial"):
                what = "no device found" if link == "usb" else "connection refused"
                raise self._failure("open", what) from error

    @property
    def is_open(self) -> bool:
        """Whether it can be drained, cleared and used again; a line whose other end has gone cannot."""
        return self._is_open

    def write(self, command: str) -> None:
        """Send one line.

        Raises:
            InstrumentError: the link failed, and is to be drained or cleared, or it is closed.
        """
        if self._has_failed:
            raise self._failure(command, "the link has failed; drain it or open it again")
        with self._failures(command) as line:
            self._send(line, command)

    def query(self, command: str) -> str:
        """Send one line and return the line that answers it, stripped.

        Raises:
            InstrumentError: no answer within the timeout, or the link failed.
        """
        self.write(command)
        with self._failures(command) as line:
            end_ns = self._clock.now_ns + self._timeout_ns
            while b"\n" not in self._received:
                self._wait(line, end_ns)
            answer, _, self._received = self._received.partition(b"\n")
            return answer.decode("ascii", errors="backslashreplace").strip()

    def query_block(self, command: str, most: int) -> tuple[bytes, str]:
        """Send one line; return the content of the definite-length block that answers, and what follows, stripped.

        Args:
            command: the line.
            most: bytes that the content has at most.

        Raises:
            InstrumentError: no whole block within the timeout, or the link failed.
        """
        self.write(command)
        with self._failures(command) as line:
            end_ns = self._clock.now_ns + self._timeout_ns
            mark = self._read(line, 2, end_ns)
            if mark[:1] != b"#" or not mark[1:].isdigit() or mark[1:] == b"0":
                raise ValueError(f"the answer begins with {mark!r} instead of a block's #")
            size = int(self._read(line, int(mark[1:]), end_ns))
            if not 0 <= size <= most:
                raise ValueError(f"a block of {size} bytes where there can be {most} at most")
            content = self._read(line, size, end_ns)
            while b"\n" not in self._received:
                self._wait(line, end_ns)
            rest, _, self._received = self._received.partition(b"\n")
            return content, rest.decode("ascii", errors="backslashreplace").strip()

    def drain(self) -> None:
        """Throw away what comes until nothing has come for 0.1 s.

        Raises:
            InstrumentError: the other end has closed the line, or this one has.
        """
        with self._failures("drain", is_trying=True) as line:
            quiet_from_ns = self._clock.now_ns
            end_ns = quiet_from_ns + 1_000_000_000
            while self._clock.now_ns < quiet_from_ns + 100_000_000:
                self._clock.sleep(0.01)
                if line.take():
                    quiet_from_ns = self._clock.now_ns
                if self._clock.now_ns > end_ns:
                    raise ValueError("it goes on sending what nobody asked for")
            if line.is_closed and self._link != "serial":
                raise EOFError("the other end has closed the connection")
            self._received.clear()

    def clear(self) -> None:
        """Clear the device (VXI-11, USB); a socket and a serial line are drained.

        Raises:
            InstrumentError: it could not be cleared.
        """
        if self._link not in ("vxi11", "usb"):
            self.drain()
            return
        with self._failures("clear", is_trying=True) as line:
            if line.is_closed:
                raise OSError("the other end has closed the connection")
            self._travel(0)
            line.clear()
            self._received.clear()

    def close(self) -> None:
        """Close the line; twice is fine."""
        if self._is_open:
            self._is_open = False
            if self._line is not None:
                self._line.close()

    # -- waiting -----------------------------------------------------------------------------------------------------

    @contextmanager
    def _failures(self, command: str, *, is_trying: bool = False) -> Iterator[Line]:
        """Turn what fails into one InstrumentError, and close a line that cannot be used again."""
        if not self._is_open:
            raise self._failure(command, "the link is closed; open it again")
        try:
            yield self._connected()
            self._has_failed = False
        except TimeoutError as error:
            self._has_failed = True
            what = f"no whole answer within {self._timeout_ns * 1e-9:g} s"
            if self._line is not None and self._line.is_closed:
                what += ", and the other end has closed the connection"
                self.close()
            raise self._failure(command, what) from error
        except (OSError, EOFError, ValueError) as error:
            self._has_failed = True
            if is_trying or not isinstance(error, ValueError):
                self.close()
            raise self._failure(command, str(error)) from error

    def _connected(self) -> Line:
        if self._line is None or (self._link == "serial" and self._line.is_closed):
            try:
                self._line = self._bench.open_line(self._link)
            except ConnectionRefusedError as error:
                if self._link != "serial":
                    raise OSError("connection refused") from error
                self._clock.sleep(self._timeout_ns * 1e-9)  # a serial line has nobody who refuses
                raise TimeoutError from error
        return self._line

    def _send(self, line: Line, command: str) -> None:
        if line.is_closed and (self._has_been_told or self._link == "usb"):
            raise OSError("no such device" if self._link == "usb" else "broken pipe")
        self._has_been_told = line.is_closed
        self._travel(0)
        line.receive(command.encode() + b"\n")

    def _read(self, line: Line, count: int, end_ns: int) -> bytes:
        while len(self._received) < count:
            self._wait(line, end_ns)
        taken = bytes(self._received[:count])
        del self._received[:count]
        return taken

    def _wait(self, line: Line, end_ns: int) -> None:
        """Take what arrives next; time moves until then."""
        arrived = line.take()
        if arrived:
            self._travel(len(arrived))
            self._received += arrived
            return
        now_ns = self._clock.now_ns
        if now_ns >= end_ns:
            raise TimeoutError
        wakes = [end_ns]
        if line.is_answering:
            known = (line.wake_ns, self._bench.wake_ns)
            wakes += [wake for wake in known if wake is not None and wake > now_ns]
            if line.wake_ns is None:
                wakes.append(now_ns + _STEP_NS)
        self._clock.sleep_until(min(wakes))

    def _travel(self, size: int) -> None:
        self._clock.sleep(self._latency_s + self._rng.exponential(self._jitter_s) + size / self._bytes_per_s)

    def _failure(self, command: str, what: str) -> InstrumentError:
        return InstrumentError(
            f"{self.resource}: {command}: {what}; check that the instrument is on, the cable and the address"
        )
