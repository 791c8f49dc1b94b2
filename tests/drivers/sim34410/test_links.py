"""Each link of the meter through pyvisa-py: identify, stream a full memory, time out and be in step again, share."""

import numpy as np
import pytest
import pyvisa
from pyvisa.constants import BufferOperation, StatusCode

from sim34410 import Fault
from tests.drivers.sim34410.links import (
    FULL,
    HandClock,
    RunningClock,
    counting_bench,
    read_block,
    served,
    visa,
    wait_long,
)

LINKS = ["socket", "vxi11", "usb", "serial"]
IDENTITY = "Agilent Technologies,34410A,MY47006594,2.35-2.35-0.09-46-09"
STREAM = (
    "CONF:VOLT:DC 10;:VOLT:APER 1E-4;:VOLT:ZERO:AUTO OFF;:TRIG:DEL 0;COUN INF;"
    ":SAMP:COUN MAX;SOUR TIM;TIM 1E-4;:FORM REAL,64;:INIT;:SYST:ERR?"
)


@pytest.mark.parametrize("link", LINKS)
def test_it_is_identified(link):
    with served() as resources, visa() as lines:
        assert lines.open(resources[link]).query("*IDN?") == IDENTITY


@pytest.mark.parametrize(
    "link", ["socket", "vxi11", "usb"]
)  # pyvisa-py reads a serial line byte by byte: 10 s for a memory
def test_a_full_memory_arrives_whole_and_in_order(link):
    clock = HandClock()
    bench = counting_bench(clock)
    with served(bench) as resources, visa() as lines:
        line = lines.open(resources[link])
        assert line.query(STREAM) == '+0,"No error"'
        clock.move(FULL * 1e-4 - 1e-5)
        values_V = read_block(line, "R?")
        assert line.query("DATA:POIN?;:SYST:ERR?") == '+0;+0,"No error"'
    truth = bench.truth

    assert values_V.size == FULL - 1  # the last is finished one reading's length after it began
    assert np.array_equal(values_V, truth["value_V"][: values_V.size])
    assert np.allclose(np.diff(values_V), 1e-8, atol=1e-13)


def test_a_block_passes_a_serial_line_with_every_byte_value():
    clock = HandClock()
    bench = counting_bench(clock)
    with served(bench) as resources, visa() as lines:
        line = lines.open(resources["serial"])
        line.query(STREAM)
        clock.move(0.2)
        values_V = read_block(line, "R?")

    assert np.array_equal(values_V, bench.truth["value_V"][: values_V.size])
    assert {*values_V.tobytes()} >= {0x03, 0x0A, 0x0D, 0x11, 0x13}  # what a terminal would take for its own


@pytest.mark.parametrize("link", LINKS)
def test_after_a_timeout_and_a_clear_question_and_answer_are_in_step_again(link):
    bench = counting_bench(RunningClock(), [Fault("late", at_s=0.0, delay_s=1000.0)])
    with served(bench) as resources, visa() as lines:
        line = lines.open(resources[link], timeout_s=0.2)
        with pytest.raises(pyvisa.VisaIOError) as caught:
            line.query("*IDN?")
        wait_long(line)
        bench.clock.move(1000.0)
        lines.open(resources["socket"]).query("*STB?")  # now the server has sent it
        if link == "usb":  # pyvisa-py has no clear for it; the transfer was aborted when it timed out
            assert line.query("*STB?") == "+4"  # an error waits:
            assert line.query("SYST:ERR?") == '-410,"Query INTERRUPTED"'
        elif link == "serial":  # nor for this
            line.flush(BufferOperation.discard_read_buffer)
        else:
            line.clear()

        assert line.query("SYST:VERS?") == "1994.0"
        assert caught.value.error_code == StatusCode.error_timeout


def test_a_late_answer_on_a_socket_is_taken_for_the_next_one_unless_it_is_cleared():
    bench = counting_bench(HandClock(), [Fault("late", at_s=0.0, delay_s=1.0)])
    with served(bench) as resources, visa() as lines:
        line = lines.open(resources["socket"], timeout_s=0.2)
        with pytest.raises(pyvisa.VisaIOError):
            line.query("*IDN?")
        wait_long(line)
        bench.clock.move(2.0)

        assert line.query("SYST:VERS?") == IDENTITY


