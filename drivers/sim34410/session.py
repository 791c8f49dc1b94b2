"""One client's conversation with the meter: bytes in, bytes out; no socket, no thread, no clock of its own."""

from collections.abc import Iterator

from sim34410.commands import COMMANDS
from sim34410.forms import Result, Wait
from sim34410.meter import Meter
from sim34410.scpi import Unit, parse_message
from sim34410.status import ScpiError

__all__ = ["Session"]

INPUT_BYTES = 65_536
"""A message longer than this is thrown away (-363): a client that never ends a line must not fill the memory."""


class Session:
    """Buffers input until a line is complete, obeys it, and holds back whatever follows a command that has to wait."""

    def __init__(self, meter: Meter, *, needs_remote: bool = False) -> None:
        """Talk to a meter; `needs_remote` has it refuse all but SYSTem:REMote until that was sent (34401A, RS-232)."""
        self._meter = meter
        self._is_local = needs_remote
        self._input = bytearray()
        self._units: Iterator[Unit] = iter(())
        self._replies: list[bytes] = []
        self._waiting: Wait | None = None

    @property
    def waiting(self) -> bool:
        """Whether a command waits for the meter."""
        return self._waiting is not None

    @property
    def wake_ns(self) -> int | None:
        """Host instant at which `handle(b"")` will have more to say; None when there is none, or it is not known."""
        return self._waiting.until_ns if self._waiting else None

    def clear(self) -> None:
        """Empty the buffers, as Device Clear does: what was begun and what waits is forgotten."""
        self._input.clear()
        self._units = iter(())
        self._replies.clear()
        self._waiting = None

    def handle(self, received: bytes) -> bytes:
        """Take bytes from the client, in any pieces; return the bytes to be sent to it.

        No input makes it fail: what is wrong goes into the meter's error queue.
        """
        self._input += received
        sent = bytearray()
        while self._obey_message():
            if self._replies:
                sent += b";".join(self._replies) + b"\n"
                self._replies.clear()
            line = self._next_line()
            if line is None:
                break
            self._units = parse_message(line)
        return bytes(sent)

    def _next_line(self) -> str | None:
        line, newline, rest = self._input.partition(b"\n")
        if newline:
            self._input = rest
            return line.rstrip(b"\r").decode("latin-1")
        if len(self._input) > INPUT_BYTES:
            self._input.clear()
            self._meter.report(-363)
        return None

    def _obey_message(self) -> bool:
        """Obey what is left of the present message; return whether it has ended."""
        waiting, self._waiting = self._waiting, None
        while True:
            try:
                if waiting is not None:
                    result = waiting.resume()
                elif (unit := next(self._units, None)) is not None:
                    result = self._obey(unit)
                else:
                    return True
            except ScpiError as error:
                self._meter.report(error.code)
                if -200 < error.code < 0:  # a command error: the rest of the message cannot be trusted
                    self._units = iter(())
                result = None
            waiting = None
            if isinstance(result, Wait):
                self._waiting = result
                return False
            if result is not None:
                self._replies.append(result.encode() if isinstance(result, str) else result)

    def _obey(self, unit: Unit) -> Result:
        command = COMMANDS.find(unit.path)
        if self._meter.member.lacks and COMMANDS.short(unit.path) in self._meter.member.lacks:
            raise ScpiError(-113)
        if self._is_local:
            self._is_local = COMMANDS.short(unit.path) not in ("SYST:REM", "SYST:RWL")
            if self._is_local:
                raise ScpiError(550)
        action = command.get if unit.query else command.set
        if action is None:
            raise ScpiError(-113)
        allowed = command.query_parameters if unit.query else command.parameters
        if len(unit.parameters) >= allowed.stop:
            raise ScpiError(-108)
        if len(unit.parameters) < allowed.start:
            raise ScpiError(-109)
        return action(self._meter, unit.parameters)
