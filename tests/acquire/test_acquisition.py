"""The I/O thread against the simulated meter, over a real socket and in real time."""

import gc
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest

import agilent34410
from aemd.acquire.acquisition import Acquisition
from aemd.acquire.instrument import Drain, Instrument, host_ns
from aemd.block import READING, Batch, Status
from aemd.errors import InstrumentError
from sim34410 import Meter
from tests.drivers.agilent34410.bench import FAST, Ramp, served

QUICK = agilent34410.Options(nplc=0.2, autozero="off", interval_s=0.01)


@contextmanager
def opened(options: agilent34410.Options = FAST, source: Ramp | None = None) -> Iterator[tuple[Instrument, Meter]]:
    with (
        served(source=source, clock_error_ppm=80.0) as (resource, meter),
        closing(agilent34410.open_instrument(resource, options, host_ns)) as instrument,
    ):
        yield instrument, meter


def joined(batches: list[Batch]) -> Any:
    return np.concatenate([np.empty(0, READING), *(batch.readings for batch in batches)])


def test_a_stream_ends_after_exactly_so_many_readings_and_they_are_the_meters() -> None:
    with opened() as (instrument, meter), Acquisition(instrument, most_readings=12_345) as acquisition:
        readings = joined(list(acquisition.batches()))
        truth = meter.truth[: readings.size]

    assert readings["index"].tolist() == list(range(12_345))
    assert np.array_equal(readings["value_V"], truth["value_V"])
    assert acquisition.counts.lost == 0


class Timed:
    """An instrument that notes how long its slowest answer took: a machine that is busy elsewhere makes it wait."""

    def __init__(self, instrument: Instrument) -> None:
        self._instrument = instrument
        self.slowest_ns = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._instrument, name)

    def drain(self, most: int) -> Drain:
        found = self._instrument.drain(most)
        self.slowest_ns = max(self.slowest_ns, found.answered_ns - found.asked_ns)
        return found


