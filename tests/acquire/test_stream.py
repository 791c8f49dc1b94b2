"""Lost links, lost settings and clocks that are set, on a clock that waiting moves."""

import re

import numpy as np
import pytest

from aemd.acquire.stream import Stream
from aemd.block import Status
from aemd.errors import InstrumentError
from agilent34410 import Options
from agilent34410.meter import open_instrument
from sim34410 import Meter, MeterProperties
from sim34410.bench import Bench, Link
from sim34410.clock import SteppedClock
from sim34410.faults import Fault
from sim34410.simulated_link import SimulatedLink
from tests.storm.judge import judge
from tests.storm.weather import Passed, Slope, pass_through


def whole(passed: Passed) -> bool:
    return not passed.gaps and passed.readings["index"].tolist() == list(range(passed.truth.size))


def lost(passed: Passed) -> list[int]:
    return [gap.last_index - gap.first_index + 1 for gap in passed.gaps]


def test_an_outage_of_ten_minutes_at_15_hz_loses_nothing_where_the_meter_goes_on_sampling() -> None:
    passed = pass_through(
        [Fault("unplug", 120.0, lasts_s=600.0)], 900.0, clock_error_ppm=100.0, clock_drift_ppm_per_day=10.0
    )

    assert whole(passed)
    assert judge(passed).breaches == 0
    assert passed.stream.outages == 1


def test_stamps_of_an_outage_of_ten_minutes_are_true_to_four_milliseconds_although_nobody_looked() -> None:
    passed = pass_through([Fault("unplug", 300.0, lasts_s=600.0)], 960.0, clock_error_ppm=-100.0)

    assert judge(passed).worst_inside_ns < 4_000_000


def test_an_outage_longer_than_the_memory_loses_what_was_overwritten_and_no_more() -> None:
    # 10 s of an interval of 0.2 ms are all that 50,000 readings last.
    fast = Options(interval_s=2e-4, aperture_s=1e-4, autozero="off", trigger_delay_s=0.0, display=False)
    passed = pass_through([Fault("unplug", 5.0, lasts_s=12.0)], 25.0, options=fast, poll_s=0.01)
    within = sum(int(re.findall(r"give or take (\d+)", gap.message)[0]) for gap in passed.gaps)

    assert all("memory was full" in gap.message for gap in passed.gaps)
    assert abs(passed.readings.size + sum(lost(passed)) - passed.truth.size) <= within <= 30


@pytest.mark.parametrize("kind", ["lost", "half", "garbage", "length"])
def test_a_block_that_left_the_memory_and_never_arrived_is_a_gap_of_exactly_its_readings(kind: str) -> None:
    # Every tenth of a second for a while, so that some strike the answers to R? and some the others.
    faults = [Fault(kind, 30.0 + 5.13 * number) for number in range(20)]  # type: ignore[arg-type]
    passed = pass_through(faults, 200.0, poll_s=0.5)
    judged = judge(passed)

    assert judged.breaches == 0, judged
    assert passed.readings.size + sum(lost(passed)) == passed.truth.size
    assert all("never arrived whole" in gap.message for gap in passed.gaps)
    assert passed.stream.outages > 5


def test_after_a_failure_single_readings_are_risked_until_one_arrives_and_then_the_backlog() -> None:
    # The cable comes back, and for 10 s every block is torn; some 900 readings wait.
    passed = pass_through([Fault("unplug", 30.0, lasts_s=60.0), Fault("length", 90.0, lasts_s=10.0)], 140.0)
    judged = judge(passed)

    assert judged.breaches == 0, judged
    assert passed.readings.size + sum(lost(passed)) == passed.truth.size
    assert set(lost(passed)) <= {1}
    assert sum(lost(passed)) < 20


def test_a_late_answer_is_not_taken_for_another() -> None:
    faults = [
        Fault("late", 30.0 + 10 * number, delay_s=delay) for number, delay in enumerate((0.5, 1.9, 2.2, 2.5, 5.0))
    ]
    passed = pass_through(faults, 100.0)

    assert judge(passed).breaches == 0


@pytest.mark.parametrize(("kind", "why"), [("power", "had lost its settings"), ("clear", "had stopped")])
def test_a_meter_that_lost_its_run_is_set_up_and_started_again_and_the_clock_counts_what_is_missing(
    kind: str, why: str
) -> None:
    passed = pass_through([Fault(kind, 60.0, lasts_s=10.0)], 120.0, clock_error_ppm=100.0)  # type: ignore[arg-type]
    (gap,) = passed.gaps
    jump = np.flatnonzero(np.diff(passed.readings["index"]) > 1)[0]
    before_ns, after_ns = passed.readings["t_ns"][jump : jump + 2]
    by_time = (after_ns - before_ns) / (Options().interval_s * 1e9) - 1

    assert why in gap.message
    assert "about" in gap.message
    assert "give or take" in gap.message
    assert abs(lost(passed)[0] - by_time) <= 2
    assert passed.readings["status"][jump + 1] & Status.GAP
    assert judge(passed).breaches == 0


