from dataclasses import replace
from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aemd.model import GaussMarkov, Level, Model, Shocks, Sine
from sim34410.meter import Meter, MeterProperties
from sim34410.schedule import REARM_NS

TIMING_VIOLATION, MEMORY_OVERFLOW, VOLTAGE_OVERLOAD = 1 << 2, 1 << 14, 1 << 0


def questionable(bench):
    return int(bench.ask("STAT:QUES:EVEN?"))


def test_the_timer_answers_the_value_on_its_grid(bench):
    bench.tell("SAMP:TIM 66.6667 ms")

    assert bench.ask("SAMP:TIM?") == "+6.66800000E-02"


@pytest.mark.parametrize(
    ("line_hz", "settings_", "least_s"),
    [
        (50, "NPLC 1;ZERO:AUTO OFF", 0.02),
        (50, "NPLC 1;ZERO:AUTO ON", 0.04),
        (50, "NPLC 2;ZERO:AUTO ON", 0.08),
        (60, "NPLC 0.006;ZERO:AUTO OFF", 100e-6),
        (60, "NPLC 0.2;ZERO:AUTO OFF", 3.34e-3),  # 3.3333 ms on the 20 us grid
        (50, "APER 100e-6;ZERO:AUTO OFF", 100e-6),
    ],
)
def test_the_least_interval_is_what_aperture_and_autozero_need(make_bench, line_hz, settings_, least_s):
    bench = make_bench(line_frequency_hz=line_hz)
    bench.tell(f"VOLT:DC:{settings_}")

    assert float(bench.ask("SAMP:TIM? MIN")) == pytest.approx(least_s, abs=1e-12)


@pytest.mark.parametrize(("autozero", "reading_s"), [("OFF", 0.02), ("ON", 0.04)])
def test_a_reading_is_there_a_delay_and_its_duration_after_the_trigger(bench, autozero, reading_s):
    bench.stream("100 ms", f"VOLT:ZERO:AUTO {autozero}", "TRIG:DEL 5 ms")
    bench.clock.advance(0.005 + reading_s - 1e-6)
    assert bench.ask("DATA:POIN?") == "+0"

    bench.clock.advance(1e-6)
    assert bench.ask("DATA:POIN?") == "+1"

    bench.clock.advance(0.1)
    assert bench.ask("DATA:POIN?") == "+2"