@pytest.mark.parametrize(
    "links", [("socket", "socket"), ("vxi11", "vxi11"), ("socket", "vxi11"), ("vxi11", "serial"), ("usb", "socket")]
)
def test_two_clients_are_served_at_once(links):
    with served() as resources, visa() as lines:
        one, other = (lines.open(resources[link]) for link in links)
        one.write("*IDN?")
        assert other.query("SYST:VERS?") == "1994.0"
        assert one.read() == IDENTITY


@pytest.mark.parametrize("link", ["vxi11", "usb"])
def test_a_question_before_the_answer_was_read_ends_it_on_a_link_that_knows_messages(link):
    with served() as resources, visa() as lines:
        line = lines.open(resources[link])
        line.write("*IDN?")

        assert line.query("SYST:ERR?") == '-410,"Query INTERRUPTED"'  # IEEE 488.2, 6.3.2.3


@pytest.mark.parametrize("link", ["vxi11", "usb"])
def test_reading_what_was_not_asked_for_is_an_error_and_a_timeout(link):
    with served() as resources, visa() as lines:
        line = lines.open(resources[link], timeout_s=0.1)
        with pytest.raises(pyvisa.VisaIOError):
            line.read()
        wait_long(line)

        assert line.query("SYST:ERR?") == '-420,"Query UNTERMINATED"'  # IEEE 488.2, 6.3.2.2


def test_the_status_byte_tells_that_an_answer_waits():
    with served() as resources, visa() as lines:
        line = lines.open(resources["vxi11"])
        line.write("*IDN?")

        assert line.read_stb() & 16
        line.read()
        assert not line.read_stb() & 16


def test_device_clear_stops_the_sampling_and_keeps_what_is_stored():
    clock = HandClock()
    bench = counting_bench(clock)
    with served(bench) as resources, visa() as lines:
        line = lines.open(resources["vxi11"])
        line.query(STREAM)
        clock.move(1.00005)
        line.clear()
        clock.move(1.0)

        assert line.query("DATA:POIN?;:STAT:OPER:COND?") == "+10000;+512"


def test_the_end_of_the_last_vxi_11_link_clears_the_meter_two_seconds_later():
    clock = HandClock()
    bench = counting_bench(clock)
    with served(bench) as resources, visa() as lines:
        watch = lines.open(resources["socket"])
        one, other = (lines.open(resources["vxi11"]) for _ in range(2))
        one.query(STREAM)
        clock.move(1.0)
        one.close()
        clock.move(2.5)
        assert watch.query("STAT:OPER:COND?") == "+528"  # measuring, and readings are stored
        other.close()
        watch.query("*STB?")  # the server has seen it go
        clock.move(1.9)
        assert watch.query("STAT:OPER:COND?") == "+528"
        clock.move(0.2)

        assert watch.query("STAT:OPER:COND?;:DATA:POIN?") == "+0;+0"


def test_a_socket_that_ends_leaves_the_meter_sampling():
    clock = HandClock()
    with served(counting_bench(clock)) as resources, visa() as lines:
        line = lines.open(resources["socket"])
        line.query(STREAM)
        line.close()
        clock.move(3.0)

        assert int(lines.open(resources["socket"]).query("DATA:POIN?")) in (29_999, 30_000)


def test_a_34401a_on_a_serial_line_wants_remote_first_and_takes_control_c():
    bench = counting_bench(HandClock(), identity="HEWLETT-PACKARD,34401A,0,10-5-2")
    with served(bench) as resources, visa() as lines:
        line = lines.open(resources["serial"])
        line.write("CONF:VOLT:DC 10")
        line.write("SYST:REM")
        assert line.query("SYST:ERR?") == '+550,"Command not allowed in local"'
        line.write("TRIG:SOUR BUS;:INIT;*OPC?")
        line.write_raw(b"\x03")

        assert line.query("*IDN?") == "HEWLETT-PACKARD,34401A,0,10-5-2"
        line.write("SAMP:TIM 1")
        assert line.query("SYST:ERR?") == '-113,"Undefined header"'
