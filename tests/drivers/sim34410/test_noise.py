from math import sqrt

import numpy as np
import pytest

from aemd.model import Level
from sim34410.noise import noise_sd


@pytest.mark.parametrize(
    ("range_V", "nplc", "line_hz", "sd_V"),
    [
        (10, 0.006, 60, 60e-6),  # resolution 6 ppm
        (10, 0.2, 50, 7e-6),
        (10, 1, 50, 3e-6),
        (10, 100, 50, 0.3e-6),
        (0.1, 0.006, 50, 60e-6),  # adder 0.0600 %
        (0.1, 1, 50, 1e-6),
        (1, 0.02, 60, 30e-6),  # adder 0.0030 %
        (1, 10, 50, 0.1e-6),  # no adder: resolution 0.1 ppm
        (1000, 2, 50, 200e-6),
    ],
)
def test_readings_scatter_as_the_data_sheet_says(make_bench, range_V, nplc, line_hz, sd_V):
    bench, n = make_bench(Level(level_V=0.0), line_frequency_hz=line_hz), 20_000
    bench.tell(
        f"CONF:VOLT:DC {range_V}", f"VOLT:NPLC {nplc};ZERO:AUTO ON", f"TRIG:DEL 0;:SAMP:COUN {n};SOUR IMM", "INIT"
    )
    bench.clock.advance(3 * n * nplc / line_hz)
    readings_V = bench.meter.truth["value_V"]

    assert readings_V.size == n
    assert readings_V.std() == pytest.approx(sqrt(2) * sd_V, rel=5 / sqrt(2 * n))  # autozero subtracts a second one
    assert readings_V.mean() == pytest.approx(0.0, abs=5 * sqrt(2) * sd_V / sqrt(n))


def test_between_the_rows_of_the_table_noise_is_geometric():
    between = noise_sd(sqrt(0.02 * 0.06), autozero=False)
    above, below = noise_sd(0.02, autozero=False), noise_sd(0.06, autozero=False)

    assert np.array(between) == pytest.approx(np.sqrt(np.array(above) * np.array(below)))


def test_a_change_of_the_measurement_takes_a_new_zero(make_bench):
    bench = make_bench(Level(level_V=0.0))
    bench.stream("1", "VOLT:NPLC 100")
    while not bench.meter.memory.last_V or abs(bench.meter.memory.last_V) < 4e-6:  # far beyond 0.3 uV of noise
        bench.clock.advance(60)
        bench.meter.advance()
    bench.tell("VOLT:IMP:AUTO ON", "INIT")
    bench.clock.advance(2.5)

    assert abs(bench.meter.truth["value_V"][-1]) < 5 * 0.3e-6


def test_autozero_off_lets_the_offset_wander_and_a_new_zero_ends_it(make_bench):
    bench = make_bench(Level(level_V=0.0))
    bench.stream("1", "VOLT:NPLC 100")
    bench.clock.advance(7200)
    wandered_V = np.std(bench.meter.truth["value_V"])
    bench.tell("ABOR", "VOLT:ZERO:AUTO ONCE", "INIT")
    bench.clock.advance(2.5)

    # 0.3 uV of noise alone; 5 uV of an offset with a time constant of an hour in two hours
    assert 1e-6 < wandered_V < 20e-6
    assert abs(bench.meter.truth["value_V"][-1]) < 5 * 0.3e-6
    assert bench.ask("VOLT:ZERO:AUTO?") == "0"
