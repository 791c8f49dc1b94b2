"""The USB-TMC device: through pyusb and pyvisa-py, and at its endpoints where no client of ours goes."""

import struct
from importlib import import_module

import pytest
import pyvisa
import usb.core

from sim34410 import Fault
from sim34410.usb import BULK_OUT, Stall, UsbDevice
from tests.drivers.sim34410.links import HandClock, counting_bench, served, visa

IDENTITY = b"Agilent Technologies,34410A,MY47006594,2.35-2.35-0.09-46-09\n"
CLASS_IN, ENDPOINT_IN = 0xA1, 0xA2


def list_resources():
    """Return what pyvisa-py lists of USB; its list of all asks the network first, warns and leaves sockets open."""
    return import_module("pyvisa_py.usb").USBInstrSession.list_resources()  # importable where there is a back end


@pytest.fixture
def device():
    return UsbDevice(counting_bench(HandClock()))


def say(device, content, tag=1, eom=1):
    device.bulk_out(
        struct.pack("<BBBxIB3x", 1, tag, ~tag & 0xFF, len(content), eom) + content + bytes(-len(content) % 4)
    )


def request(device, size, tag=2, termination=None):
    attributes = 0 if termination is None else 2
    device.bulk_out(struct.pack("<BBBxIBB2x", 2, tag, ~tag & 0xFF, size, attributes, termination or 0))


def test_it_is_listed_by_its_numbers_and_opened_by_its_serial():
    with served() as resources, visa():
        # 0957:0607 in decimal, as pyvisa-py writes it
        assert list_resources() == ["USB0::2391::1543::MY47006594::0::INSTR"]
        assert resources["usb"] == "USB0::0x0957::0x0607::MY47006594::INSTR"
        found = usb.core.find(idVendor=0x0957, idProduct=0x0607)
        assert (found.manufacturer, found.serial_number) == ("Agilent Technologies", "MY47006594")


def test_unplugged_it_is_gone_and_plugged_in_again_it_opens():
    bench = counting_bench(HandClock(), [Fault("unplug", at_s=1.0, lasts_s=1.0)])
    with served(bench) as resources, visa() as lines:
        line = lines.open(resources["usb"])
        line.query("SYST:VERS?")
        bench.clock.move(1.5)
        with pytest.raises(ValueError, match="Errno 19"):  # what pyvisa-py makes of a device that is gone
            line.query("SYST:VERS?")
        assert list_resources() == []
        with pytest.raises(ValueError, match="No device found"):
            lines.open(resources["usb"])
        bench.clock.move(1.0)

        with pytest.raises(ValueError, match="Errno 19"):  # the old handle stays dead
            line.query("SYST:VERS?")
        assert lines.open(resources["usb"]).query("SYST:VERS?") == "1994.0"


def test_a_timeout_costs_no_more_than_itself_because_the_abort_is_answered_by_a_short_packet(device):
    say(device, b"SYST:VERS?")
    request(device, 100, tag=2)
    request(device, 100, tag=3)  # instead of the one before
    assert device.control(ENDPOINT_IN, 3, 2, 0x82, 2)[0] == 0x81  # no such transfer
    assert device.control(ENDPOINT_IN, 3, 3, 0x82, 2) == bytes([1, 3])
    assert device.bulk_in(512) == b""
    assert device.control(ENDPOINT_IN, 4, 0, 0x82, 8)[0] == 1

    request(device, 100, tag=4)
    assert device.bulk_in(512)[12:19] == b"1994.0\n"  # the answer was not lost with the request


def test_an_answer_comes_in_pieces_of_the_size_asked_for(device):
    say(device, b"*IDN?")
    pieces, tag = [], 2
    for tag in range(2, 9):
        request(device, 10, tag=tag)
        transfer = device.bulk_in(512)
        message, echoed, inverse, size, attributes = struct.unpack_from("<BBBxIB", transfer)
        assert (message, echoed, inverse, len(transfer) % 4) == (2, tag, ~tag & 0xFF, 0)
        pieces.append(transfer[12 : 12 + size])
        if attributes & 1:
            break

    assert b"".join(pieces) == IDENTITY
    assert [len(piece) for piece in pieces] == [10] * 6


def test_an_answer_ends_with_the_character_asked_for(device):
    say(device, b"*IDN?")
    request(device, 100, termination=ord(","))

    assert device.bulk_in(512)[12:].startswith(b"Agilent Technologies,\0")


