"""The end of a stream: whatever was made until the stop is recorded or in a gap, on a clock that waiting moves."""

import re

import pytest

from agilent34410 import Options
from sim34410.bench import Link
from sim34410.faults import Fault, Kind
from tests.storm.judge import judge
from tests.storm.weather import Passed, pass_through

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
