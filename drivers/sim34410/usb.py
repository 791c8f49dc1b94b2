"""The meter as a USB-TMC device, at its endpoints: control, Bulk-OUT, Bulk-IN, Interrupt-IN; no host and no library.

USBTMC 1.00 and its subclass USB488 1.00 (sections in the code). Whoever plays the host calls one endpoint at a time and
holds the bench's lock.
"""

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from sim34410.bench import Bench, Line
from sim34410.status import ScpiError

__all__ = ["BULK_IN", "BULK_OUT", "INTERRUPT_IN", "Stall", "UsbDevice"]

BULK_OUT, BULK_IN, INTERRUPT_IN = 0x01, 0x82, 0x83
PACKET_BYTES = 512
"""Of the bulk endpoints at high speed; a shorter packet ends a transfer."""

SUCCESS, FAILED, NOT_IN_PROGRESS = 0x01, 0x80, 0x81
"""USBTMC_status (table 16)."""

DEV_DEP_MSG_OUT, REQUEST_DEV_DEP_MSG_IN, TRIGGER = 1, 2, 128
"""MsgID (table 2; USB488 table 1)."""

HEADER_BYTES = 12
MOST_REMOTE_BYTES = 1 << 22  # a client that never ends a message must not fill the memory
_EOM, _TERMINATION_SET = 1, 2

_DEVICE_TO_HOST = 0x80
_STANDARD, _CLASS = 0x00, 0x20


class Stall(Exception):  # noqa: N818 - it is what USB calls it
    """The device refuses a request, or its endpoint is halted."""


@dataclass(slots=True)
class _Transfers:
    """What is under way at the endpoints."""

    owed: int = 0
    """Bytes of a message that the host has announced and not sent."""
    ends: bool = False
    """Whether the message is whole with them."""
    message: bytearray = field(default_factory=bytearray)
    is_out_halted: bool = False
    request: tuple[int, int, int | None] | None = None
    """The host's request for an answer: tag, most bytes, termination character."""
    tag: int = 0
    """Of the answer being sent."""
    sending: bytearray = field(default_factory=bytearray)
    owes_short_packet: bool = False
    """The answer ended with a full packet and filled what the host read, so an empty one has to tell its end."""
    is_aborting: bool = False
    notifications: deque[bytes] = field(default_factory=deque)