def test_stamps_are_within_two_milliseconds_of_the_truth_after_the_first_second() -> None:
    offset_ns = 1_700_000_000_000_000_000
    with opened(QUICK) as (instrument, meter):
        timed = Timed(instrument)
        with Acquisition(timed, most_readings=150, utc=lambda: host_ns() + offset_ns) as acquisition:
            readings = joined(list(acquisition.batches()))
        truth = meter.truth[: readings.size]
    errors_ns = readings["t_ns"] - offset_ns - (truth["begin_ns"] + truth["aperture_ns"] // 2)

    half_an_interval_ns = 5_000_000  # before anything but the start is known
    assert np.abs(errors_ns).max() < max(half_an_interval_ns, timed.slowest_ns)
    assert np.abs(errors_ns[100:]).max() < max(2_000_000, timed.slowest_ns)
    assert np.all(np.diff(readings["t_ns"]) > 0)


def test_acquired_is_always_delivered_plus_in_flight_and_all_of_it_is_delivered_in_the_end() -> None:
    with opened() as (instrument, _), Acquisition(instrument, most_readings=8000) as acquisition:
        seen = 0
        for batch in acquisition.batches():
            seen += batch.readings.size
            counts = acquisition.counts
            assert counts.acquired == counts.delivered + counts.in_flight
            assert counts.delivered == seen
        counts = acquisition.counts

    assert (counts.acquired, counts.delivered, counts.in_flight, counts.lost) == (8000, 8000, 0, 0)


def test_stop_delivers_what_the_instrument_still_holds_and_ends_the_stream() -> None:
    with opened() as (instrument, meter), Acquisition(instrument, poll_s=0.2) as acquisition:
        batches = acquisition.batches()
        first = next(batches)
        acquisition.stop()
        acquisition.stop()
        readings = joined([first, *batches])

        assert readings.size == meter.truth.size
        assert readings["index"].tolist() == list(range(readings.size))
        assert meter.state == "idle"


def test_stop_may_be_called_by_a_signal_handler() -> None:
    with opened() as (instrument, _), Acquisition(instrument) as acquisition:
        before = signal.signal(signal.SIGALRM, lambda *_: acquisition.stop())
        batches = acquisition.batches()
        try:
            first = next(batches)
            signal.setitimer(signal.ITIMER_REAL, 0.2)
            readings = joined([first, *batches])
        finally:
            signal.signal(signal.SIGALRM, before)

    assert readings.size > first.readings.size


def test_a_slow_consumer_loses_nothing_because_the_rest_waits_in_the_meter() -> None:
    with opened() as (instrument, _), Acquisition(instrument, most_readings=10_000, ring_readings=1024) as acquisition:
        readings = []
        for batch in acquisition.batches():
            readings.append(batch)
            time.sleep(0.03)  # slower than 300 readings, about what comes meanwhile

    assert joined(readings)["index"].tolist() == list(range(10_000))


def test_leaving_early_ends_the_thread_and_stops_the_meter() -> None:
    with opened() as (instrument, meter):
        with Acquisition(instrument, ring_readings=1024) as acquisition:
            next(acquisition.batches())
            time.sleep(0.3)  # the ring is full now

        assert meter.state == "idle"
        assert "aemd-acquire" not in {thread.name for thread in threading.enumerate()}


def test_a_dead_link_ends_the_stream_with_its_error_after_all_that_was_acquired() -> None:
    options = agilent34410.Options(nplc=0.2, autozero="off", interval_s=0.01, timeout_s=0.3)
    with served() as (resource, _):
        instrument = agilent34410.open_instrument(resource, options, host_ns)
        acquisition = Acquisition(instrument, give_up_s=0.5)
        acquisition.__enter__()
        while acquisition.counts.acquired <= 10:  # some are in flight when the meter goes
            time.sleep(0.01)
    batches: list[Batch] = []
    with pytest.raises(InstrumentError, match=r"^TCPIP0::127\.0\.0\.1::\d+::SOCKET: .*check that the instrument is on"):
        batches.extend(acquisition.batches())
    acquisition.__exit__(None, None, None)
    instrument.close()

    assert joined(batches).size == acquisition.counts.acquired > 10
    assert acquisition.counts.in_flight == 0


def test_readings_lost_in_the_meter_are_a_gap_in_the_stream() -> None:
    with opened() as (instrument, meter):
        timed = Timed(instrument)
        with Acquisition(timed, ring_readings=1024, poll_s=0.05) as acquisition:
            batches = acquisition.batches()
            readings = [next(batches) for _ in range(20)]  # until the clock is known
            time.sleep(5.5)  # longer than the ring and the meter's memory hold
            readings += [next(batches) for _ in range(20)]
            acquisition.stop()
            readings += list(batches)
        made = meter.truth.size
    block, counts = joined(readings), acquisition.counts
    gaps = [event for batch in readings for event in batch.events if event.kind == "gap"]
    within = [int(re.findall(r"give or take (\d+)", gap.message)[0]) for gap in gaps]

    assert len(gaps) >= 1  # one, where we are not too slow for such a ring afterwards, too
    assert counts.lost == sum(gap.last_index - gap.first_index + 1 for gap in gaps) > 0
    assert block["index"][-1] + 1 == counts.acquired + counts.lost
    assert np.count_nonzero(block["status"] & Status.GAP) == len(gaps)
    assert max(within) < 100 + timed.slowest_ns / (FAST.interval_s * 1e9)
    assert counts.acquired + counts.lost == pytest.approx(made, abs=sum(within))


def test_the_thread_and_the_link_leave_nothing_open(recwarn: pytest.WarningsRecorder) -> None:
    with opened() as (instrument, _), Acquisition(instrument, most_readings=100) as acquisition:
        list(acquisition.batches())
    gc.collect()

    assert [str(warning.message) for warning in recwarn] == []


def test_the_hosts_clock_goes_on_while_the_host_is_suspended() -> None:
    """In a time namespace in which it was so for an hour: only the time since boot has it, as /proc/uptime tells it."""
    unshare = shutil.which("unshare")
    if unshare is None:
        pytest.skip("no unshare (util-linux)")
    program = """
import time
from pathlib import Path
from aemd.acquire.instrument import host_ns
print(float(Path("/proc/uptime").read_text().split()[0]), host_ns() * 1e-9, time.monotonic())
"""
    command = [unshare, "--time", "--fork", "--boottime", "3600", sys.executable, "-c", program]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if run.returncode:
        pytest.skip(f"no time namespace: {run.stderr.strip()}")
    uptime_s, host_s, monotonic_s = map(float, run.stdout.split())

    assert host_s == pytest.approx(uptime_s, abs=1.0)
    assert host_s > monotonic_s + 3000.0
