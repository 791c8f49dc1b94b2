"""Findings are judged by records drawn from the fit: a law that is wrong there is corrected, one that holds is not."""

from dataclasses import replace
from functools import cache
from math import erfc, sqrt

import numpy as np
import pytest
from scipy.signal import lfilter

from aemd.diagnose.climb import climb
from aemd.diagnose.evidence import Evidence
from aemd.diagnose.fit import Fit, fit_base, residuals
from aemd.diagnose.hypothesis import Base, make_data
from aemd.diagnose.rebased import rebased
from aemd.diagnose.redrawn import Redrawn, _smoothed, draw, judged_by
from aemd.diagnose.terms.noise import ChangingNoise, Resonance, Smoothing
from tests.diagnose.plant import INTERVAL_S, clean, series, times

N = 1_500


@cache
def fitted(seed: int = 1, n: int = N, aperture_s: float = 0.02) -> Fit:
    """Return the base fitted to a clean record, of which a part is lost."""
    lost = np.random.default_rng(seed).random(n) < 0.05
    values = np.where(lost, np.nan, clean(seed, n))
    return fit_base(make_data(series(values, aperture_s=aperture_s)))


def scored(times_too_large: float):
    """Return a check whose statistic is normal, that many times as large as it is taken to be."""
    pattern = np.random.default_rng(3).standard_normal(N)

    def check(fit: Fit) -> list[Evidence]:
        score = times_too_large * float(pattern @ fit.z) / sqrt(float(np.sum(pattern[fit.data.used] ** 2)))
        return [Evidence("score", erfc(abs(score) / sqrt(2)), score, -2.0, 2.0)]

    return check


def test_of_a_check_whose_statistic_is_twice_what_it_is_taken_for_the_p_value_is_corrected():
    """Five deviations are two and a half: 1.2 % and not 6e-7; as 32 draws tell it, between a fifth and 5 times that."""
    found = Evidence("score", erfc(5 / sqrt(2)), 5.0, -2.0, 2.0)

    corrected = Redrawn(fitted()).corrected(found, scored(2.0))

    assert 0.0025 < corrected.p_value < 0.07


def test_of_a_check_whose_law_is_right_no_digit_of_the_p_value_changes():
    found = Evidence("score", erfc(5 / sqrt(2)), 5.0, -2.0, 2.0)

    assert Redrawn(fitted()).corrected(found, scored(1.0)) == found


def test_a_law_that_is_sure_of_far_less_than_it_might_be_is_left_alone_after_two_draws():
    """Each may cost seconds; of a right law two draws are as little surprised in one case of fifty."""
    found, asked = Evidence("score", erfc(5 / sqrt(2)), 5.0, -2.0, 2.0), list[Fit]()

    def hardly(fit: Fit) -> list[Evidence]:
        asked.append(fit)
        return [replace(found, p_value=0.99)]

    assert Redrawn(fitted()).corrected(found, hardly) == found
    assert len(asked) == 2


@pytest.mark.parametrize("count", [4, 32])
def test_what_one_more_draw_exceeds_has_the_probability_that_is_said_of_it(count):
    rng = np.random.default_rng(1)
    drawn, more = 1.7 * rng.exponential(size=(20_000, count)), 1.7 * rng.exponential(size=20_000)
    said = np.array([judged_by(*pair) for pair in zip(drawn, more, strict=True)])

    assert np.mean(said < 0.01) == pytest.approx(0.01, abs=4 * sqrt(0.01 / 20_000))