def test_ten_thousand_readings_a_second_lose_nothing_while_they_are_drained(make_bench):
    bench = make_bench(line_frequency_hz=60)
    bench.stream("100 us", "VOLT:NPLC 0.006")
    drained = 0
    for _ in range(40):
        bench.clock.advance(1.7)
        drained += (len(bench.ask_bytes("R?")) - 8) // 8

    assert drained == round(40 * 1.7e4) - round(REARM_NS / 100e3) * ((drained - 1) // 50_000)
    assert np.array_equal(bench.meter.truth["index"], np.arange(drained))
    assert questionable(bench) == 0


def test_an_overflow_keeps_the_newest_and_sets_bit_14_once_read_it_is_gone(make_bench):
    bench = make_bench(GaussMarkov(rate_V_per_rt_s=1e-3), line_frequency_hz=60)
    bench.stream("1 ms", "VOLT:NPLC 0.006")
    bench.clock.advance(49.9992)
    assert bench.ask("DATA:POIN?") == "+50000"
    assert questionable(bench) == 0

    bench.clock.advance(10)
    assert bench.ask("DATA:POIN?") == "+50000"
    assert questionable(bench) == MEMORY_OVERFLOW
    kept = np.frombuffer(bench.ask_bytes("R?")[8:-1], ">f8")
    assert np.array_equal(kept, bench.meter.truth["value_V"][-50_000:])
    assert questionable(bench) == 0
    assert bench.errors() == []


def test_a_too_short_interval_is_taken_and_reported_as_a_timing_violation(bench):
    bench.stream("30 ms", "VOLT:ZERO:AUTO ON")  # 40 ms are needed at 50 Hz
    bench.clock.advance(1.0)

    assert questionable(bench) & TIMING_VIOLATION
    begin_ns = bench.meter.truth["begin_ns"]
    assert set(np.diff(begin_ns).tolist()) == {40_000_000}


def test_an_interval_that_can_be_kept_is_no_violation(bench):
    bench.stream("40 ms", "VOLT:ZERO:AUTO ON")
    bench.clock.advance(1.0)

    assert bench.ask("DATA:POIN?") == "+25"
    assert questionable(bench) == 0


def test_a_new_timing_epoch_begins_after_sample_count_readings(bench):
    bench.stream("100 ms", "TRIG:DEL 1 ms", "SAMP:COUN 3")
    bench.clock.advance(1.0)
    steps = np.diff(bench.meter.truth["begin_ns"])[:5].tolist()

    assert steps == [10**8, 10**8, 20_000_000 + REARM_NS + 1_000_000, 10**8, 10**8]


@pytest.mark.parametrize(("range_V", "most_V"), [(0.1, 0.12), (1, 1.2), (10, 12.0), (100, 120.0), (1000, 1000.0)])
@pytest.mark.parametrize("sign", [1, -1])
def test_beyond_120_percent_of_the_range_a_reading_is_an_overload(make_bench, range_V, most_V, sign):
    for level_V, expected in ((0.999 * most_V, 0.999 * most_V), (1.001 * most_V, 9.9e37)):
        bench = make_bench(Level(level_V=sign * level_V), noise=False)
        bench.tell(f"CONF:VOLT:DC {range_V}", "INIT")
        bench.clock.advance(1)

        assert float(bench.ask("FETC?")) == pytest.approx(sign * expected, rel=1e-8)
        assert questionable(bench) == (VOLTAGE_OVERLOAD if expected == 9.9e37 else 0)
        assert bench.errors() == []


@pytest.mark.parametrize(("level_V", "range_V"), [(0.1, 0.1), (0.13, 1), (-11.9, 10), (12.1, 100), (500, 1000)])
def test_autorange_finds_the_range(make_bench, level_V, range_V):
    bench = make_bench(Level(level_V=level_V), noise=False)
    bench.tell("*RST", "INIT")
    bench.clock.advance(1)

    assert float(bench.ask("FETC?")) == pytest.approx(level_V)
    assert float(bench.ask("VOLT:RANG?")) == range_V


@pytest.mark.parametrize(("nplc", "gain"), [(0.2, np.sinc(0.2)), (1, 0.0), (2, 0.0), (10, 0.0)])
def test_mains_hum_passes_as_the_sinc_of_the_aperture(make_bench, nplc, gain):
    bench = make_bench(Sine(amplitude_V=1.0, frequency_hz=50.0), noise=False)
    bench.stream("0.2137", f"VOLT:NPLC {nplc}")
    bench.clock.advance(2000)
    value_V = bench.meter.truth["value_V"]

    assert np.sqrt(2) * value_V.std() == pytest.approx(gain, abs=0.02 * gain + 1e-7)


def test_an_aperture_for_60_hz_lets_50_hz_through(make_bench):
    bench = make_bench(Sine(amplitude_V=1.0, frequency_hz=50.0), noise=False, line_frequency_hz=60)
    bench.stream("0.2137", "VOLT:NPLC 1")
    bench.clock.advance(2000)

    assert np.sqrt(2) * bench.meter.truth["value_V"].std() == pytest.approx(np.sinc(50 / 60), rel=0.02)


def test_a_fast_clock_takes_more_readings_and_shorter_apertures(make_bench):
    bench = make_bench(clock_error_ppm=100.0)
    bench.stream("100 ms")
    start_ns = bench.clock.now_ns
    bench.clock.advance(1_000.0)
    begin_ns = bench.meter.truth["begin_ns"]

    assert begin_ns.size == 10_001  # 1000.1 s of the meter's own time
    assert np.polyfit(np.arange(1000), begin_ns[:1000] - start_ns, 1)[0] == pytest.approx(1e8 / 1.0001, rel=1e-9)


def test_a_fast_clock_does_not_shift_the_input(make_bench):
    hum = Sine(amplitude_V=1.0, frequency_hz=0.731)
    bench = make_bench(hum, clock_error_ppm=1000.0, noise=False)
    power_on_ns = bench.clock.now_ns
    bench.stream("100 ms")
    bench.clock.advance(1_000.0)
    truth = bench.meter.truth
    expected_V = hum.average((truth["begin_ns"] - power_on_ns) * 1e-9, 0.02 / 1.001)

    assert truth["signal_V"] == pytest.approx(expected_V, abs=1e-7)


@settings(deadline=None, max_examples=25)
@given(pauses_ms=st.lists(st.integers(0, 400), min_size=1, max_size=20), seed=st.integers(0, 1000))
def test_readings_do_not_depend_on_when_they_are_asked_for(pauses_ms, seed):
    def read(pauses):
        now_ns = [0]
        source = Model(
            (GaussMarkov.from_sd(sd_V=1e-3, tau_s=1.0), Shocks(rate_per_s=2.0, sd_V=0.1, decay_s=0.05)), seed
        )
        meter = Meter(source.realise(), lambda: now_ns[0], MeterProperties(truth_readings=10_000, seed=seed))
        timed = {"trigger_count": inf, "sample_count": 7, "sample_source": "TIM", "timer_ns": 25_000_000}
        meter.configure(replace(meter.settings, autozero=False, **timed))
        meter.initiate()
        for pause in pauses:
            now_ns[0] += pause * 1_000_000
            meter.advance()
        return meter.truth.tobytes()

    assert read(pauses_ms) == read([sum(pauses_ms)])


def test_the_truth_of_a_reading_adds_up_to_its_value(make_bench):
    bench = make_bench(Level(level_V=0.1), Sine(amplitude_V=0.2, frequency_hz=0.3, role="external"), noise=False)
    bench.stream("50 ms")
    bench.clock.advance(10)
    truth = bench.meter.truth

    assert truth["signal_V"] + truth["external_V"] == pytest.approx(truth["value_V"])
    assert set(truth["signal_V"]) == {0.1}


def test_bus_triggers_take_one_block_each_and_are_refused_when_not_awaited(bench):
    bench.tell("*CLS", "TRIG:SOUR BUS;COUN 2", "SAMP:COUN 3", "VOLT:NPLC 1;ZERO:AUTO OFF")
    bench.ask("*TRG")
    assert bench.errors() == [-211]
    bench.tell("INIT")
    counts = []
    for _ in range(2):
        bench.tell("*TRG")
        bench.clock.advance(1)
        counts.append(bench.ask("DATA:POIN?"))
    bench.ask("*TRG")

    assert counts == ["+3", "+6"]
    assert bench.errors() == [-211]


def test_init_clears_the_memory_and_is_ignored_while_measuring(bench):
    bench.stream("100 ms")
    bench.clock.advance(1)
    bench.ask("INIT")
    assert bench.errors() == [-213]
    assert bench.ask("DATA:POIN?") == "+10"

    bench.tell("ABOR")
    assert bench.ask("DATA:POIN?") == "+10"
    bench.tell("INIT")
    assert bench.ask("DATA:POIN?") == "+0"


def test_a_change_of_the_measurement_ends_it_and_clears_the_memory(bench):
    bench.stream("100 ms")
    bench.clock.advance(1)
    bench.tell("VOLT:NPLC 2")
    bench.clock.advance(1)

    assert bench.ask("DATA:POIN?") == "+0"
    assert bench.ask("STAT:OPER:COND?") == "+0"


def test_a_change_of_the_trigger_system_ends_the_measurement_and_keeps_its_readings(bench):
    bench.stream("100 ms")
    bench.clock.advance(1)
    bench.tell("TRIG:DEL 1")
    bench.clock.advance(1)

    assert bench.ask("DATA:POIN?") == "+10"
    assert bench.ask("STAT:OPER:COND?") == "+512"  # idle; the memory threshold is reached


def test_reset_restores_the_defaults(bench):
    bench.stream("100 ms", "DISP OFF", "FORM:BORD SWAP")
    bench.clock.advance(1)
    bench.tell("*RST")

    assert bench.ask("VOLT:NPLC?;RANG:AUTO?;:VOLT:ZERO:AUTO?") == "+1.00000000E+00;1;1"
    assert bench.ask("TRIG:SOUR?;COUN?;DEL:AUTO?") == "IMM;+1;1"
    assert bench.ask("SAMP:SOUR?;COUN?;TIM?") == "IMM;+1;+1.00000000E+00"
    assert bench.ask("FORM?;FORM:BORD?;:DISP?;:DATA:POIN?") == "ASC,8;NORM;1;+0"


def test_operation_shows_measuring_and_waiting(bench):
    bench.stream("100 ms")
    assert bench.ask("STAT:OPER:COND?") == "+16"
    bench.tell("ABOR", "TRIG:SOUR BUS", "INIT")
    assert bench.ask("STAT:OPER:COND?") == "+32"


def test_the_memory_threshold_is_an_operation_event(bench):
    bench.stream("100 ms", "DATA:POIN:EVEN:THR 5")
    bench.ask("STAT:OPER?")
    bench.clock.advance(0.35)
    assert int(bench.ask("STAT:OPER?")) & 512 == 0
    bench.clock.advance(0.2)
    assert int(bench.ask("STAT:OPER?")) & 512
