"""What a scan found has an interval of its own: the middle 95 % of what the readings leave it, by their densities."""

import numpy as np
import pytest
from scipy.stats import norm

from aemd.diagnose.fit import Fit, residuals
from aemd.diagnose.hypothesis import Base, Term, base_box, make_data
from aemd.diagnose.intervals import covariance, describe
from aemd.diagnose.terms.events import PeriodicGlitch
from aemd.diagnose.terms.noise import ChangingNoise
from aemd.diagnose.terms.ranges import RangeOverlap
from aemd.diagnose.terms.shapes import Step
from tests.diagnose.plant import INTERVAL_S, series, times

N = 600


def white_fit(y: np.ndarray, term: Term, own: list[float]) -> Fit:
    """A base that is white noise of deviation 1 about 0, and a term, whose sizes are in those deviations."""
    data = make_data(series(1e-3 * y, aperture_s=0.0))
    u = data.unit_V / 1e-3
    theta = np.array([np.log(INTERVAL_S), -12.0, np.log(5 * INTERVAL_S), -12.0, np.log(1 / u), -data.origin_V / 1e-3])
    theta[5] /= u
    still = tuple((value, value) for value in theta)
    assert len(still) == len(base_box(data))
    return residuals([Base(theta, shocks=False, box=still), term], np.concatenate((theta, own)), data)


def middle(log_odds: np.ndarray) -> tuple[int, int]:
    share = np.cumsum(np.exp(log_odds - log_odds.max()))
    low, high = np.searchsorted(share / share[-1], (0.025, 0.975))
    return int(low), int(high)


def test_the_beginning_of_a_louder_stretch_lies_where_the_readings_own_densities_leave_it():
    rng, t_s, ratio = np.random.default_rng(11), times(N), 1.5
    y = rng.standard_normal(N) * np.where((np.arange(N) >= 240) & (np.arange(N) < 420), ratio, 1.0)
    fit = white_fit(y, ChangingNoise(t_s[236], t_s[420], ratio, 0.0), [np.log(ratio)])

    told = describe(fit, 1, covariance(fit))

    louder = norm.logpdf(y, scale=ratio) - norm.logpdf(y)
    low, high = middle(np.cumsum(louder[:420][::-1])[::-1])
    assert told["time_s"].low == pytest.approx(t_s[low] - INTERVAL_S, abs=0.6 * INTERVAL_S)
    assert told["time_s"].high == pytest.approx(t_s[max(high, 236)], abs=0.6 * INTERVAL_S)
    assert told["dwell_s"].low < 180 * INTERVAL_S < told["dwell_s"].high


def test_the_instant_of_a_step_lies_where_least_squares_leave_it():
    rng, t_s = np.random.default_rng(5), times(N)
    y = rng.standard_normal(N) + 0.8 * (np.arange(N) >= 350)
    fit = white_fit(y, Step(t_s[351], 0.8, 0.0), [0.8 / (make_data(series(1e-3 * y)).unit_V / 1e-3)])

    told = describe(fit, 1, covariance(fit))["time_s"]

    def explained(at: int) -> float:
        before, behind = y[:at], y[at:]
        apart = behind.mean() - before.mean()
        return 0.5 * apart**2 / (1 / before.size + 1 / behind.size)

    low, high = middle(np.array([-np.inf, *(explained(at) for at in range(1, N))]))
    assert told.low == pytest.approx(t_s[low] - INTERVAL_S, abs=2.1 * INTERVAL_S)
    assert told.high == pytest.approx(t_s[high], abs=2.1 * INTERVAL_S)
    assert high - low > 5  # a step of 0.8 deviations is not told to a reading


def test_a_pulse_that_comes_again_has_its_period_to_a_reading_in_all_its_turns():
    rng, t_s, period_s, begin_s, width_s = np.random.default_rng(3), times(N), 4.0, 1.3, 0.25
    y = rng.standard_normal(N) + 3.0 * ((t_s - begin_s) % period_s < width_s)
    fit = white_fit(y, PeriodicGlitch(period_s + 0.003, begin_s - 0.02, width_s, 3.0, 0.0), [3.0])

    told = describe(fit, 1, covariance(fit))

    turns = t_s[-1] / period_s
    for name, truth in (("period_s", period_s), ("time_s", begin_s), ("dwell_s", width_s)):
        assert told[name].low <= truth <= told[name].high
    assert INTERVAL_S / turns < told["period_s"].high - told["period_s"].low < 6 * INTERVAL_S / turns
    assert 1.99 * INTERVAL_S < told["time_s"].high - told["time_s"].low < 5 * INTERVAL_S
    assert told["period_readings"].high == pytest.approx(told["period_s"].high / INTERVAL_S)


def test_the_offset_of_a_range_whose_readings_overlap_with_the_others_is_within_its_interval():
    held, offset = 0, 0.8
    for seed in range(20):
        x = np.random.default_rng(seed).standard_normal(N)
        y = np.where(x >= 0.5, x - offset, x)
        data = make_data(series(1e-3 * y, aperture_s=0.0))
        # The edges as a scan finds them, not quite those that are.
        low, high = ((1e-3 * edge - data.origin_V) / data.unit_V for edge in (0.5 - offset + 0.08, 0.5 - 0.08))
        fit = white_fit(y, RangeOverlap(low, high, True, (1e-3 / data.unit_V) ** 2, 0.0), [])
        told = describe(fit, 1, covariance(fit))["offset_V"]
        held += told.low <= -1e-3 * offset <= told.high

    assert held >= 16  # of 20; 19 are due, fewer than 16 in one of 390
