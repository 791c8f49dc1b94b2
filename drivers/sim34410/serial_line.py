"""The meter on a serial line: a pseudo-terminal, whose other end pyserial opens as it does any port.

What is served is a meter on RS-232 (the 34401A, which wants SYSTem:REMote first and takes Ctrl-C for Device Clear), or
a 34410A behind an adapter that makes a serial line of GPIB. A pseudo-terminal is 8 bits wide and has no speed, so
binary blocks pass and take no time. Nobody can hang up on it or refuse it: while the cable is out, or the meter is off,
what is sent is lost.
"""

import os
import tty
from collections.abc import Iterator
from contextlib import contextmanager

from sim34410.bench import Bench, Line

__all__ = ["SerialLine"]

_CTRL_C = b"\x03"


class SerialLine:
    """One line to the meter, always there; the conversation behind a pseudo-terminal."""

    is_closed = False

    def __init__(self, bench: Bench, master: int, resource: str) -> None:
        """Use `opened`."""
        self.master = master
        """File descriptor of the meter's end."""
        self.resource = resource
        """VISA resource of the client's end."""
        self._bench = bench
        self._line: Line | None = None

    @classmethod
    @contextmanager
    def opened(cls, bench: Bench) -> "Iterator[SerialLine]":
        """Make a pseudo-terminal; leaving the context removes it."""
        master, slave = os.openpty()  # its client's end stays open here, so that a client that goes ends nothing
        try:
            tty.setraw(slave)
            os.set_blocking(master, False)
            yield cls(bench, master, f"ASRL{os.ttyname(slave)}::INSTR")
        finally:
            os.close(slave)
            os.close(master)

    @property
    def wake_ns(self) -> int | None:
        """Host instant at which `take` may have more."""
        return self._line.wake_ns if self._line else None

    def receive(self, received: bytes) -> None:
        """Take bytes from the client; Ctrl-C clears the device."""
        line = self._connected()
        if line is None:
            return
        *_, rest = parts = received.split(_CTRL_C)
        if len(parts) > 1:
            line.clear()
        line.receive(rest)

    def take(self) -> bytes:
        """Return what is to be sent by now."""
        line = self._connected()
        return line.take() if line else b""

    def close(self) -> None:
        """End it."""
        if self._line is not None:
            self._line.close()

    def _connected(self) -> Line | None:
        if self._line is None or self._line.is_closed:
            try:
                self._line = self._bench.open_line("serial")
            except ConnectionRefusedError:
                self._line = None
        return self._line
