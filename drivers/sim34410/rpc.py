"""ONC remote procedure calls over a stream: records (RFC 5531, section 11), calls, replies and XDR (RFC 4506).

As much of it as an instrument's VXI-11 server needs; no port mapper.
"""

import struct
from dataclasses import dataclass

__all__ = [
    "GARBAGE_ARGUMENTS",
    "PROCEDURE_UNAVAILABLE",
    "PROGRAM_UNAVAILABLE",
    "Arguments",
    "Call",
    "Records",
    "parse_call",
]
__all__ += ["answer", "opaque", "refuse", "uint"]

PROGRAM_UNAVAILABLE, PROCEDURE_UNAVAILABLE, GARBAGE_ARGUMENTS = 1, 3, 4

MOST_RECORD_BYTES = 1 << 22  # no client of an instrument sends more in one call

_LAST = 1 << 31
_CALL, _REPLY, _VERSION = 0, 1, 2


def uint(*values: int) -> bytes:
    """Return XDR unsigned integers."""
    return struct.pack(f">{len(values)}I", *values)


def opaque(content: bytes) -> bytes:
    """Return variable-length opaque data: length, bytes, padding to four."""
    return uint(len(content)) + content + bytes(-len(content) % 4)


class Arguments:
    """XDR arguments, read in order.

    Raises:
        ValueError: they are shorter than what is asked for.
    """

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._begin = 0

    def uint(self) -> int:
        """Return the next unsigned integer."""
        return int(struct.unpack(">I", self._take(4))[0])

    def opaque(self) -> bytes:
        """Return the next opaque data or string."""
        size = self.uint()
        content = self._take(size)
        self._take(-size % 4)
        return content

    def rest(self) -> bytes:
        """Return what is left."""
        return self._content[self._begin :]

    def _take(self, size: int) -> bytes:
        taken = self._content[self._begin : self._begin + size]
        if len(taken) < size:
            raise ValueError(f"{size} bytes wanted, {len(taken)} there")
        self._begin += size
        return taken


@dataclass(frozen=True, slots=True)
class Call:
    """One call."""

    transaction: int
    program: int
    procedure: int
    arguments: bytes


def parse_call(record: bytes) -> Call:
    """Return the call that a record holds; its credentials are skipped.

    Raises:
        ValueError: it is none.
    """
    fields = Arguments(record)
    transaction, kind, version, program, _, procedure = (fields.uint() for _ in range(6))
    if kind != _CALL or version != _VERSION:
        raise ValueError("not a call")
    for _ in ("credentials", "verifier"):
        fields.uint()
        fields.opaque()
    return Call(transaction, program, procedure, fields.rest())


def answer(call: Call, results: bytes) -> bytes:
    """Return the record that answers a call."""
    return _record(uint(call.transaction, _REPLY, 0, 0, 0, 0) + results)


def refuse(call: Call, reason: int) -> bytes:
    """Return the record that refuses a call, which the server does not have or cannot read."""
    return _record(uint(call.transaction, _REPLY, 0, 0, 0, reason))


def _record(content: bytes) -> bytes:
    return uint(_LAST | len(content)) + content


class Records:
    """Cuts a stream into records.

    Raises:
        ValueError: a record is longer than any call is.
    """

    def __init__(self) -> None:
        self._received = bytearray()
        self._fragments = bytearray()

    def feed(self, received: bytes) -> None:
        """Take bytes, in any pieces."""
        self._received += received

    def next(self) -> bytes | None:
        """Return the next whole record; None while it is not there."""
        while len(self._received) >= 4:
            (head,) = struct.unpack_from(">I", self._received)
            size = head & ~_LAST
            if size + len(self._fragments) > MOST_RECORD_BYTES:
                raise ValueError(f"a record of {size} bytes")
            if len(self._received) < 4 + size:
                return None
            self._fragments += self._received[4 : 4 + size]
            del self._received[: 4 + size]
            if head & _LAST:
                record, self._fragments = bytes(self._fragments), bytearray()
                return record
        return None
