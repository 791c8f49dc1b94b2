"""What is laid after the shocks: marks by their odds, and the power of a damped wave by plain regression."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2, norm

from aemd.diagnose.checks.rings import _log_ratios, _loud, _ring_power, check_ring_down, likely_marks
from aemd.diagnose.fit import fit_base
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.terms.events import rung
from tests.diagnose.plant import INTERVAL_S, clean, series, times


def struck(seed, ratio):
    """Return a fit of readings with 30 shocks, most of them small, that ring at 2.3 Hz with a ratio to their size."""
    rng = np.random.default_rng([seed, 5])
    y = clean(seed)
    at = np.sort(rng.choice(y.size - 100, 30, replace=False))
    marks = np.bincount(at, 6e-3 * rng.standard_normal(30), y.size)
    y += lfilter([1], [1, -np.exp(-INTERVAL_S / 0.2)], marks)
    y += ratio * rung(marks, np.full(y.size, INTERVAL_S), 2.3, 1.5).imag
    return fit_base(make_data(series(y)))


def test_a_waves_power_is_what_regression_on_its_quadratures_takes_of_the_residuals():
    rng = np.random.default_rng(2)
    n = 400
    marks, z, weight = np.where(rng.random(n) < 0.03, 5.0, 0.0), rng.standard_normal(n), rng.uniform(0.5, 2, n)
    step_s = np.where(rng.random(n) < 0.1, 0.2, 0.1)
    wave = rung(marks, step_s, 1.7, 0.9)
    columns = np.column_stack((wave.real, wave.imag)) * weight[:, None]
    taken = columns @ np.linalg.lstsq(columns, z, rcond=None)[0]

    assert _ring_power(marks, step_s, weight, z, 1.7, 0.9) == pytest.approx(float(taken @ taken), rel=1e-6)


def test_a_mark_is_the_mean_of_what_may_have_struck():
    fit = struck(1, 0.0)
    marks = likely_marks(fit)
    jumps = np.linspace(-200, 200, 40_001)  # V over the unit of the fit
    rate_per_s, jump_sd = np.exp(fit.theta[6]), np.exp(fit.theta[7])
    for k in (*np.argsort(-np.abs(marks))[[0, 5, 25, 60]], 700):
        odds = -np.expm1(-rate_per_s * fit.data.step_s[k])
        sd = np.sqrt(fit.variance[k])
        alone = (1 - odds) * norm.pdf(fit.innovation[k], scale=sd)
        each = odds * norm.pdf(jumps, scale=jump_sd) * norm.pdf(fit.innovation[k] - jumps, scale=sd)
        mean = np.sum(jumps * each) / (np.sum(each) + alone / (jumps[1] - jumps[0]))

        assert marks[k] == pytest.approx(mean, rel=1e-3, abs=1e-9)


def test_shocks_too_small_to_be_sure_of_tell_of_a_ring_together():
    (evidence,) = check_ring_down(struck(1, 0.12))

    assert evidence.p_value < 1e-5
    assert any(abs(term.frequency_hz - 2.3) < 0.15 for term in evidence.terms)


@pytest.fixture(scope="module")
def struck_between():
    """A fit of readings with 12 shocks at any time between two, that ring by two fifths of a turn a reading."""
    ratio, rng = 0.07, np.random.default_rng([4, 6])
    y, t_s = clean(4), times()
    for at_s in np.sort(rng.uniform(5.0, t_s[-1] - 5.0, 12)):
        since = np.maximum(t_s - at_s, 0.0)
        size = 12e-3 * rng.choice([-1.0, 1.0]) * (t_s >= at_s)
        y += size * np.exp(-since / 0.1)
        y += size * ratio * np.exp(-since / 1.2) * np.sin(2 * np.pi * 0.41 / INTERVAL_S * since)
    return fit_base(make_data(series(y)))


def test_a_ring_too_fast_for_one_angle_is_heard_with_the_instants_integrated_out(struck_between):
    (evidence,) = check_ring_down(struck_between)

    assert evidence.p_value < 1e-6
    assert chi2.sf(evidence.observed, 2) > 1e-7  # of one angle, before any of some hundred trials is counted
    assert any(abs(term.frequency_hz * INTERVAL_S - 0.41) < 0.01 for term in evidence.terms)


def test_a_ratio_of_likelihoods_is_that_of_normal_residuals_with_and_without_the_wave(struck_between):
    """Of one shock, for each of its instants, sizes of the ring, and two angles, one after another."""
    fit = struck_between
    data, loud, hz, decay_s = fit.data, _loud(fit), 2.9, 0.4
    one = replace(loud, **{name: getattr(loud, name)[:1] for name in loud.__slots__})
    (k,), odds = one.at, one.probability[0]
    heard = (np.arange(data.y.size) >= k) & (data.t_s <= data.t_s[k - 1] + 4 * decay_s)
    ratios = []
    for angle in (1, 1j):
        for ratio in np.outer([1, -1], np.geomspace(0.02, 2.0, 10)).ravel():
            mean = 0.0
            for before_s, size, weight in zip(one.before_s[0], one.amplitude[0], np.exp(one.weight[0]), strict=True):
                since = data.t_s - data.t_s[k - 1] + before_s
                wave = (angle * np.exp((-1 / decay_s + 2j * np.pi * hz) * since)).imag
                left = np.where(
                    heard, fit.whitened(np.where(np.arange(since.size) >= k, ratio * size * wave, 0.0)), 0.0
                )
                mean += weight * np.exp(np.sum(norm.logpdf(fit.z - left) - norm.logpdf(fit.z)))
            ratios.append(1 - odds + odds * mean)

    assert len(loud.at) >= 8
    assert np.sum(np.exp(one.weight)) == pytest.approx(1.0)
    assert _log_ratios(fit, one, np.array([hz]), decay_s) == pytest.approx([np.log(np.mean(ratios))], rel=1e-6)


@pytest.mark.parametrize("seed", [2, 3])
def test_shocks_that_set_off_nothing_ring_in_nobodys_ears(seed):
    (evidence,) = check_ring_down(struck(seed, 0.0))

    assert evidence.p_value > 0.01
