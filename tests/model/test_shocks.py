from math import exp, sqrt

import numpy as np
import pytest

from aemd.model import Shocks

SEED = 7


def contiguous_means(shocks, aperture_s, n, seed=SEED):
    return shocks.realise(np.random.default_rng(seed)).average(np.arange(n) * aperture_s, aperture_s)


@pytest.mark.parametrize("decay_s", [0.0, 1.2e-5, 0.01, 0.5])
def test_long_apertures_see_the_mean_of_the_short_ones_inside(decay_s):
    shocks = Shocks(rate_per_s=3.0, sd_V=0.02, decay_s=decay_s)
    short = contiguous_means(shocks, 0.01, 20_000)
    long = contiguous_means(shocks, 0.1, 2_000)
    of_short = short.reshape(-1, 10)

    expected = of_short.sum(axis=1) if decay_s == 0 else of_short.mean(axis=1)  # at 0 the amplitude is the reading's

    assert long == pytest.approx(expected, abs=1e-13)


def test_between_shocks_readings_fall_by_the_decay_of_one_aperture():
    means = contiguous_means(Shocks(rate_per_s=0.2, sd_V=1.0, decay_s=0.05), 0.01, 20_000)
    ratios = means[1:][means[:-1] != 0] / means[:-1][means[:-1] != 0]

    assert np.median(ratios) == pytest.approx(exp(-0.01 / 0.05), rel=1e-9)


def test_shocks_without_decay_strike_as_often_and_as_hard_as_they_should():
    rate_per_s, sd_V, aperture_s, n = 0.5, 0.03, 0.02, 400_000
    means = contiguous_means(Shocks(rate_per_s=rate_per_s, sd_V=sd_V), aperture_s, n)
    struck = means[means != 0]
    expected = n * (1 - exp(-rate_per_s * aperture_s))

    assert struck.size == pytest.approx(expected, abs=5 * sqrt(expected))
    assert means @ means == pytest.approx(rate_per_s * aperture_s * n * sd_V**2, rel=5 * sqrt(3 / expected))


def test_decaying_shocks_have_the_variance_of_filtered_shot_noise():
    # Campbell: autocovariance rate sd^2 decay/2 e^(-|t|/decay), averaged over an aperture h as any exponential one is.
    rate_per_s, sd_V, decay_s, aperture_s, n = 20.0, 0.01, 0.05, 0.02, 400_000
    a = aperture_s / decay_s
    variance = rate_per_s * sd_V**2 * decay_s / 2 * 2 * (a - 1 + exp(-a)) / a**2
    means = contiguous_means(Shocks(rate_per_s=rate_per_s, sd_V=sd_V, decay_s=decay_s), aperture_s, n)

    assert means.var() == pytest.approx(variance, rel=5 * sqrt(20 * decay_s / aperture_s / n))


def test_a_shock_between_two_apertures_leaves_only_its_tail():
    shocks = Shocks(rate_per_s=50.0, sd_V=1.0)
    start_s = np.arange(1000) * 1.0

    means = shocks.realise(np.random.default_rng(SEED)).average(start_s, 1e-4)

    assert np.count_nonzero(means) < 30  # 5 expected of 50,000 shocks
