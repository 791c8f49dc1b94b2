"""Faults as a client sees them through real connections: nobody listens, a connection ends, half an answer comes."""

import socket
import struct
import time
from contextlib import ExitStack, suppress

import pytest
import pyvisa
from hypothesis import given, settings
from hypothesis import strategies as st
from pyvisa.constants import StatusCode

from sim34410 import Fault
from sim34410.vxi11 import Vxi11Conversation, Vxi11Links
from tests.drivers.sim34410.links import HandClock, RunningClock, counting_bench, served, visa

IDENTITY = "Agilent Technologies,34410A,MY47006594,2.35-2.35-0.09-46-09"


def port_of(resource: str) -> int:
    return int(resource.replace(",", "::").split("::")[2])


def wait_until(listens: bool, port: int) -> None:
    """Wait for the server's thread to have opened or shut its port."""
    end_s = time.monotonic() + 60
    while True:
        try:
            # From an address of its own: a connection whose own number happens to be the port's would reach itself.
            socket.create_connection(("127.0.0.1", port), timeout=60, source_address=("127.0.0.2", 0)).close()
            found = True
        except OSError:
            found = False
        if found is listens:
            return
        assert time.monotonic() < end_s
        time.sleep(0.01)


@pytest.mark.parametrize("link", ["socket", "vxi11"])
@pytest.mark.parametrize("kind", ["refuse", "unplug", "power"])
def test_nobody_listens_as_long_as_it_lasts_and_then_on_the_same_port_again(link, kind):
    bench = counting_bench(RunningClock(), [Fault(kind, at_s=1000.0, lasts_s=1000.0)])
    with served(bench) as resources:
        port = port_of(resources[link])
        wait_until(True, port)
        bench.clock.move(1000.0)
        wait_until(False, port)
        bench.clock.move(1000.0)
        wait_until(True, port)
        with visa() as lines:
            assert lines.open(resources[link]).query("*IDN?") == IDENTITY


@pytest.mark.parametrize("kind", ["close", "unplug", "power"])
def test_connections_end(kind):
    bench = counting_bench(RunningClock(), [Fault(kind, at_s=1000.0, lasts_s=1000.0)])
    with served(bench) as resources, ExitStack() as stack:
        on_socket, on_vxi11 = (
            stack.enter_context(socket.create_connection(("127.0.0.1", port_of(resources[link])), timeout=60))
            for link in ("socket", "vxi11")
        )
        on_socket.sendall(b"*IDN?\n")
        assert on_socket.recv(100).decode().strip() == IDENTITY
        on_vxi11.sendall(struct.pack(">11I", 1 << 31 | 40, 7, 0, 2, 0x0607AF, 1, 0, 0, 0, 0, 0))  # a call of nothing
        assert len(on_vxi11.recv(100)) == 28  # both were accepted
        bench.clock.move(1000.0)

        assert on_socket.recv(1) == b""
        assert on_vxi11.recv(1) == b""


class Sprung:
    """A clock that jumps ahead by itself, while it is asked for the time the `calls`th time from now."""

    def __init__(self) -> None:
        self.now_ns = 10**12
        self.calls = -1

    def __call__(self) -> int:
        self.calls -= 1
        if self.calls == 0:
            self.now_ns += 1000 * 10**9
        return self.now_ns


def test_a_plug_that_is_pulled_while_somebody_is_let_in_ends_the_connection_and_not_the_service():
    ended = 0
    for calls in range(1, 7):  # the third is between the look at the door and the new line
        bench = counting_bench(Sprung(), [Fault("unplug", at_s=1000.0, lasts_s=500.0)])
        with served(bench) as resources:
            port = port_of(resources["socket"])
            bench.clock.calls = calls
            with suppress(ConnectionError), socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
                connection.sendall(b"*IDN?\n")
                ended += connection.recv(100) == b""
            bench.clock.now_ns += 1000 * 10**9
            wait_until(True, port)

    assert ended


@pytest.mark.parametrize("link", ["socket", "vxi11", "usb", "serial"])
def test_half_an_answer_is_a_timeout(link):
    bench = counting_bench(RunningClock(), [Fault("half", at_s=0.0)])
    with served(bench) as resources, visa() as lines:
        line = lines.open(resources[link], timeout_s=0.2)
        with pytest.raises(pyvisa.VisaIOError) as caught:
            line.query("*IDN?")

        assert caught.value.error_code == StatusCode.error_timeout


