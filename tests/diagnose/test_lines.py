"""What stands beside a line: harmonics that are there, none that chance has made, and an even interval."""

import numpy as np
import pytest

from aemd.diagnose.checks.shapes import check_pattern
from aemd.diagnose.checks.spectrum import check_lines, make_periodogram
from aemd.diagnose.fit import Fit, residuals
from aemd.diagnose.hypothesis import Base, base_box, make_data
from aemd.diagnose.intervals import covariance, describe
from aemd.diagnose.terms.lines import Sines
from tests.diagnose.plant import series


def without_lines(value: np.ndarray, rate_hz: float) -> Fit:
    """The residuals of white noise of deviation 1 alone, whatever else there is."""
    made = series(value, interval_s=1 / rate_hz, time_s=np.arange(value.size) / rate_hz)
    data = make_data(made)
    level = np.log(1 / data.unit_V)
    theta = np.array([np.log(data.interval_s), -12.0, np.log(5 * data.interval_s), -12.0, level, 0.0])
    return residuals([Base(theta, shocks=False, box=base_box(data))], theta, data)


def hum(seed: int, n: int, rate_hz: float, nats: float, *hertz: float) -> np.ndarray:
    """White noise of deviation 1, and sines of A^2 n / 4 nats each."""
    rng, t_s = np.random.default_rng(seed), np.arange(n) / rate_hz
    value = rng.standard_normal(n)
    for frequency_hz in hertz:
        value += np.sqrt(4 * nats / n) * np.sin(2 * np.pi * frequency_hz * t_s + rng.uniform(0, 2 * np.pi))
    return value


def mains_of(fit: Fit) -> Sines:
    """The mains that the check proposes."""
    found = check_lines(fit, make_periodogram(fit), None).terms
    (mains,) = (term for term in found if isinstance(term, Sines) and term.cause == "mains_alias")
    return mains


def test_fast_readings_show_harmonics_of_the_mains_far_above_the_seventh():
    mains = mains_of(without_lines(hum(1, 8_000, 1_706.0, 60.0, 60.0, 180.0, 480.0, 600.0), 1_706.0))

    assert sorted(mains.harmonics) == [1, 3, 8, 10]
    assert mains.frequency_hz == pytest.approx(60.0, abs=0.05)


def test_a_peak_that_chance_makes_gives_the_hum_no_harmonic():
    """Each brings two amplitudes, which cost log n = 8.7 nats; of six places one exceeds that in 4 records of 1,000."""
    combs = [mains_of(without_lines(hum(seed, 6_000, 14.9, 40.0, 50.0), 14.9)).harmonics for seed in range(40)]

    assert set(combs) == {(1,)}


def test_the_interval_of_an_amplitude_reaches_as_far_up_as_down():
    """a and b are even about their values, and so is sqrt(a^2 + b^2) where it is many deviations long."""
    fit = without_lines(hum(3, 3_000, 14.9, 25.0, 4.0), 14.9)
    line = next(term for term in check_lines(fit, make_periodogram(fit), None).terms)
    both = residuals([*fit.terms, line], np.concatenate((fit.theta, line.start)), fit.data)

    told = describe(both, 1, covariance(both))["amplitude_V"]

    # The deviation of an amplitude in white noise is sqrt(2 / n).
    assert told.high - told.value == pytest.approx(told.value - told.low, rel=1e-9)
    assert told.high - told.low == pytest.approx(2 * 1.96 * np.sqrt(2 / 3_000), rel=0.1)


def test_the_sides_of_a_strong_line_are_no_harmonics_of_it_that_fold_beside_it():
    """At 15 readings/s all harmonics of 49.995 Hz fold to within 0.03 Hz of 0 and 5 Hz, three frequencies of 100 s."""
    combs = [mains_of(without_lines(hum(seed, 1_500, 15.0, 37.0, 49.995), 15.0)).harmonics for seed in range(20)]

    assert set(combs) == {(1,)}


def test_what_alternates_from_reading_to_reading_is_a_pattern_of_two_and_no_line_without_a_second_amplitude():
    value = hum(4, 3_000, 15.0, 0.0) + 0.15 * np.where(np.arange(3_000) % 2, 1.0, -1.0)
    fit = without_lines(value, 15.0)
    (pattern,) = check_pattern(fit).terms
    line = next(term for term in check_lines(fit, make_periodogram(fit), None).terms)
    frequencies_hz = line.frequency_hz + np.array(line.bounds[0]) / fit.data.span_s

    assert pattern.period == 2
    assert frequencies_hz.max() == pytest.approx(7.5 - 0.5 / fit.data.span_s)