class UsbDevice:
    """One meter at the end of a USB cable."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        identity = [field.strip() for field in bench.meter.properties.identity.split(",")]
        self._strings = dict(enumerate((identity[0], f"{identity[1]} Digital Multimeter", identity[2]), start=1))
        self.vendor, self.product = bench.meter.member.usb
        self.serial = identity[2]
        self._line: Line | None = None
        self._plugs = bench.hang_ups
        self._now = _Transfers()
        self._requests: dict[int, Callable[[int, int], bytes]] = {
            1: lambda tag, _: bytes([NOT_IN_PROGRESS, tag]),  # INITIATE_ABORT_BULK_OUT: none lasts
            2: lambda *_: struct.pack("<B3xI", SUCCESS, 0),  # CHECK_ABORT_BULK_OUT_STATUS
            3: self._initiate_abort_bulk_in,
            4: lambda *_: struct.pack("<B3xI", SUCCESS, 0),  # CHECK_ABORT_BULK_IN_STATUS
            5: self._initiate_clear,
            6: lambda *_: bytes([SUCCESS, 0]),  # CHECK_CLEAR_STATUS: done, nothing left in the Bulk-IN queue
            7: lambda *_: _CAPABILITIES,
            64: lambda *_: bytes([SUCCESS]),  # INDICATOR_PULSE
            128: self._read_status_byte,
            160: lambda *_: bytes([SUCCESS]),  # REN_CONTROL
            161: lambda *_: bytes([SUCCESS]),  # GO_TO_LOCAL
            162: lambda *_: bytes([SUCCESS]),  # LOCAL_LOCKOUT
        }

    @property
    def resource(self) -> str:
        """Its VISA resource, as people write it."""
        return f"USB0::0x{self.vendor:04X}::0x{self.product:04X}::{self.serial}::INSTR"

    @property
    def plugs(self) -> int | None:
        """A number that changes with each time it was plugged in or started anew; None while it is not there."""
        if not self.bench.is_plugged:
            return None
        if self._plugs != self.bench.hang_ups:
            self._plugs = self.bench.hang_ups
            self._line = None
            self._now = _Transfers()
        return self._plugs

    @property
    def device_descriptor(self) -> bytes:
        """USB 2.0, table 9-8."""
        ids = (self.vendor, self.product, 0x0100)
        return struct.pack("<BBHBBBBHHHBBBB", 18, 1, 0x0200, 0, 0, 0, 64, *ids, 1, 2, 3, 1)

    @property
    def configuration_descriptor(self) -> bytes:
        """With its interface (class 0xFE, subclass 3: USBTMC, protocol 1: USB488) and three endpoints."""
        interface = struct.pack("<9B", 9, 4, 0, 0, 3, 0xFE, 3, 1, 0)
        endpoints = b"".join(
            struct.pack("<BBBBHB", 7, 5, address, kind, size, interval)
            for address, kind, size, interval in (
                (BULK_OUT, 2, PACKET_BYTES, 0),
                (BULK_IN, 2, PACKET_BYTES, 0),
                (INTERRUPT_IN, 3, 64, 16),
            )
        )
        content = interface + endpoints
        return struct.pack("<BBHBBBBB", 9, 2, 9 + len(content), 1, 1, 0, 0xC0, 1) + content

    # -- endpoints ---------------------------------------------------------------------------------------------------

    def control(self, kind: int, request: int, value: int, index: int, length: int) -> bytes:
        """Obey a control transfer; return what it sends to the host, empty where the host sends.

        Raises:
            Stall: it is not supported.
        """
        if kind & 0x60 == _CLASS and kind & _DEVICE_TO_HOST and request in self._requests:
            return self._requests[request](value & 0xFF, index)[:length]
        if kind & 0x60 == _STANDARD:
            return self._standard(kind, request, value, index)[:length]
        raise Stall

    def bulk_out(self, packet: bytes) -> None:
        """Take what the host sends in one go.

        Raises:
            Stall: the endpoint is halted, now or because of this.
        """
        if self._now.is_out_halted:
            raise Stall
        if self._now.owed:
            self._deliver(packet)
            return
        if len(packet) < HEADER_BYTES:
            self._halt()
        message, tag, inverse, _, size, attributes, termination = struct.unpack_from("<BBBBIBB", packet)
        if not tag or inverse != ~tag & 0xFF or message not in (DEV_DEP_MSG_OUT, REQUEST_DEV_DEP_MSG_IN, TRIGGER):
            self._halt()  # 4.2.2.2: an unknown header
        if message == REQUEST_DEV_DEP_MSG_IN:
            self._now.request = (tag, size, termination if attributes & _TERMINATION_SET else None)
            if not self._talk().is_answering:
                self._talk().unterminated()
        elif message == TRIGGER:
            self._trigger()
        elif size > MOST_REMOTE_BYTES:
            self._halt()
        else:
            self._now.owed, self._now.ends = size, bool(attributes & _EOM)
            self._deliver(packet[HEADER_BYTES:])

    def bulk_in(self, length: int) -> bytes | None:
        """Return up to `length` bytes, fewer (even none) at the end of a transfer; None while there is nothing yet."""
        if self._now.is_aborting:
            self._now.is_aborting = False
            return b""  # a short packet ends the transfer (4.2.1.4); without it the host waits for 5 s
        if not self._now.sending and not self._now.owes_short_packet:
            self._begin_transfer()
            if not self._now.sending:
                return None
        sent = bytes(self._now.sending[:length])
        del self._now.sending[:length]
        # A host that reads for more waits for the end and takes the empty packet with the same read (USB 2.0, 5.8.3);
        # kept for the next read, it would be taken for the next answer.
        is_filled = len(sent) == length and length % PACKET_BYTES == 0
        self._now.owes_short_packet = not self._now.sending and bool(sent) and is_filled
        return sent

    def interrupt_in(self) -> bytes | None:
        """Return the next notification; None when there is none."""
        return self._now.notifications.popleft() if self._now.notifications else None

    def clear_halt(self, endpoint: int) -> None:
        """Obey CLEAR_FEATURE(ENDPOINT_HALT)."""
        if endpoint == BULK_OUT:
            self._now.is_out_halted = False
        elif endpoint == BULK_IN:
            self._now.sending.clear()
            self._now.owes_short_packet = False

    def close(self) -> None:
        """The host has let go of the device."""
        if self._line is not None:
            self._line.close()
            self._line = None
        self._now = _Transfers()

    # -- bulk --------------------------------------------------------------------------------------------------------

    def _talk(self) -> Line:
        """Return the line to the meter, opened by the first message."""
        if self._line is None or self._line.is_closed:
            try:
                self._line = self.bench.open_line("usb")
            except ConnectionRefusedError:
                raise Stall from None
        return self._line

    def _halt(self) -> None:
        self._now.is_out_halted = True
        raise Stall

    def _deliver(self, content: bytes) -> None:
        self._now.message += content[: self._now.owed]  # what comes on top is padding to four bytes
        self._now.owed = max(self._now.owed - len(content), 0)
        if self._now.owed:
            return
        if self._now.ends:
            message, self._now.message = bytes(self._now.message), bytearray()
            self._talk().receive(message if message.endswith(b"\n") else message + b"\n")
        elif len(self._now.message) > MOST_REMOTE_BYTES:
            self._halt()

    def _begin_transfer(self) -> None:
        """Put header, content and padding of the answer to the host's request in line, if there is one."""
        if self._now.request is None:
            return
        message = self._talk().message
        if message is None:
            return
        self._now.tag, size, termination = self._now.request
        self._now.request = None
        content = bytes(message.content[:size])
        if termination is not None and (found := content.find(termination)) >= 0:
            content = content[: found + 1]
        del message.content[: len(content)]
        attributes = _EOM * (message.whole and not message.content)
        header = struct.pack(
            "<BBBxIB3x", REQUEST_DEV_DEP_MSG_IN, self._now.tag, ~self._now.tag & 0xFF, len(content), attributes
        )
        self._now.sending += header + content + bytes(-len(content) % 4)

    def _trigger(self) -> None:
        try:
            self.bench.meter.trigger()
        except ScpiError as error:
            self.bench.meter.report(error.code)

    # -- control -----------------------------------------------------------------------------------------------------

    def _standard(self, kind: int, request: int, value: int, index: int) -> bytes:
        if request == 6 and kind == 0x80:  # GET_DESCRIPTOR
            what, number = value >> 8, value & 0xFF
            if what == 3:
                if number and number not in self._strings:
                    raise Stall
                text = self._strings[number].encode("utf-16-le") if number else b"\x09\x04"  # US English
                return struct.pack("<BB", 2 + len(text), 3) + text
            if what in (1, 2):
                return self.device_descriptor if what == 1 else self.configuration_descriptor
        elif request == 8:  # GET_CONFIGURATION
            return b"\x01"
        elif request == 0:  # GET_STATUS
            return bytes([self._now.is_out_halted and index == BULK_OUT, 0])
        elif request == 1 and kind == 0x02:  # CLEAR_FEATURE of an endpoint
            self.clear_halt(index)
            return b""
        elif request in (1, 3, 9, 11):  # SET_FEATURE, SET_CONFIGURATION, SET_INTERFACE
            return b""
        raise Stall

    def _initiate_abort_bulk_in(self, tag: int, _: int) -> bytes:
        if self._now.request is not None and self._now.request[0] == tag:
            self._now.request = None
        elif (self._now.sending or self._now.owes_short_packet) and self._now.tag == tag:
            self._now.sending.clear()
            self._now.owes_short_packet = False
        else:
            return bytes([NOT_IN_PROGRESS, tag])
        self._now.is_aborting = True
        return bytes([SUCCESS, tag])

    def _initiate_clear(self, *_: int) -> bytes:
        self._now = _Transfers()
        self._talk().clear()
        self._now.is_out_halted = True  # until the host clears it (4.2.1.6)
        return bytes([SUCCESS])

    def _read_status_byte(self, tag: int, _: int) -> bytes:
        self._now.notifications.append(bytes([0x80 | tag, self._talk().status_byte]))  # USB488, 4.3.1
        return bytes([SUCCESS, tag, 0])


_CAPABILITIES = struct.pack("<BxHBB6xHBB8x", SUCCESS, 0x0100, 0x04, 0x01, 0x0100, 0x07, 0x0F)
"""Indicator pulse; termination character; USB488: 488.2, REN_CONTROL, TRIGGER; SCPI, SR1, RL1, DT1 (tables 37, 8)."""
