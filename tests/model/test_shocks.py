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


def test_a_second_decay_shares_the_amplitude():
    only, shared = (
        contiguous_means(
            Shocks(rate_per_s=0.2, sd_V=1.0, decay_s=0.05, second_fraction=f, second_decay_s=0.5), 0.01, 900
        )
        for f in (0.0, 0.3)
    )
    second = contiguous_means(Shocks(rate_per_s=0.2, sd_V=1.0, decay_s=0.5), 0.01, 900)

    assert shared == pytest.approx(0.7 * only + 0.3 * second, abs=1e-14)


@pytest.mark.parametrize("aperture_s", [1e-3, 0.05])
def test_a_ring_down_is_a_damped_sine_from_each_shock_on(aperture_s):
    shocks = Shocks(rate_per_s=2.0, sd_V=1.0, ring_fraction=0.5, ring_hz=7.0, ring_decay_s=0.3)
    history = shocks.realise(np.random.default_rng(SEED))
    means = history.average(np.arange(100) * aperture_s * 2, aperture_s)
    rng = np.random.default_rng(SEED)  # the same shocks, and the sum of their shapes by many points
    time_s, amplitude_V = np.cumsum(rng.exponential(0.5, 64)), rng.normal(0.0, 1.0, 64)
    points_s = (np.arange(100) * aperture_s * 2)[:, None] + aperture_s * (np.arange(2000) + 0.5) / 2000
    expected = np.zeros(100)
    for at_s, amplitude in zip(time_s, amplitude_V, strict=True):
        since_s = points_s - at_s
        shape = 0.5 * np.exp(-since_s / 0.3) * np.sin(2 * np.pi * 7 * since_s)
        expected += amplitude * np.where(since_s >= 0, shape, 0).mean(axis=1)
        expected += amplitude * ((since_s[:, 0] < 0) & (since_s[:, -1] >= 0))  # the shock itself, which has no decay

    assert means == pytest.approx(expected, abs=2e-3)


def test_the_sign_of_shocks_may_be_preferred():
    means = contiguous_means(Shocks(rate_per_s=5.0, sd_V=1.0, positive_fraction=0.9), 1e-3, 400_000)
    struck = means[means != 0]

    assert np.mean(struck > 0) == pytest.approx(0.9, abs=5 * 0.3 / sqrt(struck.size))
    assert np.mean(struck**2) == pytest.approx(1.0, rel=5 * sqrt(2 / struck.size) + 5e-3)  # few apertures hold two


def test_after_shocks_follow_and_cluster():
    means = contiguous_means(Shocks(rate_per_s=1.0, sd_V=1.0, after_shocks=2.0, after_s=0.05), 1e-3, 1_000_000)
    waits_s = np.diff(np.flatnonzero(means)) * 1e-3

    assert np.count_nonzero(means) == pytest.approx(3 * 1000, rel=0.1)
    assert np.mean(waits_s < 0.05) > 0.5  # a Poisson process of this rate would have 1 - e^-0.15 = 14 %
