"""The simulated meter on all its links, opened through pyvisa-py as anyone's script would."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pyvisa
from pyvisa.resources import MessageBasedResource

from aemd.model import Truth
from sim34410 import Bench, Options, make_bench, serve_bench
from sim34410.meter import Meter, MeterProperties
from sim34410.usb import UsbDevice
from sim34410.usb_backend import plugged_in
from tests.drivers.agilent34410.bench import HandClock

FULL = 50_000


class Counter:
    """An input that no two readings share: the instant, s, scaled to stay within +-12 V for a day."""

    def average(self, start_s, aperture_s):
        nothing = np.zeros_like(start_s)
        return Truth(
            signal_V=1e-4 * (start_s + aperture_s / 2), internal_V=nothing, external_V=nothing, noise_V=nothing
        )


class RunningClock(HandClock):
    """A clock that runs and can be put forward, for what waits by a clock of its own."""

    def __call__(self) -> int:
        return self.now_ns + time.monotonic_ns()


def counting_bench(clock, faults=(), **properties) -> Bench:
    properties = {"noise": False, "truth_readings": 1_000_000, **properties}
    return Bench(Meter(Counter(), clock, MeterProperties(**properties)), clock, faults)


@contextmanager
def served(bench: Bench | None = None) -> Iterator[dict[str, str]]:
    bench = bench or make_bench(Options())
    device = UsbDevice(bench)
    with (
        serve_bench(bench, "127.0.0.1", port=0, vxi11_port=0, serial=True) as resources,
        plugged_in(device),
    ):
        yield {**resources, "usb": device.resource}


@contextmanager
def visa() -> Iterator["Visa"]:
    manager = pyvisa.ResourceManager("@py")
    visa = Visa(manager)
    try:
        yield visa
    finally:
        for session in visa.sessions:
            session.close()
        manager.close()


class Visa:
    def __init__(self, manager: pyvisa.ResourceManager) -> None:
        self.manager = manager
        self.sessions: list[MessageBasedResource] = []

    def open(self, resource: str, timeout_s: float = 60.0) -> MessageBasedResource:
        session = self.manager.open_resource(
            resource, open_timeout=60_000, write_termination="\n", read_termination="\n", timeout=timeout_s * 1000
        )
        session.chunk_size = 1 << 20
        self.sessions.append(session)
        return session


def wait_long(session: MessageBasedResource) -> None:
    """Have a session that was to meet silence wait for the answers that do come, however slow the machine."""
    session.timeout = 60_000


def read_block(session: MessageBasedResource, question: str) -> np.ndarray:
    """Ask for a block and return its readings, V, whatever the link."""
    session.write(question)
    session.read_termination = None
    mark = session.read_bytes(2)
    size = int(session.read_bytes(int(mark[1:])))
    block = session.read_bytes(size + 1, chunk_size=size + 1)
    session.read_termination = "\n"
    assert block[-1:] == b"\n"
    return np.frombuffer(block[:-1], ">f8")
