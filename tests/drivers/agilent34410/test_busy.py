"""A meter that another program reads is left alone; one that was left behind is not; one that is idle costs no time."""

from collections.abc import Callable

import pytest

from aemd.acquire.instrument import BusyError
from agilent34410.busy import refuse_busy
from sim34410 import Meter, MeterProperties
from sim34410.bench import Bench
from sim34410.clock import SteppedClock
from sim34410.simulated_link import SimulatedLink
from tests.storm.weather import Slope


class Others:
    """A sleep during which another program does something each time."""

    def __init__(self, clock: SteppedClock, act: Callable[[], object]) -> None:
        self.slept_s = 0.0
        self._clock = clock
        self._act = act

    def __call__(self, seconds: float) -> None:
        self.slept_s += seconds
        self._clock.sleep(seconds)
        self._act()


@pytest.fixture
def clock() -> SteppedClock:
    return SteppedClock()


@pytest.fixture
def line(clock: SteppedClock) -> SimulatedLink:
    return SimulatedLink(Bench(Meter(Slope(), clock, MeterProperties(noise=False)), clock), clock)


def begin(line: SimulatedLink, interval_s: float) -> None:
    line.query(
        f"FORM:DATA REAL,64;:TRIG:COUN INF;:SAMP:SOUR TIM;:SAMP:TIM {interval_s};:SAMP:COUN MAX;:VOLT:NPLC 0.02;"
        ":VOLT:ZERO:AUTO OFF;:INIT;:SYST:ERR?"
    )


def test_an_idle_meter_is_not_waited_for(line: SimulatedLink, clock: SteppedClock) -> None:
    others = Others(clock, lambda: None)
    refuse_busy(line, others)

    assert others.slept_s == 0.0


@pytest.mark.parametrize(("interval_s", "watched_s"), [(0.01, 0.5), (1.0, 2.5), (100.0, 5.0)])
def test_a_meter_that_nobody_reads_is_watched_for_some_intervals_and_free(
    interval_s: float, watched_s: float, line: SimulatedLink, clock: SteppedClock
) -> None:
    begin(line, interval_s)
    others = Others(clock, lambda: None)
    refuse_busy(line, others)

    assert others.slept_s == pytest.approx(watched_s, rel=1e-3)


def test_a_count_that_falls_is_another_program(line: SimulatedLink, clock: SteppedClock) -> None:
    begin(line, 0.01)
    clock.sleep(1.0)

    with pytest.raises(BusyError, match="another program is taking readings"):
        refuse_busy(line, Others(clock, lambda: line.query_block("R? 50", 400)))


def test_a_journal_that_goes_on_is_another_of_ours_though_the_count_grows(
    line: SimulatedLink, clock: SteppedClock
) -> None:
    begin(line, 0.01)
    clock.sleep(1.0)
    entries = iter(range(1, 100))

    with pytest.raises(BusyError):
        refuse_busy(line, Others(clock, lambda: line.query_block(f"STAT:OPER:ENAB {next(entries)};:R? 1", 8)))


def test_one_of_ours_whose_readings_are_rare_is_known_by_its_questions(
    line: SimulatedLink, clock: SteppedClock
) -> None:
    begin(line, 100.0)
    numbers = iter(range(1, 100))

    with pytest.raises(BusyError):
        refuse_busy(line, Others(clock, lambda: line.query(f"STAT:QUES:ENAB {next(numbers)};:DATA:POIN?")))
