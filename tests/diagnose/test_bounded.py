"""The filter on intervals, further noises and shocks of a shape: against sums over cells and dense densities."""

from itertools import product

import numpy as np
import pytest
from scipy.stats import kstest, multivariate_normal, norm, t

from aemd.diagnose.apertures import averaged_markov, averaged_pair
from aemd.diagnose.given import student
from aemd.diagnose.kernels import MARKOV, PAIR, PAIR_SECOND, log_densities, predict
from aemd.model import GaussMarkov

NO_SHOCKS = np.array([0.0, 0.0, -1.0])
NO_EXTRAS = np.zeros(6)


def test_the_probabilities_of_all_cells_of_a_lattice_sum_to_one_also_with_shocks():
    states = np.array([[MARKOV, 3.0, 0, 0.5, 0.6, 1], [MARKOV, 2.0, 0, 0, 0, 1]])
    shocks, step = np.array([0.4, 9.0, 1.0]), 0.8
    y = np.array([0.0, 0.8, 2.4, 1.6, 0.0])
    total = 0.0
    for last in step * np.arange(-40, 41):
        seen = np.append(y[:4], last)
        each = log_densities(
            *(seen, np.ones(5, bool), np.ones(5), np.zeros(5), np.full(5, 0.2), np.ones(5)),
            *(states, shocks, NO_EXTRAS, seen - step / 2, seen + step / 2),
        )
        total += np.exp(each[4])

    assert total == pytest.approx(1, abs=1e-9)


def test_the_first_two_of_a_rounded_pair_have_the_probability_of_their_rectangle():
    """A bivariate normal probability; the filter cuts the first reading's law by its moments, exact to third order."""
    tau, sd, noise, half = 4.0, 1.0, 0.3, 0.4
    states = np.array([[MARKOV, tau, 0, sd * np.sqrt(2 / tau), sd, 1]])
    y = np.array([0.5, 0.9])
    ours = log_densities(
        *(y, np.ones(2, bool), np.ones(2), np.zeros(2), np.full(2, noise), np.ones(2)),
        *(states, NO_SHOCKS, NO_EXTRAS, y - half, y + half),
    ).sum()
    law = multivariate_normal([0, 0], [[sd**2 + noise, np.exp(-1 / tau)], [np.exp(-1 / tau), sd**2 + noise]])

    assert ours == pytest.approx(np.log(law.cdf(y + half, lower_limit=y - half)), abs=2e-3)


def test_z_of_what_was_clipped_rounded_and_held_is_standard_normal():
    n, tau = 20_000, 8.0
    states = np.array([[MARKOV, tau, 0, np.sqrt(2 / tau), 1, 1]])
    for seed in (1, 2, 3):
        rng = np.random.default_rng(seed)
        x, y = 0.0, np.empty(n)
        for k in range(n):
            x = np.exp(-1 / tau) * x + np.sqrt(1 - np.exp(-2 / tau)) * rng.standard_normal()
            y[k] = x + 0.5 * rng.standard_normal()
        low, high = y.copy(), y.copy()
        held, clipped = np.abs(y - 0.3) < 0.4, y > 1.2
        low[held], high[held] = -0.1, 0.7
        low[clipped], high[clipped] = 1.2, np.inf
        seen = np.where(clipped, 1.2, np.where(held, 0.3, y))
        _, z, *_ = predict(
            *(seen, np.ones(n, bool), np.ones(n), np.zeros(n), np.full(n, 0.25), np.ones(n)),
            *(states, NO_SHOCKS, NO_EXTRAS, low, high),
        )

        assert kstest(z, "norm").pvalue > 1e-3
        assert np.corrcoef(z[1:], z[:-1])[0, 1] == pytest.approx(0, abs=4 / np.sqrt(n))


@pytest.mark.parametrize("dof", [3.0, 4.0, 30.0])
def test_normal_laws_mix_to_students_law(dof):
    shares, variances = student(4.0, dof)
    scale = 2 * np.sqrt((dof - 2) / dof)
    at = np.linspace(0, 8 * scale, 60)
    mixed = sum(share * norm.cdf(at, scale=np.sqrt(v)) for share, v in zip(shares, variances, strict=True))

    assert shares.sum() == pytest.approx(1)
    assert shares @ variances == pytest.approx(4.0)
    np.testing.assert_allclose(mixed, t.cdf(at, dof, scale=scale), atol=2e-3)


