"""What the meter told once, and what state it is in, after a link that failed in the middle: without a socket."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from aemd.acquire.instrument import BusyError
from aemd.errors import InstrumentError
from agilent34410 import Options
from agilent34410.meter import Meter as Driven
from agilent34410.meter import open_instrument
from sim34410 import Fault, Meter, MeterProperties
from sim34410.bench import Bench
from sim34410.clock import SteppedClock
from sim34410.simulated_link import SimulatedLink
from tests.storm.weather import Slope

INTERVAL_S = 10.0
"""Long: a reading finished between a failure and the look after it would make a full memory overflow anew."""
OPTIONS = Options(nplc=0.2, autozero="off", interval_s=INTERVAL_S)
MEMORY = 1000
OPEN = "Agilent Technologies,34410A,MY1,2.35-2.35-0.09-46-09"


class Line(SimulatedLink):
    """A line that notes what is said on it, and may lose one answer, or put events into one."""

    said: list[str]
    loses = ""
    """The answer to the next message with this in it never arrives."""
    events = 0
    """Bits that the next answer to STAT:QUES:EVEN? has besides."""

    def query(self, command: str) -> str:
        Line.said.append(command)
        answer = super().query(command)
        if Line.events and ":STAT:QUES:EVEN?" in command:
            entry, waiting, events, number = answer.split(";")
            answer, Line.events = f"{entry};{waiting};{int(events) | Line.events};{number}", 0
        self._lose(command)
        return answer

    def query_block(self, command: str, most: int) -> tuple[bytes, str]:
        answer = super().query_block(command, most)
        self._lose(command)
        return answer

    def _lose(self, command: str) -> None:
        if Line.loses and Line.loses in command:
            Line.loses = ""
            raise self._failure(command, "lost on the way")


@pytest.fixture
def clock() -> SteppedClock:
    return SteppedClock()


@pytest.fixture
def bench(clock: SteppedClock) -> Bench:
    Line.said, Line.loses, Line.events = [], "", 0
    return Bench(Meter(Slope(), clock, MeterProperties(noise=False, memory_readings=MEMORY)), clock)


@pytest.fixture
def open_line(bench: Bench, clock: SteppedClock) -> Callable[[], Line]:
    return lambda: Line(bench, clock)


@pytest.fixture
def driven(clock: SteppedClock, open_line: Callable[[], Line]) -> Driven:
    driven = open_instrument("SIM", OPTIONS, clock, open_line)
    driven.memory_readings = MEMORY  # of this one; the model has more
    driven.start()
    return driven


def test_an_overflow_that_was_told_in_an_answer_that_never_came_is_known_by_the_full_memory(
    driven: Driven, clock: SteppedClock
) -> None:
    clock.sleep((2 * MEMORY + 0.5) * INTERVAL_S)
    Line.loses = "STAT:QUES:EVEN?"
    with pytest.raises(InstrumentError):
        driven.drain(10)
    driven.recover()

    assert driven.drain(10).overflowed
    assert not driven.drain(10).overflowed


def test_without_a_full_memory_a_lost_answer_is_no_overflow(driven: Driven, clock: SteppedClock) -> None:
    clock.sleep(20.5 * INTERVAL_S)
    Line.loses = "STAT:QUES:EVEN?"
    with pytest.raises(InstrumentError):
        driven.drain(10)
    driven.recover()

    assert not driven.drain(10).overflowed


def test_what_a_look_found_is_told_by_the_next_whole_one_where_its_readings_never_came(
    driven: Driven, clock: SteppedClock
) -> None:
    clock.sleep((2 * MEMORY + 0.5) * INTERVAL_S)
    Line.events = 1 << 2  # an interval was not kept; the overflow is the meter's own
    Line.loses = "R? 10"
    with pytest.raises(InstrumentError):
        driven.drain(10)
    recovery = driven.recover()
    told, after = driven.drain(10), driven.drain(10)

    assert recovery.torn == 10
    assert (told.late, told.overflowed) == (True, True)
    assert (after.late, after.overflowed) == (False, False)


def test_a_meter_that_somebody_reset_has_lost_its_settings_though_it_was_not_switched_off(
    driven: Driven, bench: Bench, clock: SteppedClock
) -> None:
    SimulatedLink(bench, clock).query("*RST;*OPC?")
    recovery = driven.recover()

    assert not recovery.settings_kept
    assert not recovery.sampling
    driven.start()
    clock.sleep(20.5 * INTERVAL_S)
    assert driven.recover().settings_kept
    assert driven.drain(1000).values_V.size > 0


def test_a_meter_that_was_switched_off_keeps_no_settings_though_they_be_alike(
    driven: Driven, bench: Bench, clock: SteppedClock
) -> None:
    bench.add([Fault("power", (clock() - bench._on_ns) * 1e-9, lasts_s=0.1)])
    clock.sleep(1.0)
    for _ in range(5):  # its settings are sent by somebody else before we are back
        try:
            line = SimulatedLink(bench, clock)
            line.query("*OPC?")
            break
        except InstrumentError:
            clock.sleep(0.5)
    for command in driven.settings["commands"].split("; "):
        line.query(f"{command};*OPC?")
    for _ in range(5):
        try:
            recovery = driven.recover()
            break
        except InstrumentError:
            clock.sleep(0.5)

    assert not recovery.settings_kept


def test_a_meter_that_is_to_be_begun_afresh_is_given_its_settings_again(driven: Driven) -> None:
    assert driven.recover().settings_kept
    Line.said.clear()
    recovery = driven.recover(afresh=True)
    driven.start()

    assert not recovery.settings_kept
    assert not recovery.sampling
    assert any("*RST" in command for command in Line.said)


def test_a_meter_that_comes_back_with_another_interval_is_refused_as_often_as_it_is_tried(driven: Driven) -> None:
    driven.recover(afresh=True)
    driven._options = replace(OPTIONS, interval_s=2 * INTERVAL_S)  # what it would take instead
    for _ in range(2):
        with pytest.raises(InstrumentError, match="does not take its settings again"):
            driven.start()
        assert driven.interval_s == pytest.approx(INTERVAL_S)


def test_a_stranger_at_the_old_address_is_asked_who_it_is_and_nothing_more(driven: Driven, clock: SteppedClock) -> None:
    other = Bench(Meter(Slope(), clock, MeterProperties(identity=OPEN)), clock)
    driven._dialogue._open_link = lambda: Line(other, clock)
    driven._dialogue._link.close()
    Line.said.clear()
    with pytest.raises(InstrumentError, match=r"this is .*MY1.* now, not"):
        driven.recover()

    assert Line.said == ["*IDN?"]


def test_a_meter_that_another_of_ours_took_over_is_left_to_it_until_it_reads_no_more(
    driven: Driven, clock: SteppedClock, open_line: Callable[[], Line]
) -> None:
    other = open_instrument("SIM", OPTIONS, clock, open_line, clock.sleep)  # we were asleep, say
    other.start()
    clock.sleep(2.5 * INTERVAL_S)
    with pytest.raises(InstrumentError, match="another program"):
        driven.drain(10)

    def sleep_while_it_reads(seconds: float) -> None:
        clock.sleep(seconds)
        other.drain(10)

    driven._sleep = sleep_while_it_reads
    for _ in range(2):
        with pytest.raises(BusyError):
            driven.recover()
    driven._sleep = clock.sleep
    recovery = driven.recover()

    assert not recovery.sampling
    assert not recovery.settings_kept
    driven.start()
    clock.sleep(2.5 * INTERVAL_S)
    assert driven.drain(10).values_V.size == 3  # the first at once


def test_a_meter_that_another_took_over_since_the_last_look_is_neither_stopped_nor_spoken_to_at_the_end(
    driven: Driven, bench: Bench, clock: SteppedClock, open_line: Callable[[], Line]
) -> None:
    other = open_instrument("SIM", OPTIONS, clock, open_line, clock.sleep)
    other.start()
    SimulatedLink(bench, clock).query("DISP OFF;*STB?")
    Line.said.clear()
    with pytest.raises(InstrumentError, match="another program uses it"):
        driven.stop()
    driven.close()

    assert not [command for command in Line.said if "ABOR" in command or "DISP" in command]
    assert other.recover().sampling
    assert not bench.meter.display.on


def test_a_close_without_a_stop_looks_whose_the_meter_is(
    driven: Driven, clock: SteppedClock, open_line: Callable[[], Line]
) -> None:
    other = open_instrument("SIM", OPTIONS, clock, open_line, clock.sleep)
    other.start()
    driven.close()

    assert other.recover().sampling


def test_a_journal_begun_by_an_answer_that_was_lost_is_known_as_ours(driven: Driven) -> None:
    Line.loses = "STAT:OPER:ENAB"
    with pytest.raises(InstrumentError):
        driven.start()
    driven.recover()

    assert not driven._dialogue.is_anothers
