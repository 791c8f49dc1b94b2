"""Each link: readings/s drained from a full memory and kept up for a minute, beside the bare link and the best peers.

One simulated meter on all its links in this process, so client and meter share the interpreter: the figures are ratios,
of the same blocks by the same server. Bare: the same command, its bytes read and thrown away, by a plain socket or by
pyvisa. PyMeasure has no way to read more than one value; InstrumentKit reads blocks (`r`), over the socket.
`python -m tests.benchmarks.links [SECONDS]`.

The CPU that a reading takes in the driver's thread and in the meter's tells which of them the loopback waits for; of
USB, whose device has no thread, they are one figure.

A loopback is a hundred times faster than a meter's link, so a share of it says what the driver's own work costs, and
not what a user sees. That is the other share: of the rate at which a 34410A sends REAL,64 by this link, as its maker
measured (application note on throughput: socket 160,000/s, VXI-11 60,000/s, USB 154,000/s), on a line without a socket
whose time is counted, with 0.4 ms from question to answer each way.
"""

import socket
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass

import numpy as np
import pyvisa

import agilent34410
from aemd.acquire.acquisition import Acquisition
from aemd.acquire.instrument import host_ns
from agilent34410.meter import open_instrument
from sim34410.bench import Link
from sim34410.clock import SteppedClock
from sim34410.simulated_link import SimulatedLink
from tests.drivers.sim34410.links import RunningClock, counting_bench, served

FAST = agilent34410.Options(interval_s=1e-4, aperture_s=1e-4, autozero="off", trigger_delay_s=0.0, display=False)
BLOCK = 8192
FILLS = 10
TIMES = 3
"""Of which the best: what else the machine does only ever slows it."""
PEER_S = 5.0


def main(seconds: float = 60.0) -> None:
    sys.setswitchinterval(
        5e-5
    )  # client and meter hand over to each other at every question; by default that takes 5 ms
    print(
        f"{'link':8} {'bare/s':>10} {'aemd/s':>10} {'of bare':>8} {'CPU, meter + driver':>22} {'of a core at the':>17}"
        f" {'of the real':>12} {'sustained at 10 kS/s':>28}"
    )
    print(f"{'':8} {'':>10} {'':>10} {'':>8} {'ns/reading':>22} {'real link':>17} {'link':>12}")
    drained: dict[str, float] = {}
    links: tuple[Link, ...] = ("socket", "vxi11", "usb")
    for link in links:
        bare = max(rate_bare(link) for _ in range(TIMES))
        fastest = max((drain(link) for _ in range(TIMES)), key=lambda one: one.per_s)
        drained[link] = fastest.per_s
        kept = sustain(link, seconds)
        cpu = f"{fastest.meter_ns:.0f} + {fastest.driver_ns:.0f}" if link != "usb" else f"{fastest.driver_ns:.0f}"
        shares = f"{100 * drained[link] / bare:7.0f}% {cpu:>22} {fastest.driver_ns * 1e-7 * REAL[link]:16.1f}%"
        shares += f" {share_of_real(link):11.1f}%"
        print(f"{link:8} {bare:10.0f} {drained[link]:10.0f} {shares} {kept:>28}", flush=True)
    peers = {"InstrumentKit, r(n) over the socket": rate_instrumentkit, "PyMeasure, voltage_dc": rate_pymeasure}
    for name, measure in peers.items():
        rate = measure()
        print(f"{name}: {rate:.0f} readings/s; aemd over the socket {drained['socket'] / rate:.0f} times that")


REAL = {"socket": 160_000, "vxi11": 60_000, "usb": 154_000}


def share_of_real(link: Link) -> float:
    """Percent of the real link's readings/s at which the driver drains a full memory over it, latency included."""
    clock = SteppedClock()
    bench = counting_bench(clock, truth_readings=0)

    def open_line() -> SimulatedLink:
        return SimulatedLink(bench, clock, link=link, bytes_per_s=8 * REAL[link])

    meter = open_instrument("SIM", FAST, clock, open_line)
    meter.start()
    clock.sleep(4.9)
    taken, begun_ns = 0, clock()
    while (drain := meter.drain(BLOCK)).waiting > BLOCK:
        taken += drain.values_V.size
    taken += drain.values_V.size
    return 100 * taken / ((clock() - begun_ns) * 1e-9) / REAL[link]


@dataclass(frozen=True, slots=True)
class Drained:
    """What a link brought."""

    per_s: float
    """Readings/s."""
    driver_ns: float
    """CPU of the driver's thread for a reading, ns."""
    meter_ns: float
    """CPU of the meter's, ns."""


def drain(link: str) -> Drained:
    """Have the driver take a memory that holds 49,000 readings, decoded, some times."""
    clock = RunningClock()
    with (
        served(counting_bench(clock, truth_readings=0)) as resources,
        closing(agilent34410.open_instrument(resources[link], FAST, clock)) as meter,
    ):
        meter.start()
        taken, took_s, own_s, all_s = 0, 0.0, 0.0, 0.0
        for _ in range(FILLS):
            clock.move(4.9)
            meter.drain(1)  # has the meter make them
            begun_s, begun_own_s, begun_all_s = time.perf_counter(), time.thread_time(), time.process_time()
            while (drain := meter.drain(BLOCK)).waiting > BLOCK:
                taken += drain.values_V.size
            taken += drain.values_V.size
            took_s += time.perf_counter() - begun_s
            own_s += time.thread_time() - begun_own_s
            all_s += time.process_time() - begun_all_s
    return Drained(taken / took_s, own_s / taken * 1e9, (all_s - own_s) / taken * 1e9)


