"""What comes and goes: the telegraph's likelihood against every path, folding against plain sums, rings, holes."""

from itertools import pairwise, product

import allantools
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import multivariate_normal, norm

from aemd.diagnose.checks.folding import _fold
from aemd.diagnose.checks.ranges import check_hole
from aemd.diagnose.checks.shocks import check_shock_law, coins_tail
from aemd.diagnose.checks.tails import gain_of_tails, tail_of_gain
from aemd.diagnose.checks.telegraph import check_popcorn
from aemd.diagnose.fit import fit_base
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.kernels import MARKOV, log_densities, telegraph_densities
from aemd.diagnose.steadiness import allan_deviation
from aemd.diagnose.terms.events import rung
from aemd.diagnose.terms.noise import HeavyTails
from aemd.diagnose.terms.witnessed import unit_of
from tests.diagnose.plant import INTERVAL_S, clean, markov, series


def telegraph_paths(n, low_s, high_s):
    """Every path of a level that jumps between 0 and 1, one reading a second, and its probability."""
    up, down = 1 - np.exp(-1 / low_s), 1 - np.exp(-1 / high_s)
    odds = np.array([[1 - up, up], [down, 1 - down]])
    for path in product((0, 1), repeat=n):
        chance = (low_s, high_s)[path[0]] / (low_s + high_s)
        for before, after in pairwise(path):
            chance *= odds[before, after]
        yield np.array(path), chance


def telegraph_nats(y, step, low_s, high_s, noise, states, shocks=(0.0, 0.0, -1.0)):
    n = y.size
    columns = np.ones(n), np.zeros(n), np.full(n, noise), np.ones(n)
    each = telegraph_densities(
        np.array([step, low_s, high_s]), y, np.ones(n, bool), *columns, np.array(states), np.array(shocks)
    )
    return each.sum()


def test_the_telegraphs_likelihood_is_the_sum_over_every_path():
    step, low_s, high_s, noise = 1.5, 4.0, 7.0, 0.3
    y = np.random.default_rng(1).standard_normal(9)
    total = sum(
        chance * np.prod(np.exp(-0.5 * (y - step * path) ** 2 / noise) / np.sqrt(2 * np.pi * noise))
        for path, chance in telegraph_paths(9, low_s, high_s)
    )
    still = [[MARKOV, 1.0, 0.0, 0.0, 0.0, 1.0]]  # a state that is 0: white noise alone

    assert telegraph_nats(y, step, low_s, high_s, noise, still) == pytest.approx(np.log(total), rel=1e-3)


def test_beside_a_process_that_follows_the_jumps_the_likelihood_is_still_that_of_every_path():
    """Of each path the readings are normal, with the process's covariance e^(-|i - j|/tau) beside the noise."""
    step, low_s, high_s, noise, tau_s = 2.0, 5.0, 5.0, 0.3, 8.0
    path = np.array([0, 0, 0, 1, 1, 1, 1, 0, 0, 0, 1, 1])
    y = step * path + 0.5 * np.random.default_rng(4).standard_normal(12)
    covariance = np.exp(-np.abs(np.subtract.outer(np.arange(12), np.arange(12))) / tau_s) + noise * np.eye(12)
    law = multivariate_normal(cov=covariance)
    total = sum(chance * law.pdf(y - step * levels) for levels, chance in telegraph_paths(12, low_s, high_s))
    process = [[MARKOV, tau_s, 0.0, np.sqrt(2 / tau_s), 1.0, 1.0]]

    assert telegraph_nats(y, step, low_s, high_s, noise, process) == pytest.approx(np.log(total), abs=0.03)


def test_a_shock_beside_the_telegraph_is_a_shock():
    """Shocks that fade at once are a second noise: each reading's density is a mixture of two."""
    step, low_s, high_s, noise, rate, size = 1.5, 4.0, 7.0, 0.3, 0.2, 36.0
    y = np.random.default_rng(2).standard_normal(9)
    y[5] += 7.0
    struck = np.concatenate(([0.0], np.full(8, 1 - np.exp(-rate))))  # none is left of what was before the first
    total = 0.0
    for path, chance in telegraph_paths(9, low_s, high_s):
        apart = y - step * path
        plain = norm.pdf(apart, scale=np.sqrt(noise))
        total += chance * np.prod((1 - struck) * plain + struck * norm.pdf(apart, scale=np.sqrt(noise + size)))
    at_once = [[MARKOV, 1e-6, 0.0, 0.0, 0.0, 1.0]]

    nats = telegraph_nats(y, step, low_s, high_s, noise, at_once, (rate, size, 0.0))
    assert nats == pytest.approx(np.log(total), rel=1e-3)


