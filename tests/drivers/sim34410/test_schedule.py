import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim34410.schedule import GRID_NS, REARM_NS, Schedule, on_grid_ns

schedules = st.builds(
    Schedule,
    first_ns=st.integers(0, 10**15),
    delay_ns=st.integers(0, 10**7),
    interval_ns=st.integers(5, 10**8).map(lambda ticks: ticks * GRID_NS),
    reading_ns=st.integers(1, 5 * GRID_NS),
    samples=st.integers(1, 7),
    triggers=st.integers(1, 5) | st.none(),
)


@pytest.mark.parametrize(
    ("asked_s", "ns"),
    [(1 / 15, 66_680_000), (0.0667, 66_700_000), (0.5, 500_000_000), (100e-6, 100_000), (1e-6, 20_000)],
)
def test_the_timer_takes_the_next_tick_of_its_grid(asked_s, ns):
    assert on_grid_ns(asked_s) == ns


@given(schedules, st.integers(0, 60))
def test_a_reading_is_counted_from_the_nanosecond_that_it_is_finished(schedule, index):
    if schedule.total is not None:
        index %= schedule.total
    ready_ns = int(schedule.begin_ns(index, index + 1)[0]) + schedule.reading_ns

    assert schedule.finished(ready_ns - 1) == index
    assert schedule.finished(ready_ns) == index + 1


@given(schedules)
def test_readings_are_an_interval_apart_within_a_trigger_and_begin_anew_after_it(schedule):
    begin_ns = schedule.begin_ns(0, 3 * schedule.samples)
    steps = np.diff(begin_ns).tolist()
    boundary = schedule.reading_ns + REARM_NS + schedule.delay_ns

    expected = ([schedule.interval_ns] * (schedule.samples - 1) + [boundary]) * 3
    assert steps == expected[:-1]
    assert begin_ns[0] == schedule.first_ns + schedule.delay_ns


@given(schedules)
def test_a_finite_schedule_ends_with_its_last_reading(schedule):
    if schedule.total is None:
        assert schedule.end_ns is None
    else:
        last_ns = int(schedule.begin_ns(schedule.total - 1, schedule.total)[0]) + schedule.reading_ns
        assert schedule.end_ns == last_ns
        assert schedule.finished(last_ns + 10**15) == schedule.total
