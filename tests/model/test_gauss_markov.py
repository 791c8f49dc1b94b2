from math import exp, inf, sqrt

import numpy as np
import pytest
from scipy.integrate import quad

from aemd.model import GaussMarkov
from aemd.model.gauss_markov import _faded, _integral_variance

SEED = 20190429
N = 200_000


def contiguous_means(process, aperture_s, n=N, seed=SEED):
    return process.realise(np.random.default_rng(seed)).average(np.arange(n) * aperture_s, aperture_s)


@pytest.mark.parametrize("a", [1e-12, 1e-6, 1e-3, 0.05, 0.0999999, 0.1, 0.1000001, 0.5, 2.0, 30.0])
def test_the_coefficients_are_the_integrals_that_they_stand_for(a):
    # Impulse at a time u before the end: what is left of it then is e^-au, and its integral until then (1 - e^-au)/a.
    value, _ = quad(lambda u: exp(-a * u), 0, 1, epsabs=1e-14)
    integral, _ = quad(lambda u: (-np.expm1(-a * u) / a) ** 2, 0, 1, epsabs=1e-14)

    assert _faded(a) == pytest.approx(value, rel=1e-12)
    assert _integral_variance(a) == pytest.approx(integral, rel=1e-11)


def test_the_coefficients_of_the_random_walk_are_the_limits():
    assert _faded(0.0) == 1.0
    assert _integral_variance(0.0) == pytest.approx(1 / 3, rel=1e-15)


@pytest.mark.parametrize("pause_s", [0.0, 0.03])
@pytest.mark.parametrize("tau_s", [0.005, 0.02, 0.2])
def test_means_have_the_variance_and_autocovariance_of_the_averaged_process(tau_s, pause_s):
    # Double integrals of the autocovariance sd^2 e^(-|t - s|/tau) over one aperture, and over two of them:
    #   var = sd^2 2 (a - 1 + e^-a)/a^2        cov(lag) = sd^2 ((1 - e^-a)/a)^2 e^(-(lag - h)/tau)
    sd_V, aperture_s = 2e-3, 0.02
    a, lag_s = aperture_s / tau_s, aperture_s + pause_s
    variance = sd_V**2 * 2 * (a - 1 + exp(-a)) / a**2
    covariance = sd_V**2 * ((1 - exp(-a)) / a) ** 2 * exp(-pause_s / tau_s)
    process = GaussMarkov.from_sd(sd_V=sd_V, tau_s=tau_s).realise(np.random.default_rng(SEED))
    means = process.average(np.arange(N) * lag_s, aperture_s)
    correlated = max(1.0, 2 * tau_s / lag_s)  # readings per independent one, for the tolerance
    tolerance = 5 * variance * sqrt(2 * correlated / N)

    assert means @ means / N == pytest.approx(variance, abs=tolerance)
    assert means[1:] @ means[:-1] / (N - 1) == pytest.approx(covariance, abs=tolerance)


def test_means_of_a_random_walk_have_the_increments_of_an_integrated_one():
    # Differences of adjacent means of a Wiener process: variance q^2 h 2/3, covariance of neighbours q^2 h/6.
    rate, aperture_s = 3e-3, 0.1
    steps = np.diff(contiguous_means(GaussMarkov(rate_V_per_rt_s=rate), aperture_s))
    tolerance = 5 * rate**2 * aperture_s * sqrt(2 / N)

    assert steps @ steps / steps.size == pytest.approx(rate**2 * aperture_s * 2 / 3, abs=tolerance)
    assert steps[1:] @ steps[:-1] / steps.size == pytest.approx(rate**2 * aperture_s / 6, abs=tolerance)


def test_a_very_long_time_constant_is_the_random_walk():
    walk = GaussMarkov(rate_V_per_rt_s=1e-3, tau_s=inf, start_V=0.0)
    long = GaussMarkov(rate_V_per_rt_s=1e-3, tau_s=1e12, start_V=0.0)

    assert np.allclose(contiguous_means(long, 0.1, 5000), contiguous_means(walk, 0.1, 5000), rtol=0, atol=1e-10)


def test_a_start_value_decays_with_the_time_constant():
    process = GaussMarkov(rate_V_per_rt_s=1e-12, tau_s=2.0, start_V=1.0)
    start_s = np.array([0.0, 1.0, 7.0])

    means = process.realise(np.random.default_rng(SEED)).average(start_s, 1e-6)

    assert means == pytest.approx(np.exp(-start_s / 2.0), abs=1e-6)


def test_the_first_value_comes_from_the_stationary_law():
    process = GaussMarkov.from_sd(sd_V=1.5, tau_s=1e6)
    rng = np.random.default_rng(SEED)
    first = np.array([process.realise(rng).average(np.zeros(1), 1e-3)[0] for _ in range(4000)])

    assert first.std() == pytest.approx(1.5, rel=5 / sqrt(2 * 4000))