def test_beside_a_level_that_never_rises_shocks_are_followed_as_without_it():
    """Each shock fades over three readings, so what the filter makes of one shows in the readings after it."""
    rng = np.random.default_rng(6)
    n, noise, rate, size = 60, 0.3, 0.1, 36.0
    y = np.sqrt(noise) * rng.standard_normal(n)
    y[20:] += 7.0 * np.exp(-np.arange(40) / 3)
    fading = np.array([[MARKOV, 3.0, 0.0, 0.0, 0.0, 1.0]])
    shocks = np.array([rate, size, 0.0])
    columns = np.ones(n), np.zeros(n), np.full(n, noise), np.ones(n)
    without = log_densities(y, np.ones(n, bool), *columns, fading, shocks, np.zeros(6)).sum()

    assert telegraph_nats(y, 2.0, 1e15, 1.0, noise, fading, shocks) == pytest.approx(without, abs=1e-6)


def test_jumps_too_small_to_be_seen_one_by_one_are_found_where_a_fast_drift_stands_for_them():
    n, rng = 6000, np.random.default_rng(4)
    level = np.searchsorted(np.cumsum(rng.exponential(300, 60)), np.arange(n)) % 2
    y = 0.92 * rng.standard_normal(n) + 1.76 * level + markov(rng, n, 0.33, 0.79) + markov(rng, n, 480.0, 0.47)

    assert check_popcorn(fit_base(make_data(series(1e-3 * y)))).p_value < 1e-6


def test_jumps_far_larger_than_all_else_are_found_where_shocks_that_hardly_fade_stand_for_them():
    level = np.searchsorted(np.cumsum(np.random.default_rng(3).exponential(300, 60)), np.arange(3000)) % 2

    assert check_popcorn(fit_base(make_data(series(clean(12, 3000) + 7.5e-3 * level)))).p_value < 1e-9


def test_the_law_of_coins_is_the_count_of_their_sides():
    sizes = np.random.default_rng(7).uniform(0.2, 1.0, 12)
    sums = np.array([signs @ sizes for signs in product((-1, 1), repeat=12)])
    for observed in (4.0, 5.5, float(sizes.sum()) - 0.3):
        exact = np.mean(sums >= observed)
        assert coins_tail(sizes, observed) == pytest.approx(exact, rel=0.1)


def test_small_coins_add_a_normal_number():
    """A hundred coins of 0.01 beside ten of 1: what they add has a deviation of 0.1."""
    sizes = np.concatenate((np.ones(10), np.full(100, 0.01)))
    chance = 2.0**-10 * (1.0 + 10 * norm.sf(-8.0 + 9.9, scale=0.1)) * norm.cdf(0.1, scale=0.1)

    assert coins_tail(sizes, 9.9) == pytest.approx(chance, rel=0.1)


@pytest.mark.parametrize(("signs", "even"), [("one", False), ("both", True)])
def test_the_signs_of_sure_shocks_are_coins(signs, even):
    """Of 24 shocks with one sign p is 2 in 2^24; what noise blurs of them leaves most of its digits."""
    rng = np.random.default_rng(11)
    at = np.arange(24) * 160 + 60
    sizes = 0.02 * np.abs(rng.standard_normal(24)) + 0.01
    sizes *= 1.0 if signs == "one" else np.where(np.arange(24) % 2, 1.0, -1.0)
    jumps = np.zeros(4000)
    jumps[at] = sizes
    y = clean(11) + lfilter([1], [1, -np.exp(-INTERVAL_S / 0.3)], jumps)
    signs_of, _ = check_shock_law(fit_base(make_data(series(y))))

    if even:
        assert signs_of.p_value > 0.3
    else:
        assert 23 - 5 < -np.log2(signs_of.p_value) < 23 + 2