@pytest.mark.parametrize(
    ("aperture_s", "term"),
    [
        (0.0, None),
        (0.9 * INTERVAL_S, None),
        (0.9 * INTERVAL_S, Smoothing(0.6, 0.0)),
        (0.0, ChangingNoise(20.0, 60.0, 3.0, 0.0)),
        (0.9 * INTERVAL_S, Resonance(3.0, 2.0, 10.0, 2.0, 0.0)),
    ],
)
def test_what_is_drawn_from_a_fit_leaves_white_residuals_there(aperture_s, term):
    """Of 1,425 residuals variance and neighbours' correlation are 1 +- 0.04 and 0 +- 0.03."""
    base = fitted(aperture_s=aperture_s)
    if aperture_s:  # a process as fast as the aperture, which averages more of it than there is white noise
        base = residuals(base.terms, np.r_[-3.0, 2.0, base.theta[2:4], -3.0, base.theta[5:]], base.data)
    fit = base if term is None else residuals([*base.terms, term], np.r_[base.theta, term.start], base.data)
    drawn = draw(fit, 0)
    z = residuals(fit.terms, fit.theta, drawn).z[drawn.used]

    assert np.mean(z**2) == pytest.approx(1.0, abs=0.15)
    assert np.mean(z[1:] * z[:-1]) == pytest.approx(0.0, abs=0.11)
    assert (drawn.y == draw(fit, 0).y).all()
    assert not (drawn.y == draw(fit, 1).y)[drawn.used].any()


def test_over_a_gap_a_smoothing_goes_on_as_if_each_lost_reading_had_been_what_the_next_is():
    rng, kept = np.random.default_rng(11), 0.7
    y, lost = rng.standard_normal(300), rng.random(300) < 0.4
    lost[[0, -1]] = False
    data = make_data(series(np.where(lost, np.nan, y)))
    following = y[~lost][np.cumsum(~lost) - ~lost]

    expected = lfilter([1 - kept], [1, -kept], following, zi=[kept * y[0]])[0]

    np.testing.assert_allclose(_smoothed(y, data, kept)[~lost], expected[~lost], rtol=0, atol=1e-12)


@pytest.mark.parametrize("decay_s", [0.02, 0.5])
def test_shocks_are_drawn_at_any_time_and_averaged_over_apertures(decay_s):
    """Campbell: the mean over apertures T of decaying shocks A at a rate r has the variance r A^2 d/2 times
    2 (a - 1 + e^-a)/a^2, a = T/d; the base's size is that of what is left of a shock at the next reading."""
    n, aperture_s, per_s, size = 60_000, 0.04, 2.0, 1e4
    made = series(clean(1, n), time_s=times(n), aperture_s=aperture_s)
    data = make_data(made)
    theta = np.log([0.5, 1.0, 60.0, 0.1, 0.5, 1.0, per_s, size, decay_s])
    theta[5] = 0.0
    fit = residuals([Base(theta, shocks=True, box=((-50.0, 50.0),) * 9)], theta, data)
    left = (1 - np.exp(-2 * INTERVAL_S / decay_s)) * decay_s / (2 * INTERVAL_S)
    a = aperture_s / decay_s
    variance = per_s * size**2 / left * decay_s / 2 * 2 * (a - 1 + np.exp(-a)) / a**2

    drawn = [np.var(draw(fit, number).y) for number in range(3)]

    # The mean square of a Poisson number of squares of normal ones: 3 r t of fourth moments over (r t)^2.
    assert np.mean(drawn) == pytest.approx(variance, rel=5 * sqrt(3 / (per_s * 3 * n * INTERVAL_S)) + 0.02)


def test_what_cannot_be_drawn_is_left_as_it_is():
    fit = fitted()
    known = replace(fit.data, low=fit.data.y - 0.1, high=fit.data.y + 0.1)
    found = Evidence("score", 1e-6, 5.0, -2.0, 2.0)

    assert Redrawn(replace(fit, data=known)).corrected(found, scored(2.0)) == found


def test_a_base_that_lost_its_drift_is_given_it_back():
    """Where a process is not there the likelihood is flat in its time constant, and no climb finds it again."""
    data = make_data(series(clean(2)))
    best = fit_base(data)
    start = best.theta.copy()
    start[2:4] = np.log([0.3, 1e-7])
    theta, value = climb(best.terms, start, data)
    lost = residuals(best.terms, theta, data)

    others = rebased(lost, tails=False)

    assert value < best.log_likelihood - 3
    assert others[0].log_likelihood == pytest.approx(best.log_likelihood, abs=0.1)