def test_told_to_stop_while_the_link_is_down_it_stops_and_says_what_is_missing() -> None:
    passed = pass_through([Fault("unplug", 60.0, lasts_s=1000.0)], 100.0)
    (gap,) = passed.gaps

    assert "told to stop while the link was down" in gap.message
    acquired_s = (passed.ended_ns - passed.began_ns) * 1e-9
    assert acquired_s < 100 + 2.5 * Options().timeout_s  # the attempt that was under way
    assert gap.last_index == pytest.approx(acquired_s / Options().interval_s, abs=5)
    assert passed.tally.counts.lost == lost(passed)[0]


def test_after_give_up_s_the_failure_is_raised_with_the_time_it_took() -> None:
    with pytest.raises(InstrumentError, match=r"gave up after [0-9.]+ s without it"):
        pass_through([Fault("unplug", 20.0, lasts_s=1000.0)], 100.0, give_up_s=30.0)


def test_a_wall_clock_that_is_set_is_told_of_and_moves_no_stamp() -> None:
    passed = pass_through((), 120.0, utc_steps=[(40.0, 3600.0), (80.0, -1.5)])
    said = [event.message for event in passed.events if "wall clock" in event.message]

    assert judge(passed).breaches == 0
    assert np.all(np.diff(passed.readings["t_ns"]) > 0)
    assert [message.split("set by ")[1].split(" s;")[0] for message in said] == ["+3600.000", "-1.500"]


@pytest.mark.parametrize(
    ("error_ppm", "drift_ppm_per_day"),
    [
        pytest.param(100.0, 0.0, marks=pytest.mark.slow),
        pytest.param(-100.0, 0.0, marks=pytest.mark.slow),
        (50.0, 40.0),
    ],
)
def test_the_rate_of_the_meters_clock_is_found_within_what_is_claimed(
    error_ppm: float, drift_ppm_per_day: float
) -> None:
    seconds = 400.0
    passed = pass_through((), seconds, clock_error_ppm=error_ppm, clock_drift_ppm_per_day=drift_ppm_per_day)
    true_rate = -(error_ppm + drift_ppm_per_day * seconds / 86_400) * 1e-6  # a clock that is fast has short intervals

    assert judge(passed).breaches == 0
    assert abs(passed.stream.fit.rate - true_rate) <= passed.stream.fit.rate_uncertainty < 40e-6
    assert passed.stream.fit.restarts == 0


def test_a_failure_right_after_the_return_is_one_outage_with_pauses_not_a_flood_of_them() -> None:
    passed = pass_through([Fault("lost", 30.0, lasts_s=60.0)], 120.0)

    assert passed.stream.outages <= 2
    assert len([event for event in passed.events if event.kind == "link"]) <= 4


def test_looks_that_are_asked_for_to_be_rare_are_rare_and_stamps_are_true_even_where_the_timer_begins_anew() -> None:
    seconds, poll_s = 3600.0, 3.0
    passed = pass_through((), seconds, poll_s=poll_s, clock_error_ppm=100.0)

    assert [event.kind for event in passed.events].count("epoch") == 1  # after 50,000 readings
    assert judge(passed).breaches == 0
    assert passed.stream.fit.uncertainty_ns < 1_000_000
    # And at 2 ms for the first reading of each epoch and the last two of the one, before which nothing is known.
    assert passed.stream.turns < seconds / poll_s + 300


@pytest.mark.parametrize("link", ["socket", "vxi11", "usb", "serial"])
def test_once_the_clock_is_known_every_second_reading_is_looked_for_and_the_stamps_are_true(link: Link) -> None:
    seconds = 90.0
    passed = pass_through((), seconds, link=link, poll_s=0.0, clock_error_ppm=-100.0, clock_drift_ppm_per_day=5.0)
    calm_looks = seconds / (2 * Options().interval_s)

    assert judge(passed).breaches == 0
    assert judge(passed).worst_ns < 500_000
    # And at 2 ms for the second of readings that it takes to know the clock.
    assert calm_looks <= passed.stream.turns < 1.01 * calm_looks + 500


def test_looks_are_frequent_again_where_an_outage_has_left_the_clock_ill_known() -> None:
    passed = pass_through([Fault("unplug", 30.0, lasts_s=900.0)], 960.0, poll_s=0.0, clock_error_ppm=100.0)

    assert whole(passed)
    assert judge(passed).breaches == 0