def test_of_three_shocks_no_law_is_told():
    jumps = np.zeros(4000)
    jumps[[600, 1800, 3100]] = 0.03
    y = clean(11) + lfilter([1], [1, -np.exp(-INTERVAL_S / 0.3)], jumps)

    assert all(item.p_value == 1.0 and not item.terms for item in check_shock_law(fit_base(make_data(series(y)))))


def test_tails_that_shocks_were_fitted_to_are_found_beside_them():
    """Of Student's law with three degrees, shocks that fade within a reading take what two normal laws can."""
    rng = np.random.default_rng(5)
    y = clean(5, 6000, white=0.0) + 1e-3 * rng.standard_t(3.0, 6000) / np.sqrt(3)
    fit = fit_base(make_data(series(y)))
    gain, tails = gain_of_tails(fit)

    assert fit.base.shocks
    assert tail_of_gain(gain) < 1e-4
    assert isinstance(tails, HeavyTails)


def test_tails_are_given_back_what_shocks_that_are_loud_and_slow_had_taken_beside_them():
    """One law of shocks for both is that of many faint ones that fade within a reading."""
    rng, n = np.random.default_rng(12), 3000
    y = clean(12, n, white=0.0, shocks_per_s=0.03, shock_sd=6.0, decay_s=0.6)
    fit = fit_base(make_data(series(y + 0.8e-3 * rng.standard_t(3.0, n) / np.sqrt(3))))
    gain, tails = gain_of_tails(fit)

    assert np.exp(fit.theta[8]) < 0.1
    assert gain > 30
    assert np.exp(tails.beside[8]) > 0.3


@pytest.mark.parametrize("shocks_per_s", [0.0, 0.05])
def test_a_normal_noise_has_no_tails(shocks_per_s):
    gain, _ = gain_of_tails(fit_base(make_data(series(clean(6, shocks_per_s=shocks_per_s)))))

    assert tail_of_gain(gain) > 0.01


def test_folding_finds_the_sum_over_a_train_that_no_whole_number_of_readings_separates():
    x = np.zeros(64 * 30)
    at = np.rint(np.arange(64) * (30 + 20 / 63) + 4).astype(int)
    x[at[at < x.size]] = 1.0
    best, shift, phase, rows = _fold(x, 30)

    assert (rows, phase) == (64, 4)
    assert best > 0.75 * np.count_nonzero(at < x.size)  # the tree rounds each level's shift to a whole reading
    assert 30 + shift / 63 == pytest.approx(30 + 20 / 63, abs=2 / 63)


def test_a_ring_is_the_sum_of_damped_waves_that_begin_after_their_marks():
    marks = np.zeros(60)
    marks[[5, 20]] = 1.0, -2.0
    wave = rung(marks, np.full(60, 0.1), 1.3, 0.8)
    pole = np.exp((-1 / 0.8 + 2j * np.pi * 1.3) * 0.1)

    np.testing.assert_allclose(wave, lfilter([0, pole], [1, -pole], marks), atol=1e-12)
    assert not wave[:6].any()


def test_shocks_in_pairs_are_no_poisson_process():
    rng = np.random.default_rng(3)
    y = clean(3)
    at = np.sort(rng.choice(3900, 20, replace=False))
    at = np.concatenate((at, at + 12))
    y += lfilter([1], [1, -np.exp(-INTERVAL_S / 0.3)], np.bincount(at, 0.03 * rng.choice([-1, 1], 40), y.size))
    _, close = check_shock_law(fit_base(make_data(series(y))))

    assert close.p_value < 1e-4
    assert close.check == "shocks that follow one another closely"


@pytest.mark.parametrize("seed", range(4))
def test_the_widest_gap_among_sound_readings_is_no_hole(seed):
    assert check_hole(fit_base(make_data(series(clean(seed))))).p_value > 1e-4


def test_the_allan_deviation_is_the_one_of_allantools():
    y = clean(5)
    (theirs,) = allantools.oadev(y, rate=1.0, data_type="freq", taus=[15.0])[1]

    assert allan_deviation(y, 15) == pytest.approx(theirs, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "unit"), [("temperature", "C"), ("humidity", "PERCENT"), ("supply", "V"), ("pressure_hPa", "HPA")]
)
def test_a_coefficients_unit_is_that_of_its_witness(name, unit):
    assert unit_of(name) == unit