@pytest.mark.parametrize("link", ["socket", "vxi11", "usb", "serial"])
def test_garbage_precedes_an_answer(link):
    bench = counting_bench(RunningClock(), [Fault("garbage", at_s=0.0, seed=3)])
    with served(bench) as resources, visa() as lines:
        line = lines.open(resources[link])
        line.write("SYST:VERS?")

        assert line.read_raw().endswith(b"1994.0\n")


@given(st.lists(st.binary(max_size=60), max_size=6), st.booleans())
@settings(max_examples=200)
def test_no_bytes_make_the_vxi_11_server_fail(pieces, whole):
    links = Vxi11Links(counting_bench(HandClock()), 1)
    conversation = Vxi11Conversation(links)
    for piece in pieces:
        conversation.receive(struct.pack(">I", 1 << 31 | len(piece)) + piece if whole else piece)
        conversation.take()
        assert conversation.wake_ns is None or conversation.wake_ns > 0
    conversation.close()

    assert links.lines == {}


@given(st.integers(0, 30), st.lists(st.integers(0, 2**32 - 1) | st.integers(0, 3), max_size=8), st.binary(max_size=20))
@settings(max_examples=300)
def test_no_arguments_of_a_call_make_it_fail(procedure, numbers, rest):
    bench = counting_bench(HandClock())
    conversation = Vxi11Conversation(Vxi11Links(bench, 1))
    call(conversation, 10, struct.pack(">IIII", 1, 0, 0, 5) + b"inst0\0\0\0")
    call(conversation, procedure, struct.pack(f">{len(numbers)}I", *numbers) + rest)
    bench.clock.move(1e7)
    conversation.take()

    assert not conversation.is_closed


def call(conversation: Vxi11Conversation, procedure: int, arguments: bytes) -> bytes:
    record = struct.pack(">10I", 7, 0, 2, 0x0607AF, 1, procedure, 0, 0, 0, 0) + arguments
    conversation.receive(struct.pack(">I", 1 << 31 | len(record)) + record)
    return conversation.take()[28:]  # after the record mark, the transaction and the reply's head


def test_a_lock_keeps_others_out_until_it_is_given_back():
    bench = counting_bench(HandClock())
    links = Vxi11Links(bench, 1)
    one, other = Vxi11Conversation(links), Vxi11Conversation(links)
    create = struct.pack(">IIII", 1, 0, 0, 5) + b"inst0\0\0\0"
    write = struct.pack(">IIIII", 1000, 0, 8, 6, 0)[:16] + b"*IDN?\n\0\0"
    (_, first, *_), (_, second, *_) = (struct.unpack(">4I", call(each, 10, create)) for each in (one, other))

    assert call(one, 18, struct.pack(">III", first, 0, 0)) == struct.pack(">I", 0)
    assert call(other, 11, struct.pack(">I", second) + write) == struct.pack(">II", 11, 0)  # device locked
    assert call(other, 18, struct.pack(">III", second, 1, 1000)) == b""  # it waits for a second:
    bench.clock.move(1.1)
    assert other.take()[28:] == struct.pack(">I", 11)
    assert call(other, 18, struct.pack(">III", second, 1, 1000)) == b""  # again, and now the lock is given back
    assert call(one, 19, struct.pack(">I", first)) == struct.pack(">I", 0)
    assert other.take()[28:] == struct.pack(">I", 0)
    one.close()
    assert call(other, 11, struct.pack(">I", second) + write) == struct.pack(">II", 0, 6)


def test_the_abort_channel_ends_a_read_that_waits():
    bench = counting_bench(HandClock())
    links = Vxi11Links(bench, 1)
    core, abort = Vxi11Conversation(links), Vxi11Conversation(links)
    (_, link, *_) = struct.unpack(">4I", call(core, 10, struct.pack(">IIII", 1, 0, 0, 5) + b"inst0\0\0\0"))
    assert call(core, 12, struct.pack(">6I", link, 100, 10_000, 0, 0, 0)) == b""
    record = struct.pack(">11I", 8, 0, 2, 0x0607B0, 1, 1, 0, 0, 0, 0, link)
    abort.receive(struct.pack(">I", 1 << 31 | len(record)) + record)

    assert abort.take()[28:] == struct.pack(">I", 0)
    assert core.take()[28:] == struct.pack(">III", 23, 0, 0)
