"""One acquisition, from config to finished recording; and the simulated meter for others to use."""

import gc
import math
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from aemd.acquire.acquisition import Acquisition
from aemd.acquire.instrument import Instrument, find_driver, find_simulator, host_ns
from aemd.block import READING
from aemd.config import Config
from aemd.display import showing
from aemd.errors import InstrumentError, UsageError
from aemd.estimate.registry import make_estimator
from aemd.estimate.state import copy_state
from aemd.files import open_files, recovering
from aemd.live.feed import About
from aemd.live.health import Health, Sources
from aemd.live.view import View
from aemd.pipeline import Sink, Tally, run
from aemd.record.background import Background
from aemd.record.rollover import Rollover
from aemd.service import Notifier, Pulse, stopping_on_signals, watched

__all__ = ["AcquireSummary", "acquire", "opened", "simulated"]

EXCHANGES = 10  # in a row with no answer, between two signs of life: up to 5 were seen


@dataclass(frozen=True, slots=True)
class AcquireSummary:
    """What an acquisition left behind."""

    file: str
    readings: int
    lost: int
    not_written: int
    """Acquired, and in no file: the disk was full or failed."""
    gaps: int
    outages: int
    rate_hz: float
    duration_s: float
    estimator: str
    raw_variance_V2: float | None
    estimate_variance_V2: float | None


def simulated(config: Config, host: str = "127.0.0.1", port: int = 0) -> AbstractContextManager[str]:
    """Serve the config's simulated instrument; the context's value is its VISA resource.

    Raises:
        InstrumentError: the address cannot be listened on.
    """
    return find_simulator(config.driver).serve(config.simulator, host, port)


@contextmanager
def opened(config: Config) -> Iterator[Instrument]:
    """Open and configure the config's instrument; `sim` starts the simulated one and connects to it by its socket.

    Raises:
        InstrumentError: nobody answers, it is another instrument, or it cannot do what the config asks.
    """
    if config.resource == "sim":
        with simulated(config) as resource, opened(config.with_resource(resource)) as instrument:
            yield instrument
        return
    instrument = find_driver(config.driver).open_instrument(config.resource, config.instrument, host_ns)
    try:
        yield instrument
    finally:
        instrument.close()


def acquire(
    config: Config,
    *,
    seconds: float | None = None,
    directory: Path | None = None,
    console: Console,
    watchers: Sequence[Sink] = (),
    views: Sequence[View] = (),
) -> AcquireSummary:
    """Acquire until so many seconds of readings are there, or until the process is told to stop.

    Args:
        config: what to do.
        seconds: length, s; None for until SIGINT or SIGTERM.
        directory: folder of the recording; None for the config's.
        console: where progress is shown.
        watchers: further sinks, which come right after the estimator.
        views: live views to show it in; they stay the caller's to close.

    Raises:
        InstrumentError: the instrument failed; what came before is in the finished recording, which the message names.
        RecordingError: the recording cannot be written; what was flushed is readable.
    """
    folder = Path(config.recording.directory) if directory is None else directory
    if seconds is not None and not 0 < seconds < math.inf:
        raise UsageError(f"--seconds {seconds:g}: must be a finite number above 0; leave it out to go on until Ctrl-C")
    stop = _Stop()
    notifier = Notifier()
    # Before anything is opened: an interrupt in mid-set-up would leave the meter remote, or get lost in a callback.
    with (
        stopping_on_signals(stop, is_service=notifier.is_service),
        ExitStack() as behind,
        opened(config) as instrument,
    ):
        estimator = make_estimator(config.estimator.name, config.estimator.options, instrument.interval_s, is_live=True)
        estimator.push(np.empty(0, READING))  # what is compiled is compiled now: the first readings should not wait
        if stop.is_asked:
            raise KeyboardInterrupt
        most = None if seconds is None else max(1, round(seconds / instrument.interval_s))
        # What is there stays: without it, a garbage collection in mid-stream would walk all of it, for tens of ms.
        gc.collect()
        gc.freeze()
        tally = Tally()
        rollover = open_files(config, instrument, folder, console)
        recorder = Background(rollover, cutter=rollover, copy_state=lambda: copy_state(estimator))
        sources = Sources(
            tally.counts,
            unwritten=lambda: recorder.in_flight,
            file=lambda: rollover.active,
            not_written=lambda: rollover.not_written,
            not_recording=lambda: rollover.trouble,
        )
        failure: InstrumentError | None = None
        acquisition = Acquisition(instrument, most_readings=most, give_up_s=config.acquisition.give_up_s)
        rollover.clock_facts = acquisition.clock_facts
        # One attempt to have a silent meter back is some exchanges long, each of which waits for its answer.
        patience_s = EXCHANGES * getattr(config.instrument, "timeout_s", 0.0)
        notifier.ready(f"acquiring {folder.absolute()}", patience_s)
        behind.enter_context(
            recovering(folder, console, lambda: stop.is_asked)
        )  # left after this recording has been finished
        try:
            with (
                acquisition,
                watched(
                    notifier,
                    lambda: _pulse(acquisition, recorder),
                    _Status(tally, rollover, folder, instrument.interval_s),
                ),
                stop.passing_on_to(acquisition),
                showing(tally, config.scale, console, time.monotonic_ns) as progress,
                _shown(views, _about(config, instrument), sources, console),
            ):
                inboxes = [view.inbox for view in views]  # behind the recorder, which they thus cannot delay
                run(acquisition.batches(), estimator, [*watchers, tally, recorder, *inboxes, progress])
        except InstrumentError as error:
            failure = error
        except BaseException:
            recorder.close("failed")
            raise
        path = recorder.close(
            "stop" if failure is None else "failed",
            facts={"acquired": str(acquisition.counts.acquired)},
            clock=acquisition.clock_facts(),
        )
    if failure is not None:
        raise InstrumentError(f"{failure}; the {tally.counts.readings} readings before are in {path}") from failure
    return AcquireSummary(
        file=str(path),
        readings=tally.counts.readings,
        lost=tally.counts.lost,
        not_written=rollover.not_written,
        gaps=tally.counts.gaps,
        outages=acquisition.outages,
        rate_hz=tally.rate_hz,
        duration_s=tally.duration_s,
        estimator=config.estimator.name,
        raw_variance_V2=tally.raw.variance,
        estimate_variance_V2=tally.estimate.variance,
    )


