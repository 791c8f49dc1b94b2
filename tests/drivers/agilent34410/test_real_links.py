"""The driver through pyvisa-py on every front end of the simulated meter, in real time: stream, lose, come back."""

import gc
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import agilent34410
from aemd.acquire.acquisition import Acquisition
from aemd.acquire.instrument import host_ns
from aemd.block import READING
from aemd.errors import InstrumentError
from agilent34410.link import open_link
from sim34410 import Fault
from tests.drivers.sim34410.links import HandClock, counting_bench, served

LINKS = ["socket", "vxi11", "usb", "serial"]
OPTIONS = agilent34410.Options(nplc=0.2, autozero="off", interval_s=0.01, timeout_s=2.0, baud_rate=115200)
PATIENT = replace(OPTIONS, timeout_s=60.0)  # where everything comes, however slow the machine
OUTAGE_s = 1.0


@pytest.mark.parametrize("link", LINKS)
def test_a_stream_over_this_link_is_the_meters_and_a_cable_that_was_out_costs_what_was_on_the_wire(link: str) -> None:
    bench = counting_bench(time.monotonic_ns)
    batches = []
    with (
        served(bench) as resources,
        closing(agilent34410.open_instrument(resources[link], OPTIONS, host_ns)) as instrument,
        Acquisition(instrument, most_readings=300) as acquisition,
    ):
        for batch in acquisition.batches():
            if not batches:  # it streams; now, however long the machine took to get here
                with bench.lock:
                    now_s = (time.monotonic_ns() - bench._on_ns) * 1e-9
                    bench.add([Fault("unplug", at_s=now_s, lasts_s=OUTAGE_s)])
            batches.append(batch)
        truth = bench.truth
    readings = np.concatenate([np.empty(0, READING), *(batch.readings for batch in batches)])
    said = [event.message for batch in batches for event in batch.events if event.kind == "link"]

    assert readings.size == 300
    assert np.array_equal(readings["value_V"], truth["value_V"][readings["index"]])
    # One look's, if the plug was pulled in it; and not what the meter took during the outage.
    assert acquisition.counts.lost == readings["index"][-1] + 1 - 300 < OUTAGE_s / OPTIONS.interval_s / 2
    assert acquisition.outages >= 1, said
    assert any("back after" in message for message in said)


@pytest.mark.parametrize("link", LINKS)
def test_a_block_of_any_size_is_followed_by_the_next_answer(link: str) -> None:
    bench = counting_bench(clock := HandClock())
    with (
        served(bench) as resources,
        closing(agilent34410.open_instrument(resources[link], PATIENT, clock)) as instrument,
    ):
        instrument.start()
        taken = 0
        for count in range(
            1, 140
        ):  # over two packets of USB: an answer that ends with a full one has an end of its own
            clock.move(1.4)
            taken += instrument.drain(count).values_V.size

        assert taken == sum(range(1, 140))


@pytest.mark.parametrize("link", LINKS)
def test_after_a_timeout_the_link_is_cleared_and_answers_the_next_question(link: str) -> None:
    bench = counting_bench(time.monotonic_ns, [Fault("lost", at_s=0.0)])
    with served(bench) as resources:
        line = open_link(resources[link], 0.5, OPTIONS.serial_line)
        with pytest.raises(InstrumentError):
            line.query("*IDN?")
        answer = ""
        for _ in range(50):  # the first time, unless the machine is so slow that an answer takes half a second
            line.clear()
            with suppress(InstrumentError):
                answer = line.query("*IDN?")
                break
        line.close()

        assert "34410A" in answer


def test_what_a_program_that_was_killed_had_asked_for_over_usb_is_no_error_of_ours() -> None:
    with served(counting_bench(clock := HandClock())) as resources:
        killed = open_link(resources["usb"], 60.0)
        killed.write("SYST:VERS?")  # it never reads the answer, nor closes the line
        with closing(killed), closing(agilent34410.open_instrument(resources["usb"], PATIENT, clock)) as instrument:
            instrument.start()

            assert instrument.drain(1).messages == ()


@pytest.mark.parametrize("answers", [True, False], ids=["it hangs up", "nobody listens"])
def test_a_vxi_11_link_that_cannot_be_made_leaves_no_socket_open(answers: bool) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as listener, ThreadPoolExecutor(1) as pool:
        resource = f"TCPIP0::127.0.0.1,{listener.getsockname()[1]}::inst0::INSTR"
        if not answers:
            listener.close()
        gc.collect()  # nothing of earlier tests goes meanwhile
        counts = []
        for _ in range(2):  # after the first, libusb has a socket of its own
            hung_up = pool.submit(_hang_up, listener) if answers else None
            begun_s = time.monotonic()
            with pytest.raises(InstrumentError, match="cannot open"):
                open_link(resource, 60.0)
            assert time.monotonic() - begun_s < 4.5  # pyvisa-py takes 5 s to notice that somebody hung up
            if hung_up:
                hung_up.result()
            counts.append(_count_sockets())
        assert counts[0] == counts[1]


def _hang_up(listener: socket.socket) -> None:
    """Take one connection, and no call of it."""
    connection, _ = listener.accept()
    connection.close()


def _count_sockets() -> int:
    """How many sockets this process has open, as the kernel lists them."""
    links = []
    for descriptor in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # the listing's own, closed by now
            links.append(str(descriptor.readlink()))
    return sum(link.startswith("socket:") for link in links)


@pytest.mark.timeout(30)
def test_closing_a_vxi_11_link_to_a_dead_peer_does_not_block() -> None:
    with served(counting_bench(time.monotonic_ns)) as resources:
        line = open_link(resources["vxi11"], 2.0)
        line.query("*IDN?")
    begun_s = time.monotonic()
    with pytest.raises(InstrumentError):
        line.query("*IDN?")
    line.close()

    assert time.monotonic() - begun_s < 7.5  # its own timeout and a second more; 5 s on top without the guard
