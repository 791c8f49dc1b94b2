"""A simulated Agilent 34410A that answers SCPI on a real socket.

    clients ──> server ──> Session.handle(bytes) ──> commands ──> Meter ──> Input (a model, or a recording)
                sockets    lines, SCPI               one table    clock, trigger, memory, noise

Only the server knows sockets and threads; everything before it takes the time from a clock that is an argument.
"""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Ge, Interval

from aemd.acquire.instrument import Clock
from aemd.model import GaussMarkov, Model, Shocks, Term, WhiteNoise
from sim34410.bench import Bench
from sim34410.clock import SteppedClock
from sim34410.converter import Input
from sim34410.faults import Fault, draw_faults
from sim34410.meter import Meter, MeterProperties
from sim34410.playback import read_playback
from sim34410.server import serve_bench, serve_meter
from sim34410.simulated_link import SimulatedLink

__all__ = ["Bench", "Fault", "Input", "Meter", "MeterProperties", "Options", "SimulatedLink", "SteppedClock"]
__all__ += ["draw_faults", "make_bench", "make_meter", "serve", "serve_bench", "serve_links", "serve_meter"]

SENSOR: tuple[Term, ...] = (
    GaussMarkov.from_sd(sd_V=2e-3, tau_s=5.0, role="signal"),
    GaussMarkov(role="internal", rate_V_per_rt_s=2e-5),
    Shocks(rate_per_s=0.05, sd_V=20e-3, decay_s=0.1),
    WhiteNoise.from_sd(sd_V=16.7e-6, aperture_s=0.02),
)
"""A sensor in the style of the paper's accelerometer: some mV of signal, a bias that walks 1 mV in 40 min, a shock of
tens of mV every 20 s, and the white noise of the paper's section 3, 0.11 mV from peak to peak in readings of 20 ms."""


@dataclass(frozen=True, slots=True)
class Options:
    """The simulated meter, its bench and what is connected to it."""

    identity: str = "Agilent Technologies,34410A,MY47006594,2.35-2.35-0.09-46-09"
    """Answer to *IDN?."""
    line_frequency_hz: Annotated[float, Interval(ge=45, le=65)] = 50.0
    """What the meter found at power on, Hz."""
    seed: Annotated[int, Ge(0)] = 1
    """Of the input's history and of the meter's noise."""
    terms: tuple[Term, ...] = SENSOR
    """The model of the input, unless a recording is given."""
    recording: Path | None = None
    """One of our recordings, or a CSV (`time,value`: seconds, volts), to be played as the input again and again."""
    clock_error_ppm: Annotated[float, Interval(ge=-1000, le=1000)] = 0.0
    """How much the meter's clock runs fast."""
    clock_drift_ppm_per_day: Annotated[float, Interval(ge=-10, le=10)] = 0.0
    """How much faster it runs day by day."""
    clock_wander_ppm: Annotated[float, Interval(ge=0, le=100)] = 0.0
    """Amplitude by which its rate swings with the time of the day."""
    memory_readings: Annotated[int, Interval(ge=2, le=10_000_000)] | None = None
    """Size of its memory, to have it overflow soon; absent for the model's own."""
    vxi11_clears: bool = True
    """Whether the end of the last VXI-11 link stops its sampling and clears its memory, as measured on a 34461A."""
    faults: tuple[Fault, ...] = ()
    """What goes wrong, and when."""
    noise: bool = True
    """Whether the meter adds its own noise and offset drift."""


def make_meter(options: Options, clock: Clock = time.monotonic_ns, *, truth_readings: int = 0) -> Meter:
    """Return a meter that has just been switched on.

    Args:
        options: the meter and what is connected to it.
        clock: host monotonic time, ns.
        truth_readings: how many of the last readings' truth it keeps for `Meter.truth`.

    Raises:
        RecordingError: the recording cannot be read.
    """
    source: Input
    if options.recording is None:
        model = Model(options.terms, options.seed)
        # Compiles the terms' kernels in a history of their own: a meter that stalls at its first reading for as long as
        # a compiler takes leaves its client in doubt of when that reading was.
        model.realise().average(np.zeros(1), 1e-3)
        source = model.realise()
    else:
        source = read_playback(options.recording)
    properties = MeterProperties(
        identity=options.identity,
        line_frequency_hz=options.line_frequency_hz,
        seed=options.seed,
        clock_error_ppm=options.clock_error_ppm,
        clock_drift_ppm_per_day=options.clock_drift_ppm_per_day,
        clock_wander_ppm=options.clock_wander_ppm,
        memory_readings=options.memory_readings,
        noise=options.noise,
        truth_readings=truth_readings,
    )
    return Meter(source, clock, properties)


def make_bench(options: Options, clock: Clock = time.monotonic_ns, *, truth_readings: int = 0) -> Bench:
    """Return a meter that has just been switched on, on its bench, with the faults of the options; see `make_meter`."""
    meter = make_meter(options, clock, truth_readings=truth_readings)
    return Bench(meter, clock, options.faults, vxi11_clears=options.vxi11_clears)


@contextmanager
def serve(options: Options, host: str, port: int) -> Iterator[str]:
    """Serve the simulated meter from a thread; port 0 takes a free one.

    Returns:
        A context whose value is the VISA resource of the meter; leaving it stops the server.

    Raises:
        InstrumentError: the port is taken.
        RecordingError: the recording to be played cannot be read.
    """
    with serve_bench(make_bench(options), host, port=port) as resources:
        yield resources["socket"]


@contextmanager
def serve_links(
    options: Options, host: str, *, port: int | None, vxi11_port: int | None, serial: bool
) -> Iterator[Mapping[str, str]]:
    """Serve the simulated meter on several links at once; see `serve_bench`, and `serve` for what is raised."""
    with serve_bench(make_bench(options), host, port=port, vxi11_port=vxi11_port, serial=serial) as resources:
        yield resources
