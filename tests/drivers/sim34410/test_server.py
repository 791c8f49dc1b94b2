import socket
import threading
import time
from contextlib import contextmanager

import pytest
from pyvisa.util import from_ieee_block

import sim34410
from aemd.acquire.instrument import Simulator, find_simulator
from aemd.errors import InstrumentError
from aemd.model import Level, Model
from sim34410 import Meter, MeterProperties, Options, serve, serve_meter

PROTOCOL: Simulator = sim34410  # for the type checker

IDENTITY = b"Agilent Technologies,34410A,MY47006594,2.35-2.35-0.09-46-09\n"


class Client:
    def __init__(self, resource):
        _, host, port, kind = resource.split("::")
        assert kind == "SOCKET"
        self.socket = socket.create_connection((host, int(port)), timeout=60)
        self.file = self.socket.makefile("rb")

    def tell(self, message):
        self.socket.sendall(message.encode() + b"\n")

    def ask(self, message):
        self.tell(message)
        return self.file.readline()

    def close(self):
        self.file.close()
        self.socket.close()


@contextmanager
def served(options=None):
    with serve(options or Options(), "127.0.0.1", 0) as resource:
        clients = []

        def connect():
            clients.append(Client(resource))
            return clients[-1]

        try:
            yield connect
        finally:
            for client in clients:
                client.close()


def test_the_entry_point_leads_to_this_simulator():
    assert find_simulator("agilent34410") is sim34410


def test_clients_are_served_one_after_another_and_at_once():
    with served() as connect:
        first = connect()
        assert first.ask("*IDN?") == IDENTITY
        first.close()
        clients = [connect() for _ in range(5)]
        for client in clients:
            client.tell("*IDN?")
        assert [client.file.readline() for client in clients] == [IDENTITY] * 5


def test_a_reading_is_answered_when_it_has_been_taken():
    with served() as connect:
        client = connect()
        client.tell("VOLT:NPLC 1;:TRIG:DEL 0.1")

        assert abs(float(client.ask("READ?"))) < 1
        assert client.ask("SYST:ERR?") == b'+0,"No error"\n'


def test_an_answer_does_not_wait_for_the_next_idle_look():
    with served() as connect:
        client = connect()
        client.ask("*IDN?")
        client.ask("VOLT:NPLC 0.02;*STB?")
        before_s = time.monotonic()
        for _ in range(20):
            client.ask("READ?")  # 1 ms each; 500 ms between idle looks

        assert time.monotonic() - before_s < 8.0


def test_others_are_served_while_one_waits():
    with served() as connect:
        waiting, other = connect(), connect()
        waiting.tell("SAMP:COUN 100;:TRIG:SOUR BUS;:INIT;*OPC?")
        while other.ask("STAT:OPER:COND?") != b"+32\n":
            pass
        other.tell("ABOR")

        assert waiting.file.readline() == b"1\n"


def test_a_client_that_goes_away_leaves_the_meter_measuring():
    with served() as connect:
        client = connect()
        client.ask("TRIG:COUN INF;:SAMP:COUN MAX;:INIT;*STB?")
        client.close()

        assert connect().ask("STAT:OPER:COND?") == b"+16\n"


def test_a_full_memory_arrives_whole():
    now_ns = [0]
    meter = Meter(Model((Level(level_V=1.25),)).realise(), lambda: now_ns[0], MeterProperties(noise=False))
    with serve_meter(meter, "127.0.0.1", 0, lambda: now_ns[0]) as resource:
        client = Client(resource)
        client.ask("CONF:VOLT:DC 10;:SAMP:COUN 50000;:FORM REAL,64;:INIT;*STB?")
        now_ns[0] += 10**13
        client.tell("R?")
        block = client.file.read(8 + 400_000 + 1)
        values_V = from_ieee_block(block, "d", is_big_endian=True)
        client.close()

    assert block[:8] == b"#6400000"
    assert values_V == [1.25] * 50_000


def test_junk_does_not_end_the_service():
    with served() as connect:
        connect().socket.sendall(bytes(range(256)) * 1000)

        assert connect().ask("*IDN?") == IDENTITY


def test_leaving_ends_the_thread_and_the_connections():
    with serve(Options(), "127.0.0.1", 0) as resource:
        client = Client(resource)
        assert client.ask("*IDN?") == IDENTITY
        assert "sim34410" in [thread.name for thread in threading.enumerate()]

    assert "sim34410" not in [thread.name for thread in threading.enumerate()]
    assert client.file.read() == b""
    client.close()
    with pytest.raises(ConnectionRefusedError):
        Client(resource)


def test_a_busy_port_is_an_error_at_once():
    with served() as connect:
        port = connect().socket.getpeername()[1]
        with pytest.raises(InstrumentError, match=f"port {port}.*in use"), serve(Options(), "127.0.0.1", port):
            pass


@pytest.mark.parametrize("host", ["192.0.2.1", "no.such.host.invalid"])  # the first is nobody's (RFC 5737)
def test_a_host_that_is_not_this_computers_is_told_from_a_port_that_is_taken(host):
    with pytest.raises(InstrumentError, match=rf"^cannot serve on {host} port 0: .*; the host must be this computer's"):
        serve(Options(), host, 0).__enter__()


@pytest.mark.parametrize("port", [-1, 65536])
def test_a_port_that_is_none_is_an_error_in_one_line(port):
    with pytest.raises(InstrumentError, match=f"port {port}"), serve(Options(), "127.0.0.1", port):
        pass