def test_a_transfer_of_full_packets_is_ended_by_an_empty_one(device):
    say(device, b"FORM REAL,64;:CONF:VOLT:DC 10;:TRIG:DEL 0;:VOLT:ZERO:AUTO OFF;:SAMP:COUN 62;:INIT")
    device.bench.clock.move(60.0)
    say(device, b"R?")  # 12 of the header, 5 of the block's head, 62 x 8, and the newline are 514; to be cut at 500
    request(device, 500)

    assert len(device.bulk_in(512)) == 512
    assert device.bulk_in(512) == b""
    assert device.bulk_in(512) is None


def test_a_read_for_more_than_full_packets_takes_the_empty_one_with_it(device):
    say(device, b"FORM REAL,64;:CONF:VOLT:DC 10;:TRIG:DEL 0;:VOLT:ZERO:AUTO OFF;:SAMP:COUN 62;:INIT")
    device.bench.clock.move(60.0)
    say(device, b"R?")
    request(device, 500)

    assert len(device.bulk_in(1024)) == 512
    assert device.bulk_in(512) is None  # an empty one now would be taken for the next answer


def test_a_message_may_come_in_several_transfers_and_each_in_several_packets(device):
    head = struct.pack("<BBBxIB3x", 1, 1, 0xFE, 6, 0)
    device.bulk_out(head + b"SY")
    device.bulk_out(b"ST:V\0\0")
    say(device, b"ERS?", tag=2)
    request(device, 100)

    assert device.bulk_in(512)[12:19] == b"1994.0\n"


@pytest.mark.parametrize(
    "packet",
    [b"", bytes(11), struct.pack("<BBBxIB3x", 1, 1, 1, 0, 1), struct.pack("<BBBxIB3x", 9, 1, 0xFE, 0, 1)],
    ids=["empty", "short", "tag and inverse differ", "unknown message"],
)
def test_a_broken_header_halts_the_endpoint_until_the_halt_is_cleared(device, packet):
    with pytest.raises(Stall):
        device.bulk_out(packet)
    with pytest.raises(Stall):
        say(device, b"SYST:VERS?")
    device.control(0x02, 1, 0, BULK_OUT, 0)  # CLEAR_FEATURE(ENDPOINT_HALT)
    say(device, b"SYST:VERS?")
    request(device, 100)

    assert device.bulk_in(512)[12:19] == b"1994.0\n"


def test_clear_empties_the_buffers_and_halts_bulk_out_until_the_host_has_noticed(device):
    say(device, b"*IDN?")
    request(device, 100)
    assert device.control(CLASS_IN, 5, 0, 0, 1) == b"\x01"
    assert device.control(CLASS_IN, 6, 0, 0, 2) == b"\x01\x00"
    with pytest.raises(Stall):
        say(device, b"SYST:ERR?")
    device.clear_halt(BULK_OUT)
    assert device.bulk_in(512) is None
    say(device, b"SYST:ERR?")
    request(device, 100)

    assert device.bulk_in(512)[12:].startswith(b'+0,"No error"')


def test_the_status_byte_comes_by_the_interrupt_endpoint_with_its_tag(device):
    say(device, b"*IDN?")

    assert device.control(CLASS_IN, 128, 5, 0, 3) == bytes([1, 5, 0])
    notified, status_byte = device.interrupt_in()
    assert notified == 0x85
    assert status_byte & 16  # USB488, table 7, and a message is available
    assert device.interrupt_in() is None


def test_the_bus_trigger_triggers(device):
    say(device, b"TRIG:SOUR BUS;:INIT")
    device.bulk_out(struct.pack("<BBB9x", 128, 7, 0xF8))
    say(device, b"STAT:OPER:COND?")
    request(device, 100)

    assert device.bulk_in(512)[12:16] == b"+16\n"


def test_pyvisa_py_s_raw_requests_reach_it():
    with served() as resources, visa() as lines:
        line = lines.open(resources["usb"])
        device = lines.manager.visalib.sessions[line.session].interface.usb_dev
        device.ctrl_transfer(CLASS_IN, 5, 0, 0, 1)
        with pytest.raises(ValueError, match="Pipe error"):
            line.query("SYST:VERS?")
        device.clear_halt(BULK_OUT)

        assert line.query("SYST:VERS?") == "1994.0"
        assert isinstance(line, pyvisa.resources.USBInstrument)
