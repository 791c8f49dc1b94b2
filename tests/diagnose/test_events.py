"""What comes and goes: the telegraph's likelihood against every path, folding against plain sums, rings, holes."""

from itertools import pairwise, product

import allantools
import numpy as np
import pytest
from scipy.signal import lfilter

from aemd.diagnose.checks.folding import _fold
from aemd.diagnose.checks.ranges import check_hole
from aemd.diagnose.checks.shocks import check_shock_law
from aemd.diagnose.fit import fit_base
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.kernels import MARKOV, follow_telegraph
from aemd.diagnose.steadiness import allan_deviation
from aemd.diagnose.terms.events import rung
from aemd.diagnose.terms.witnessed import unit_of
from tests.diagnose.plant import INTERVAL_S, clean, series


def test_the_telegraphs_likelihood_is_the_sum_over_every_path():
    rng = np.random.default_rng(1)
    n, step, low_s, high_s, noise = 9, 1.5, 4.0, 7.0, 0.3
    y = rng.standard_normal(n)
    still = np.array([[MARKOV, 1.0, 0.0, 0.0, 0.0, 1.0]])  # a state that is 0: white noise alone
    each, *_ = follow_telegraph(
        np.array([step, low_s, high_s]),
        y,
        np.ones(n, bool),
        np.ones(n),
        np.zeros(n),
        np.full(n, noise),
        np.ones(n),
        still,
    )
    up, down = 1 - np.exp(-1 / low_s), 1 - np.exp(-1 / high_s)
    odds = np.array([[1 - up, up], [down, 1 - down]])
    total = 0.0
    for path in product((0, 1), repeat=n):
        chance = (low_s, high_s)[path[0]] / (low_s + high_s)
        for before, after in pairwise(path):
            chance *= odds[before, after]
        total += chance * np.prod(np.exp(-0.5 * (y - step * np.array(path)) ** 2 / noise) / np.sqrt(2 * np.pi * noise))

    assert each.sum() == pytest.approx(np.log(total), rel=1e-10)


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
