"""What a term adds to the likelihood, where its score at nothing sees too little."""

from math import erfc, sqrt

import numpy as np
import pytest
from scipy.signal import lfilter

from aemd.diagnose.checks.colour import gain_of_smoothing
from aemd.diagnose.checks.gains import tail_of_one
from aemd.diagnose.checks.moments import check_moments, gain_of_bend, gain_of_growth, tail_of_growth
from aemd.diagnose.fit import fit_base, residuals
from aemd.diagnose.given import Given
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.terms.noise import SignalDependentNoise
from aemd.diagnose.terms.ranges import RangeSwitching
from aemd.diagnose.terms.shapes import Nonlinearity
from aemd.model import Level, Model, WhiteNoise
from aemd.model import RangeSwitching as StatedRanges
from tests.diagnose.plant import clean, markov, series

NOTHING = Nonlinearity(0.0, 0.0)


def smoothed(y, kept):
    return lfilter([1 - kept], [1, -kept], y, zi=[kept * y[0]])[0]


@pytest.mark.parametrize(("seed", "kept"), [(2, 0.5), (3, 0.85)])
def test_a_smoothing_is_seen_be_it_middling_or_strong(seed, kept):
    gain = gain_of_smoothing(fit_base(make_data(series(smoothed(clean(seed), kept)))))

    assert tail_of_one(gain) < 1e-4


def test_a_bend_shows_in_what_is_fast_and_in_the_noise_too():
    """y = x + b x^2 is no Gaussian process; of white x of variance s^2 its skewness 6 b s alone is worth
    3 n b^2 s^2 nats, of which the mean's part, b^2 s^2, and the slope's, twice as much, are both there to be seen."""
    n, b = 3000, 0.05
    x = np.random.default_rng(4).standard_normal(n)
    fit = fit_base(make_data(series(1.0 + 1e-3 * (x + b * x**2))))

    assert not fit.base.shocks
    assert gain_of_bend(fit, NOTHING) == pytest.approx(3 * n * b**2, abs=3 * np.sqrt(2 * 3 * n * b**2))


def test_shocks_too_few_for_a_sum_show_a_bend():
    """40 shocks of 8 deviations, bent by b = 0.02: each decay is off by b (8 e^-t)^2, some deviations of the noise."""
    y = 1e3 * (clean(7, shocks_per_s=0.15) - 1.0)
    fit = fit_base(make_data(series(1.0 + 1e-3 * (y + 0.02 * y**2))))

    assert tail_of_one(gain_of_bend(fit, NOTHING)) < 1e-6


@pytest.mark.parametrize("loud", [0.15, 0.45])
def test_a_gain_that_flickers_is_climbed_to_from_too_loud_a_start_too(loud):
    y = 1e3 * (clean(9) - 1.0) + 4.0
    fit = fit_base(make_data(series(1e-3 * y * (1 + 0.15 * np.random.default_rng(9).standard_normal(y.size)))))

    assert tail_of_growth(gain_of_growth(fit, SignalDependentNoise(loud, 0.0))) < 1e-4


def test_a_gain_that_flickers_on_a_fast_input_is_seen_by_the_skewness_of_readings():
    """Its variance follows what nobody can predict: the readings before a reading tell of it next to nothing."""
    rng, n = np.random.default_rng(1), 3000
    y = (4.0 + markov(rng, n, 0.12, 1.0)) * (1 + 0.3 * rng.standard_normal(n))
    fit = fit_base(make_data(series(1e-3 * y)))

    assert tail_of_growth(gain_of_growth(fit, SignalDependentNoise(0.1, 0.0))) < 1e-6


@pytest.mark.parametrize(("seed", "shocks_per_s"), [(21, 0.0), (23, 0.05)])
def test_a_record_without_them_gains_little(seed, shocks_per_s):
    fit = fit_base(make_data(series(clean(seed, shocks_per_s=shocks_per_s))))

    assert tail_of_one(gain_of_smoothing(fit)) > 0.01
    assert tail_of_one(gain_of_bend(fit, NOTHING)) > 0.01
    assert tail_of_growth(gain_of_growth(fit, SignalDependentNoise(1e-3, 0.0))) > 0.01


@pytest.mark.parametrize("ranges", ["none", "found", "stated"])
def test_a_bend_is_told_by_its_score_where_ranges_switch(ranges):
    """It would move readings across the switch, and gain by each as no normal law has it."""
    data = make_data(series(1.0 + 1e-3 * np.random.default_rng(5).standard_normal(500)))
    fit = fit_base(data)
    if ranges == "found":
        term = RangeSwitching(1.0 / data.unit_V, 0.0, 0.1, 0.1, 0.0)
        fit = residuals([*fit.terms, term], np.append(fit.theta, term.start), data)
    elif ranges == "stated":
        white = WhiteNoise.from_sd(1e-3, 0.02)
        stated = Given(Model((Level(level_V=1.0), white), 1, (StatedRanges(threshold_V=1.0, offset_V=1e-4),)))
        fit = residuals([stated], np.empty(0), data)

    (told,) = (item for item in check_moments(fit) if "bent scale" in item.check)

    if ranges == "none":
        assert told.check.endswith("nats gained by the bend")
    else:
        assert told.check.endswith("score in deviations")
        assert told.p_value == pytest.approx(erfc(abs(told.observed) / sqrt(2)))