def _pulse(acquisition: Acquisition, recorder: Background) -> Pulse:
    counts = acquisition.counts
    return Pulse(acquisition.turns, counts.delivered, counts.in_flight, recorder.turns)


class _Status:
    """What `systemctl status` shows; a folder that is gone is a trouble of the recording's, not of this."""

    def __init__(self, tally: Tally, rollover: Rollover, folder: Path, interval_s: float) -> None:
        self._tally = tally
        self._rollover = rollover
        self._folder = folder
        self._health = Health(interval_s, time.monotonic_ns())

    def __call__(self) -> str:
        """Return it; what is wrong comes first."""
        counts, now_ns = self._tally.counts, time.monotonic_ns()
        self._health.see(counts.readings, 0, now_ns, 0)
        try:
            disk = f"disk {shutil.disk_usage(self._folder).free * 1e-9:.0f} GB"
        except OSError as error:
            disk = f"disk: {(error.strerror or str(error)).lower()}"
        lost = f"lost {counts.lost}  not written {self._rollover.not_written}"
        stopped = f"NOT RECORDING: {self._rollover.trouble}  " if self._rollover.trouble else ""
        silent = self._health.complaint(now_ns).replace("acquisition: no", "NO", 1)
        rate = silent or f"{self._tally.rate_hz:.2f}/s"
        return f"{stopped}{rate}  {counts.readings} readings  {lost}  {disk}"


@contextmanager
def _shown(views: Sequence[View], about: About, sources: Sources, console: Console) -> Iterator[None]:
    """While inside, serve the live views; say where."""
    with ExitStack() as stack:
        for view in views:
            stack.enter_context(view.showing(about, sources))
            console.print(f"live={view.url}", highlight=False, markup=False, soft_wrap=True)
            if view.url_elsewhere:
                console.print(f"live_elsewhere={view.url_elsewhere}", highlight=False, markup=False, soft_wrap=True)
        yield


def _about(config: Config, instrument: Instrument) -> About:
    return About(
        instrument=" ".join(filter(None, (instrument.identity.get("model"), instrument.identity.get("serial")))),
        resource=instrument.identity.get("resource", config.resource),
        estimator=config.estimator.name,
        interval_s=instrument.interval_s,
        factor=config.scale.factor,
        offset=config.scale.offset,
        unit=config.scale.unit,
        # A display of 6 1/2 digits, and one more that the meter sends.
        resolution_V=1e-7 * getattr(config.instrument, "range_V", 0.0),
    )


class _Stop:
    """What a signal calls: remembered until there is an acquisition to pass it on to. Reentrant."""

    def __init__(self) -> None:
        self.is_asked = False
        self._acquisition: Acquisition | None = None

    def __call__(self) -> None:
        self.is_asked = True
        if self._acquisition is not None:
            self._acquisition.stop()

    @contextmanager
    def passing_on_to(self, acquisition: Acquisition) -> Iterator[None]:
        """While inside, stop this acquisition when called, or at once if that was before."""
        self._acquisition = acquisition
        if self.is_asked:
            acquisition.stop()
        yield
        self._acquisition = None
