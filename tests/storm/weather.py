"""One accelerated acquisition from the simulated meter under faults, through pipeline and recorder, and its truth.

The driver, the books, the estimator and the recorder are those of `aemd acquire`; only the thread, the socket and the
clock are not: waiting moves the clock.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aemd.acquire.stream import Stream
from aemd.block import READING, Batch, Block, Estimates, Event
from aemd.config import name_estimator
from aemd.estimate.registry import make_estimator
from aemd.model import Truth
from aemd.pipeline import Sink, Tally, run
from aemd.record.description import Description
from aemd.record.writer import Recorder
from agilent34410 import Options
from agilent34410.link import Link
from agilent34410.meter import open_instrument
from sim34410 import Meter, MeterProperties
from sim34410.bench import Bench
from sim34410.bench import Link as Interface
from sim34410.clock import SteppedClock
from sim34410.faults import Fault
from sim34410.simulated_link import SimulatedLink

UTC_OFFSET_NS = 1_700_000_000_000_000_000
ROOM = 1 << 17
GOLDEN = 0.618033988749895
LOOKS_EVERY = 44 + GOLDEN
"""Intervals between two looks, 3 s: a day at 15 Hz has 1.3 million readings, and a look costs as much as 500 of them.

No fault is missed by it: those of replies strike the next one, and an outage is one however soon it is seen."""


class Slope:
    """An input that rises by 86 nV/ms, so that no two readings of a day are alike and none is out of range."""

    V_PER_S = 86e-6

    def average(self, start_s: NDArray[np.float64], aperture_s: float) -> Truth:
        value_V = self.V_PER_S * (start_s + aperture_s / 2)
        nothing = np.zeros_like(value_V)
        return Truth(signal_V=value_V, internal_V=nothing, external_V=nothing, noise_V=nothing)


@dataclass(slots=True)
class Passed:
    """What came out, and what is true."""

    readings: Block
    events: list[Event]
    truth: NDArray[np.void]
    stream: Stream
    tally: Tally
    recording: Path | None
    cpu_s: float
    began_ns: int
    ended_ns: int
    gaps: list[Event] = field(init=False)

    def __post_init__(self) -> None:
        self.gaps = [event for event in self.events if event.kind == "gap"]


class _Keep:
    def __init__(self) -> None:
        self.blocks: list[Block] = [np.empty(0, READING)]
        self.events: list[Event] = []

    def write(self, batch: Batch, estimates: Estimates) -> None:
        self.blocks.append(batch.readings)
        self.events += batch.events


def pass_through(
    faults: Sequence[Fault],
    seconds: float,
    *,
    options: Options | None = None,
    link: Interface = "socket",
    recording: Path | None = None,
    poll_s: float | None = None,
    seed: int = 1,
    utc_steps: Sequence[tuple[float, float]] = (),
    give_up_s: float | None = None,
    keep: bool = True,
    watchers: Sequence[Sink] = (),
    **properties: float,
) -> Passed:
    """Acquire for so many simulated seconds, then stop.

    Args:
        faults: what goes wrong, timed from the meter's power on.
        seconds: length.
        options: of the driver; None for its defaults, 14.9 Hz.
        link: the interface used.
        recording: where to record, or not.
        poll_s: time between two looks; None for `LOOKS_EVERY` intervals; 0 for as `aemd acquire` does it.
        seed: of the link's latencies.
        utc_steps: (at_s, by_s): when the host's wall clock is set, and by how much.
        give_up_s: as in the config.
        keep: keep readings and truth, which a soak does not.
        watchers: further sinks.
        properties: of the meter, such as clock_error_ppm.
    """
    options = options or Options()
    clock = SteppedClock()
    readings_expected = int(seconds / options.interval_s) + 100_000
    made = MeterProperties(noise=False, truth_readings=readings_expected if keep else 0, **properties)
    meter = Meter(Slope(), clock, made)
    bench = Bench(meter, clock, faults)
    began_ns = clock()
    end_ns = began_ns + round(seconds * 1e9)
    opened = 0

    def open_line() -> Link:
        nonlocal opened
        opened += 1
        return SimulatedLink(bench, clock, options.timeout_s, link, seed=seed * 100_003 + opened)

    def wait(seconds: float) -> bool:
        clock.sleep(seconds)
        return clock() >= end_ns

    def utc() -> int:
        since_s = (clock() - began_ns) * 1e-9
        return clock() + UTC_OFFSET_NS + round(sum(by_s for at_s, by_s in utc_steps if since_s >= at_s) * 1e9)

    instrument = open_instrument("SIM", options, clock, open_line)
    poll_s = LOOKS_EVERY * instrument.interval_s if poll_s is None else poll_s
    stream = Stream(
        instrument, wait=wait, room=lambda: ROOM, poll_s=poll_s or None, give_up_s=give_up_s, clock=clock, utc=utc
    )

    def batches() -> Iterator[Batch]:
        for delivery in stream.deliveries():
            yield Batch(delivery.block, delivery.events, received_ns=delivery.received_ns)

    kept, tally = _Keep(), Tally()
    sinks: list[Sink] = [tally, *watchers, *([kept] if keep else [])]
    recorder = None
    if recording is not None:
        recorder = Recorder(recording, Description(interval_s=instrument.interval_s), durability="crash")
        sinks.append(recorder)
    estimator = make_estimator("kalman", name_estimator("kalman").options, instrument.interval_s)
    cpu_s = time.process_time()
    path = None
    try:
        run(batches(), estimator, sinks)
    finally:
        instrument.close()
        path = recorder.close("stop") if recorder is not None else None
    cpu_s = time.process_time() - cpu_s
    truth = bench.truth if keep else np.empty(0)
    return Passed(np.concatenate(kept.blocks), kept.events, truth, stream, tally, path, cpu_s, began_ns, clock())
