"""What a raw socket brings, read by the driver itself: whole lines and blocks, a closed connection at once.

pyvisa-py 0.8 reads a socket in pieces of 4 KiB, and of a connection that the other end has closed it goes on reading,
with half a core, until the timeout is over. So it opens the socket and writes to it, and this reads.
"""

import select
import socket
import time

__all__ = ["SilenceError", "SocketReader", "count_digits", "read_size"]

PIECE = 1 << 17  # bytes; more than an answer has, so that one that is there is taken at once


class SilenceError(Exception):
    """No whole answer within the timeout; the connection is there still."""


class SocketReader:
    """The receiving side of a connected socket, and what came and was not asked for yet.

    Args:
        line: the socket; blocking, stays the caller's to close.
        timeout_s: longest wait for a whole answer, s.
    """

    def __init__(self, line: socket.socket, timeout_s: float) -> None:
        self._line = line
        self._timeout_s = timeout_s
        self._came = bytearray()
        self._poll = select.poll()
        self._poll.register(line, select.POLLIN)

    def read_line(self, most: int) -> bytes:
        """Return a line with its end, or the first `most` bytes of one that is longer.

        Raises:
            SilenceError: no whole line within the timeout.
            EOFError: the other end has closed the connection.
            OSError: the connection failed.
        """
        end_s = time.monotonic() + self._timeout_s
        while (found := self._came.find(b"\n")) < 0 and len(self._came) < most:
            self._receive(end_s)
        return self._take(min(found + 1 or most, most))

    def read_block(self, most: int) -> tuple[bytes, bytes]:
        """Return the content of a definite-length block of up to `most` bytes, and the byte after it.

        Raises:
            SilenceError: no whole block within the timeout.
            ValueError: it is no such block.
            EOFError: the other end has closed the connection.
            OSError: the connection failed.
        """
        end_s = time.monotonic() + self._timeout_s
        digits = count_digits(self._take_when_there(2, end_s))
        size = read_size(self._take_when_there(digits, end_s), most)
        return self._take_when_there(size, end_s), self._take_when_there(1, end_s)

    def forget(self) -> bool:
        """Throw away what came; tell whether there was anything."""
        there = bool(self._came)
        self._came.clear()
        return there

    def _take_when_there(self, count: int, end_s: float) -> bytes:
        while len(self._came) < count:
            self._receive(end_s)
        return self._take(count)

    def _take(self, count: int) -> bytes:
        taken = bytes(memoryview(self._came)[:count])
        del self._came[:count]
        return taken

    def _receive(self, end_s: float) -> None:
        if not self._poll.poll(max(0.0, end_s - time.monotonic()) * 1e3):
            raise SilenceError
        piece = self._line.recv(PIECE)
        if not piece:
            raise EOFError("the other end has closed the connection")
        self._came += piece


def count_digits(mark: bytes) -> int:
    """Return how many digits follow a block's first two bytes, `#` and their number.

    Raises:
        ValueError: it is not the begin of a definite-length block (IEEE 488.2, 8.7.9).
    """
    if mark[:1] != b"#" or mark[1:] not in (b"1", b"2", b"3", b"4", b"5", b"6", b"7", b"8", b"9"):
        raise ValueError(f"the answer begins with {mark!r} instead of a block's #")
    return int(mark[1:])


def read_size(digits: bytes, most: int) -> int:
    """Return the size that a block's head tells, bytes.

    Raises:
        ValueError: it is no number, or more than `most`.
    """
    size = int(digits)
    if not 0 <= size <= most:
        raise ValueError(f"a block of {size} bytes where there can be {most} at most")
    return size
