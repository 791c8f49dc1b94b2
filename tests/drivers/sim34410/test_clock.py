import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim34410.clock import DeviceClock, SteppedClock
from tests.drivers.sim34410.links import counting_bench

DAY_NS = 86_400 * 10**9
rates = st.builds(
    DeviceClock,
    error_ppm=st.floats(-1000, 1000),
    drift_ppm_per_day=st.floats(-10, 10),
    wander_ppm=st.floats(0, 100),
    wander_period_s=st.floats(100, 86_400),
)


@given(clock=rates, host_ns=st.integers(0, 30 * DAY_NS))
def test_the_meter_s_time_and_back_is_the_same_instant(clock, host_ns):
    back_ns = clock.host_ns(np.array([clock.meter_ns(host_ns)]))[0]

    assert abs(back_ns - host_ns) <= 2


def test_a_constant_error_is_so_many_parts_per_million():
    assert DeviceClock(error_ppm=100.0).meter_ns(10**12) == 10**12 + 10**8


def test_a_drift_adds_up_as_a_parabola():
    # after a day at 2 ppm more per day: half of 2 ppm of a day
    assert DeviceClock(drift_ppm_per_day=2.0).meter_ns(DAY_NS) == DAY_NS + round(1e-6 * DAY_NS)


def test_a_wander_is_over_after_its_period_and_greatest_in_the_middle():
    clock = DeviceClock(wander_ppm=3.0)

    assert clock.meter_ns(DAY_NS) == DAY_NS
    # the integral of 3 ppm sin over half a turn: 3e-6 P / pi
    assert clock.meter_ns(DAY_NS // 2) - DAY_NS // 2 == pytest.approx(3e-6 * DAY_NS / np.pi, abs=1)


def test_readings_follow_the_meter_s_clock_and_their_truth_is_in_the_host_s():
    clock = SteppedClock()
    bench = counting_bench(clock, clock_error_ppm=100.0, clock_drift_ppm_per_day=5.0)
    line = bench.open_line("socket")
    line.receive(b"CONF:VOLT:DC 10;:VOLT:ZERO:AUTO OFF;:TRIG:DEL 0;COUN INF;:SAMP:COUN MAX;SOUR TIM;TIM 1;:INIT\n")
    clock.sleep(86_400.0)
    begin_ns = bench.truth["begin_ns"]
    intervals_ns = np.diff(begin_ns)

    # 100 ppm and half of 5 ppm of a day are 8.856 s more. The second trigger comes 20.2 ms after the 50,000th reading
    # began, and each reading takes 20 ms: floor(86408.856 - 49999.0202 - 0.02) + 1 after the first 50,000.
    assert begin_ns.size == 50_000 + 36_410
    assert intervals_ns[0] == pytest.approx(1e9 / (1 + 100e-6), abs=1)
    assert intervals_ns[-2000:].mean() == pytest.approx(1e9 / (1 + 105e-6), abs=100)  # of 2000 s, 0.1 ppm of a day's 5


def test_waiting_moves_a_stepped_clock_and_never_back():
    clock = SteppedClock(5)
    clock.sleep(1e-9)
    clock.sleep(-1.0)
    clock.sleep_until(3)

    assert clock() == 6
