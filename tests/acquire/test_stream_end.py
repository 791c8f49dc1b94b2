"""The end of a stream: whatever was made until the stop is recorded or in a gap, on a clock that waiting moves."""

import re

import pytest

from aemd.acquire.instrument import Instrument, Recoverable
from aemd.acquire.stream import Stream
from agilent34410 import Options
from agilent34410.meter import open_instrument
from sim34410 import Meter, MeterProperties
from sim34410.bench import Bench, Link
from sim34410.clock import SteppedClock
from sim34410.faults import Fault, Kind
from sim34410.simulated_link import SimulatedLink
from tests.storm.judge import judge
from tests.storm.weather import Passed, Slope, pass_through

FAST = Options(interval_s=1e-4, aperture_s=1e-4, autozero="off", trigger_delay_s=0.0, display=False)
LINKS = ("socket", "vxi11", "usb")


def lost_within(passed: Passed) -> tuple[int, int]:
    """Return how many readings the one gap, at the end, says are lost, and by how many it may err."""
    (gap,) = passed.gaps
    assert gap.first_index == passed.readings.size
    lost = gap.last_index - gap.first_index + 1
    assert lost == passed.stream.ledger.lost
    return lost, int(re.findall(r"give or take (\d+)", gap.message)[0])


@pytest.mark.parametrize("link", LINKS)
def test_a_meter_that_was_cleared_shortly_before_the_stop_leaves_a_gap_up_to_the_stop(link: Link) -> None:
    # Not so long before that a meter without readings would have been noticed.
    passed = pass_through([Fault("clear", 30.0)], 34.0, link=link, poll_s=0.0)
    lost, within = lost_within(passed)
    due = (passed.ended_ns - passed.truth["middle_ns"][0]) * 1e-9 / Options().interval_s

    assert "had stopped" in passed.gaps[0].message
    assert passed.readings.size + lost == pytest.approx(due, abs=within + 2)
    assert judge(passed).breaches == 0


@pytest.mark.parametrize(("link", "kind"), [("socket", "power"), ("vxi11", "close"), ("usb", "power")])
@pytest.mark.parametrize("poll_s", [0.0, 0.05])
def test_what_a_fault_at_the_stop_takes_with_it_is_a_gap(link: Link, kind: Kind, poll_s: float) -> None:
    # The stop is heard after the wait that is under way at 5 s, and the fault has struck in the course of that.
    passed = pass_through([Fault(kind, 5.0006)], 5.0, options=FAST, link=link, poll_s=poll_s)
    lost, within = lost_within(passed)
    stop_at_most_ns = passed.began_ns + 5_060_000_000
    due_at_the_stop = (stop_at_most_ns - passed.truth["middle_ns"][0]) * 1e-9 / FAST.interval_s

    assert passed.stream.outages == 0
    assert passed.readings.size + lost - within <= due_at_the_stop
    assert passed.readings.size + lost + within >= passed.truth.size
    assert judge(passed).breaches == 0


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("options", [Options(), FAST])
def test_a_stop_at_whatever_phase_of_the_interval_makes_no_gap(link: Link, options: Options) -> None:
    for tenths in range(5):
        seconds = (20 + tenths / 5) * options.interval_s + 1.0
        passed = pass_through((), seconds, options=options, link=link, poll_s=0.0, clock_error_ppm=100.0)

        assert passed.gaps == []
        assert judge(passed).breaches == 0


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("kind", ["half", "lost", "silent"])
def test_told_to_stop_right_after_an_answer_was_torn_what_the_meter_holds_is_fetched(link: Link, kind: Kind) -> None:
    passed = pass_through([Fault(kind, 9.0)], 10.5, link=link, poll_s=0.0)  # within the timeout of that answer

    assert passed.gaps == []
    assert passed.readings["index"].tolist() == list(range(passed.truth.size))
    assert [event.message.split(":")[0].split()[0] for event in passed.events if event.kind == "link"] == [
        "lost",
        "back",
    ]
    assert judge(passed).breaches == 0


@pytest.mark.parametrize("kind", ["half", "lost", "late"])
def test_an_answer_that_is_torn_in_the_course_of_the_stop_loses_nothing_and_invents_no_gap(kind: Kind) -> None:
    for strikes_s in (10.0, 10.0005, 10.001, 10.0015, 10.002, 10.0025, 10.003):
        passed = pass_through([Fault(kind, strikes_s)], 10.0, poll_s=0.0)
        torn = [gap for gap in passed.gaps if "never arrived whole" in gap.message]

        assert passed.gaps == torn
        assert passed.readings.size + passed.stream.ledger.lost == passed.truth.size
        assert judge(passed).breaches == 0


def test_told_to_stop_after_a_long_outage_the_link_is_tried_once_more_and_the_stop_is_not_kept_waiting() -> None:
    passed = pass_through([Fault("unplug", 10.0, lasts_s=1000.0)], 60.0)
    (gap,) = passed.gaps

    assert "told to stop while the link was down" in gap.message
    assert (passed.ended_ns - passed.began_ns) * 1e-9 < 60.0 + 4 * Options().timeout_s


@pytest.mark.parametrize("reads", [True, False])
def test_a_meter_that_another_program_took_over_is_left_to_it_at_the_stop_and_that_is_said_once(reads: bool) -> None:
    clock = SteppedClock()
    bench = Bench(Meter(Slope(), clock, MeterProperties(noise=False)), clock)
    others: list[Instrument] = []
    end_ns = clock() + 10_000_000_000

    def sleep(seconds: float) -> None:
        clock.sleep(seconds)
        if reads and others:
            others[0].drain(10)

    def wait(seconds: float) -> bool:
        clock.sleep(seconds)
        if clock() >= end_ns and not others:
            others.append(open_instrument("SIM", Options(), clock, lambda: SimulatedLink(bench, clock), clock.sleep))
            others[0].start()
        return clock() >= end_ns

    meter = open_instrument("SIM", Options(), clock, lambda: SimulatedLink(bench, clock), sleep)
    stream = Stream(meter, wait=wait, room=lambda: 1 << 17, clock=clock, utc=clock)
    events = [event for delivery in stream.deliveries() for event in delivery.events]
    meter.close()
    said = [event.message for event in events if event.kind == "link"]
    (gap,) = [event for event in events if event.kind == "gap"]

    assert len(said) == len(set(said)) == (2 if reads else 1)
    assert ("another program had taken" if reads else "had lost its settings") in gap.message
    other = others[0]
    assert isinstance(other, Recoverable)
    assert other.recover().sampling