def rate_bare(link: str) -> float:
    """Readings/s of the same `R?` over the bare link."""
    clock = RunningClock()
    with served(counting_bench(clock, truth_readings=0)) as resources:
        with closing(agilent34410.open_instrument(resources[link], FAST, clock)) as meter:
            meter.start()
            meter._closed = True  # leave it sampling
            meter._dialogue.close()
        talk, close = _bare(resources[link])
        taken, took_s = 0, 0.0
        for _ in range(FILLS):
            clock.move(4.9)
            talk("R? 1", 8 + 4)
            begun_s = time.perf_counter()
            for _ in range(5):
                talk(f"R? {BLOCK}", 8 * BLOCK + 8)
                taken += BLOCK
            took_s += time.perf_counter() - begun_s
            while talk("DATA:POIN?", 0) > BLOCK:
                talk(f"R? {BLOCK}", 8 * BLOCK + 8)
        close()
    return taken / took_s


def _bare(resource: str) -> tuple[Callable[[str, int], int], Callable[[], None]]:
    if resource.endswith("SOCKET"):
        _, host, port, _ = resource.split("::")
        line = socket.create_connection((host, int(port)))
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

        def talk(command: str, size: int) -> int:
            line.sendall(command.encode() + b"\n")
            left, said = size, b""
            while left > 0 or (not size and not said.endswith(b"\n")):
                piece = line.recv(1 << 20)
                left -= len(piece)
                said = piece if size else said + piece
            return 0 if size else int(float(said))

        return talk, line.close
    manager = pyvisa.ResourceManager("@py")
    session = manager.open_resource(resource, open_timeout=2000, write_termination="\n", timeout=5000)

    def converse(command: str, size: int) -> int:
        session.write(command)  # type: ignore[attr-defined]
        with session.ignore_warning(pyvisa.constants.StatusCode.success_max_count_read):
            said = session.visalib.read(session.session, max(size, 64))[0]
        return 0 if size else int(float(said))

    def close() -> None:
        session.close()
        manager.close()

    return converse, close


def sustain(link: str, seconds: float) -> str:
    """Acquire at 10,000 readings/s for so long; tell how many were lost."""
    with (
        served(counting_bench(time.monotonic_ns, truth_readings=0)) as resources,
        closing(agilent34410.open_instrument(resources[link], FAST, host_ns)) as meter,
        Acquisition(meter, most_readings=round(seconds * 10_000), give_up_s=10.0) as acquisition,
    ):
        begun_s = time.perf_counter()
        taken = sum(batch.readings.size for batch in acquisition.batches())
        took_s = time.perf_counter() - begun_s
    return f"{taken / took_s:.0f}/s for {took_s:.0f} s, {acquisition.counts.lost} lost"


def rate_instrumentkit() -> float:
    """Its best loop: how many there are, then a block of them; it leaves a newline behind, which is read away."""
    import instruments  # noqa: PLC0415 - an independent client, which takes its time

    clock = RunningClock()
    with served(counting_bench(clock, truth_readings=0)) as resources:
        with closing(agilent34410.open_instrument(resources["socket"], FAST, clock)) as meter:
            meter.start()
            meter._closed = True
            meter._dialogue.close()
        _, host, port, _ = resources["socket"].split("::")
        kit = instruments.agilent.Agilent34410a.open_tcpip(host, int(port))
        taken, begun_s = 0, time.perf_counter()
        clock.move(4.9)
        while time.perf_counter() - begun_s < PEER_S and (count := min(kit.data_point_count, BLOCK)):
            taken += np.size(kit.r(count).magnitude)
            kit._file.read_raw(1)
        took_s = time.perf_counter() - begun_s
        kit._file.close()
    return taken / took_s


def rate_pymeasure() -> float:
    """One reading at a time, each with a new configuration of the meter: all that it does."""
    from pymeasure.adapters import VISAAdapter  # noqa: PLC0415
    from pymeasure.instruments.agilent import Agilent34410A  # noqa: PLC0415

    with served(counting_bench(time.monotonic_ns, truth_readings=0)) as resources:
        adapter = VISAAdapter(resources["socket"], visa_library="@py", read_termination="\n", write_termination="\n")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            meter = Agilent34410A(adapter)
        taken, begun_s = 0, time.perf_counter()
        while time.perf_counter() - begun_s < PEER_S:
            taken += isinstance(meter.voltage_dc, float)
        took_s = time.perf_counter() - begun_s
        with suppress(Exception):
            adapter.close()
            adapter.manager.close()
    return taken / took_s


if __name__ == "__main__":
    main(*map(float, sys.argv[1:2]))