def test_an_instrument_without_a_way_back_ends_the_acquisition() -> None:
    clock = SteppedClock()
    bench = Bench(Meter(Slope(), clock, MeterProperties(noise=False)), clock, [Fault("close", 5.0)])
    meter = open_instrument("SIM", Options(), clock, lambda: SimulatedLink(bench, clock))

    class Plain:
        """The meter without `recover`."""

        def __getattr__(self, name: str) -> object:
            if name == "recover":
                raise AttributeError(name)
            return getattr(meter, name)

    def wait(seconds: float) -> bool:
        clock.sleep(seconds)
        return False

    stream = Stream(Plain(), wait=wait, room=lambda: 1000, clock=clock, utc=clock)  # type: ignore[arg-type]
    with pytest.raises(InstrumentError, match="the other end has closed the connection"):
        list(stream.deliveries())


def test_a_stop_is_heard_though_it_comes_while_a_recovery_waits_for_room() -> None:
    clock = SteppedClock()
    bench = Bench(Meter(Slope(), clock, MeterProperties(noise=False)), clock, [Fault("close", 5.0)])
    opened: list[SimulatedLink] = []
    told_ns: list[int] = []

    def open_line() -> SimulatedLink:
        opened.append(SimulatedLink(bench, clock))
        return opened[-1]

    def is_full() -> bool:
        return len(opened) > 1 and not told_ns

    meter = open_instrument("SIM", Options(), clock, open_line)
    stopped_ns, give_up_ns = clock() + 4_000_000_000, clock() + 60_000_000_000

    def wait(seconds: float) -> bool:
        before_ns = clock()
        clock.sleep(seconds)
        if before_ns < stopped_ns <= clock():
            SimulatedLink(bench, clock).query("ABOR;*OPC?")  # what waits can still be read, after the line is back
        assert clock() < give_up_ns, "it goes on although it was told to stop"
        if is_full():
            told_ns.append(clock())
            return True
        return False

    stream = Stream(meter, wait=wait, room=lambda: 0 if is_full() else 1000, clock=clock, utc=clock)
    list(stream.deliveries())

    assert told_ns


def test_a_process_that_was_put_to_sleep_between_question_and_answer_does_not_take_the_meter_for_silent() -> None:
    clock = SteppedClock()
    bench = Bench(Meter(Slope(), clock, MeterProperties(noise=False, truth_readings=10_000)), clock)
    asleep_ns, end_ns = clock() + 10_000_000_000, clock() + 40_000_000_000
    slept: list[int] = []

    class Line(SimulatedLink):
        def query(self, command: str) -> str:
            answer = super().query(command)
            if "DATA:POIN?" in command and answer.split(";")[1] == "+0" and clock() > asleep_ns and not slept:
                slept.append(clock())
                clock.sleep(20.0)
            return answer

    def wait(seconds: float) -> bool:
        clock.sleep(seconds)
        return clock() > end_ns

    meter = open_instrument("SIM", Options(), clock, lambda: Line(bench, clock))
    # So often that most looks find nothing.
    stream = Stream(meter, wait=wait, room=lambda: 1000, poll_s=0.02, clock=clock, utc=clock)
    index = np.concatenate([delivery.block["index"] for delivery in stream.deliveries()])

    assert slept
    assert stream.outages == 0
    assert index.tolist() == list(range(bench.truth.size))


def test_readings_that_are_not_a_number_are_told_of_at_their_begin_and_their_end() -> None:
    passed = pass_through([Fault("nan", 20.0, lasts_s=10.0)], 60.0)
    without = (passed.readings["status"] & Status.INVALID) != 0
    changes = np.flatnonzero(np.diff(without.astype(int), prepend=0))

    assert np.count_nonzero(without) == pytest.approx(10.0 / Options().interval_s, abs=1)
    told = [event.t_ns for event in passed.events if event.kind == "invalid"]
    assert told == passed.readings["t_ns"][changes].tolist()


def test_another_meter_at_the_address_is_told_of_once_and_the_own_one_is_waited_for() -> None:
    clock = SteppedClock()
    bench = Bench(Meter(Slope(), clock, MeterProperties(noise=False)), clock, [Fault("close", 10.0)])
    other = Bench(
        Meter(Slope(), clock, MeterProperties(identity="Agilent Technologies,34410A,MY1,2.35-2.35-0.09-46-09")), clock
    )
    begun_ns = clock()
    meter = open_instrument(
        "SIM",
        Options(),
        clock,
        lambda: SimulatedLink(other if 10e9 < clock() - begun_ns < 40e9 else bench, clock),
    )

    def wait(seconds: float) -> bool:
        clock.sleep(seconds)
        return clock() - begun_ns > 60e9

    stream = Stream(meter, wait=wait, room=lambda: 1 << 17, clock=clock, utc=clock)
    said = [event.message for delivery in stream.deliveries() for event in delivery.events if event.kind == "link"]

    assert len(said) == 3
    assert "closed the connection" in said[0]
    assert "MY1" in said[1]
    assert "connect that one again" in said[1]
    assert said[2].startswith("back")
    assert stream.ledger.lost == 0