def test_a_shock_of_two_decays_and_a_ring_is_near_the_sum_over_all_patterns():
    """Eight readings, 2^8 patterns, each an exact Gaussian density with the shock's whole shape in its covariance."""
    n, rate, amplitude = 8, 0.1, 5.0
    y = np.array([0.1, -0.3, 4.8, 4.9, 2.0, 1.0, 1.4, 0.7])
    states = np.array(
        [
            [MARKOV, 8.0, 0, 0.25, 0.5, 1],
            [MARKOV, 1.0, 0, 0, 0, 1],
            [MARKOV, 6.0, 0, 0, 0, 1],
            [PAIR, 3.0, 1.3, 0, 0, 0],
            [PAIR_SECOND, 3.0, 1.3, 0, 0, -0.4],
        ]
    )
    shocks = np.array([rate, amplitude**2, 1.0, 0.0, 0.7, 0.3, 1.0, 0.0])
    ours = log_densities(
        *(y, np.ones(n, bool), np.ones(n), np.zeros(n), np.full(n, 0.2), np.ones(n), states, shocks, NO_EXTRAS)
    ).sum()
    lags = np.arange(n)[:, None] - np.arange(n)[None, :]
    after = np.maximum(lags, 0)
    shape = 0.7 * np.exp(-after) + 0.3 * np.exp(-after / 6) + 0.4 * np.exp(-after / 3) * np.sin(1.3 * after)
    response = np.where(lags >= 0, shape, 0.0)
    gauss = 0.25 * np.exp(-np.abs(lags) / 8) + 0.2 * np.eye(n)
    terms = []
    odds = -np.expm1(-rate * np.ones(n))  # the first decay is one interval
    for pattern in product((0, 1), repeat=n):
        jumps = np.array(pattern)
        cov = gauss + amplitude**2 * (response * jumps) @ response.T
        prior = np.log(np.where(jumps, odds, 1 - odds)).sum()
        terms.append(prior + multivariate_normal(np.zeros(n), cov).logpdf(y))

    assert ours == pytest.approx(np.logaddexp.reduce(terms), abs=0.08)


@pytest.mark.parametrize("tau_s", [0.02, 0.3, 50.0])
def test_an_averaged_process_has_the_covariances_of_integrals_over_its_apertures(tau_s):
    """By sums of e^(-|t - u|/tau) over a fine grid in both apertures."""
    aperture_s, interval_s, rate = 0.05, 0.07, 1.7
    kept, white = averaged_markov(tau_s, rate, aperture_s)
    fine = aperture_s * (np.arange(400) + 0.5) / 400
    same, next_one = (
        rate**2 * tau_s / 2 * np.exp(-np.abs(shift + fine[:, None] - fine) / tau_s).mean()
        for shift in (0.0, interval_s)
    )

    assert kept**2 * tau_s / 2 * np.exp(-interval_s / tau_s) == pytest.approx(next_one, rel=1e-4)
    assert kept**2 * tau_s / 2 + white == pytest.approx(same, rel=1e-4)


@pytest.mark.parametrize("tau_s", [1.7e-3, 1.6e-3, 1e-4, 1e-6])
def test_of_a_process_far_faster_than_its_apertures_the_variance_of_their_means_is_left(tau_s):
    """sigma^2 2 (a - 1 + e^-a)/a^2, a = T/tau; of the two parts each may be larger by far, and no digits are lost."""
    aperture_s, rate = 0.05, 1.7
    kept, white = averaged_markov(tau_s, rate, aperture_s)
    swung, beside = averaged_pair(tau_s, 1.5 / tau_s, 1.0, aperture_s)
    a, u = aperture_s / tau_s, np.linspace(0, 25, 50_001)  # lags in time constants
    swinging = np.trapezoid((a - u) * np.exp(-u) * (np.cos(1.5 * u) + np.sin(1.5 * u) / 1.5), u) * 2 / a**2

    assert kept**2 * tau_s / 2 + white == pytest.approx(rate**2 * tau_s * (a - 1 + np.exp(-a)) / a**2, rel=1e-4)
    assert swung**2 + beside == pytest.approx(swinging, rel=1e-4)


def test_an_averaged_oscillator_has_the_variance_of_its_means():
    tau_s, omega, aperture_s = 1.6, 25.0, 0.05
    kept, white = averaged_pair(tau_s, omega, 1.0, aperture_s)
    fine = aperture_s * (np.arange(400) + 0.5) / 400
    lag = np.abs(fine[:, None] - fine)
    law = np.exp(-lag / tau_s) * (np.cos(omega * lag) + np.sin(omega * lag) / (omega * tau_s))

    assert kept**2 + white == pytest.approx(law.mean(), rel=1e-4)


def test_the_means_of_a_random_walk_differ_as_the_filter_says():
    """The variance of a difference, and what two that follow one another share, over 200,000 of our own simulation."""
    aperture_s, interval_s, n = 0.05, 0.07, 200_000
    kept, white = averaged_markov(np.inf, 1.0, aperture_s)
    history = GaussMarkov(rate_V_per_rt_s=1.0).realise(np.random.default_rng(5))
    change = np.diff(history.average(np.arange(n) * interval_s, aperture_s))

    assert np.mean(change**2) == pytest.approx(kept**2 * interval_s + 2 * white, rel=0.02)
    assert np.mean(change[1:] * change[:-1]) == pytest.approx(-white, abs=4 * interval_s / np.sqrt(n))
