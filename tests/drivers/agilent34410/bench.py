"""A bench for tests: the simulated meter on a socket with a clock that is moved by hand, and strangers on a socket."""

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from threading import Event, Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aemd.model import Truth
from agilent34410 import Options
from sim34410 import Meter, MeterProperties, serve_meter

FAST = Options(interval_s=1e-4, aperture_s=1e-4, autozero="off", trigger_delay_s=0.0, display=False)
"""10,000 readings/s."""


class HandClock:
    """A clock that moves only when told to, ns."""

    def __init__(self) -> None:
        self.now_ns = 1_000_000_000_000

    def __call__(self) -> int:
        return self.now_ns

    def move(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


class Ramp:
    """An input that rises by 1 mV/s, so that no two readings are alike, and leaves +-12 V from `high_s`, `low_s` on."""

    def __init__(self, high_s: tuple[float, float] = (0.0, 0.0), low_s: tuple[float, float] = (0.0, 0.0)) -> None:
        self._excursions = ((high_s, 20.0), (low_s, -20.0))

    def average(self, start_s: NDArray[np.float64], aperture_s: float) -> Truth:
        value_V = 1e-3 * (start_s + aperture_s / 2)
        for (begin_s, end_s), excursion_V in self._excursions:
            value_V = value_V + excursion_V * ((start_s >= begin_s) & (start_s < end_s))
        nothing = np.zeros_like(value_V)
        return Truth(signal_V=value_V, internal_V=nothing, external_V=nothing, noise_V=nothing)


@contextmanager
def served(
    clock: Callable[[], int] = time.monotonic_ns, source: Ramp | None = None, **properties: Any
) -> Iterator[tuple[str, Meter]]:
    """Serve a noiseless meter; the context's value is its resource and the meter itself."""
    made = MeterProperties(**{"noise": False, "truth_readings": 1_000_000, **properties})
    meter = Meter(source or Ramp(), clock, made)
    with serve_meter(meter, "127.0.0.1", 0, time.monotonic_ns) as resource:
        yield resource, meter


@contextmanager
def stranger(answer: Callable[[bytes], bytes | None]) -> Iterator[str]:
    """Serve one client after another by a function of the line received; None hangs up. The value is the resource."""
    stopped = Event()

    def serve(listener: socket.socket) -> None:
        while not stopped.is_set():
            try:
                connection, _ = listener.accept()
            except TimeoutError:
                continue
            # A client may hang up on an answer that it has not read.
            with suppress(ConnectionError), connection, connection.makefile("rb") as lines:
                for line in lines:
                    reply = answer(line.strip())
                    if reply is None:
                        break
                    connection.sendall(reply)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(0.05)
        thread = Thread(target=serve, args=(listener,))
        thread.start()
        try:
            yield f"TCPIP0::127.0.0.1::{listener.getsockname()[1]}::SOCKET"
        finally:
            stopped.set()
            thread.join()


def unused_resource() -> str:
    """Return the resource of a port at which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return f"TCPIP0::127.0.0.1::{listener.getsockname()[1]}::SOCKET"
