"""The filter against dense Gaussian densities, and against every pattern of shocks."""

from itertools import product

import numpy as np
import pytest
from scipy.stats import kstest, multivariate_normal, norm

from aemd.diagnose.kernels import MARKOV, PAIR, PAIR_SECOND, PREVIOUS, WHITE, log_densities, predict, whiten

NO_SHOCKS = np.array([0.0, 0.0, -1.0])
NO_EXTRAS = np.zeros(6)


def covariance_of(times_s: np.ndarray, pieces: list, noise: float) -> np.ndarray:
    lags = np.abs(times_s[:, None] - times_s[None, :])
    total = noise * np.eye(times_s.size)
    for kind, tau, omega, sd in pieces:
        total += sd**2 * np.exp(-lags / tau) * (np.cos(omega * lags) if kind == "pair" else 1.0)
    return total


def test_the_likelihood_is_the_multivariate_normal_density_also_with_gaps_and_uneven_steps():
    rng = np.random.default_rng(1)
    steps = rng.choice([1.0, 1.0, 1.0, 2.0, 0.37], 80)
    times_s = np.cumsum(steps) - steps[0]
    used = rng.random(80) < 0.9
    y = rng.standard_normal(80) * 2
    tau1, tau2, tau3, omega = 3.0, 40.0, 15.0, 0.8
    states = np.array(
        [
            [MARKOV, tau1, 0, 1.2 * np.sqrt(2 / tau1), 1.2, 1],
            [MARKOV, tau2, 0, 0.7 * np.sqrt(2 / tau2), 0.7, 1],
            [PAIR, tau3, omega, 0.5, 0.5, 1],
            [PAIR_SECOND, tau3, omega, 0.5, 0.5, 0],
        ]
    )
    ours = log_densities(
        y, used, steps, np.full(80, 0.3), np.full(80, 0.4), np.ones(80), states, NO_SHOCKS, NO_EXTRAS
    ).sum()
    dense = covariance_of(
        times_s, [("markov", tau1, 0, 1.2), ("markov", tau2, 0, 0.7), ("pair", tau3, omega, 0.5)], 0.4
    )
    theirs = multivariate_normal(np.full(used.sum(), 0.3), dense[np.ix_(used, used)]).logpdf(y[used])

    assert ours == pytest.approx(theirs, rel=1e-10)


def test_differenced_noise_has_the_covariance_of_a_difference():
    n, sd = 40, 0.8
    y = np.random.default_rng(2).standard_normal(n)
    states = np.array([[WHITE, 1, 0, sd, sd, 1], [PREVIOUS, 1.5, 0, sd, sd, -1]])
    ours = log_densities(
        y, np.ones(n, bool), np.ones(n), np.zeros(n), np.full(n, 0.1), np.ones(n), states, NO_SHOCKS, NO_EXTRAS
    ).sum()
    cov = (0.1 + 2 * sd**2) * np.eye(n) - sd**2 * (np.eye(n, k=1) + np.eye(n, k=-1))

    assert ours == pytest.approx(multivariate_normal(np.zeros(n), cov).logpdf(y), rel=1e-10)


def test_readings_with_a_lost_one_between_share_no_differenced_noise():
    n, sd = 60, 0.8
    rng = np.random.default_rng(3)
    there = rng.random(n) < 0.8
    steps = np.diff(np.flatnonzero(there), prepend=np.argmax(there) - 1).astype(float)
    y = rng.standard_normal(there.sum())
    states = np.array([[MARKOV, 3, 0, 1, 1.2, 1], [WHITE, 1, 0, sd, sd, 1], [PREVIOUS, 1.5, 0, sd, sd, -1]])
    states[0, 3] = 1.2 * np.sqrt(2 / 3)
    ours = log_densities(
        *(y, np.ones(y.size, bool), steps, np.zeros(y.size), np.full(y.size, 0.1), np.ones(y.size)),
        *(states, NO_SHOCKS, NO_EXTRAS),
    ).sum()
    whole = covariance_of(np.arange(n, dtype=float), [("markov", 3.0, 0, 1.2)], 0.1)
    whole += 2 * sd**2 * np.eye(n) - sd**2 * (np.eye(n, k=1) + np.eye(n, k=-1))

    assert (steps > 1).any()
    assert ours == pytest.approx(multivariate_normal(np.zeros(y.size), whole[np.ix_(there, there)]).logpdf(y), rel=1e-9)


def test_a_random_walk_is_the_limit_of_a_long_time_constant():
    n = 50
    y = np.random.default_rng(3).standard_normal(n).cumsum()
    arguments = (y, np.ones(n, bool), np.ones(n), np.zeros(n), np.full(n, 0.1), np.ones(n))
    ours = log_densities(*arguments, np.array([[MARKOV, np.inf, 0, 1.0, 2.0, 1]]), NO_SHOCKS, NO_EXTRAS).sum()
    cov = 4.0 + np.minimum.outer(np.arange(n), np.arange(n)) + 0.1 * np.eye(n)

    assert ours == pytest.approx(multivariate_normal(np.zeros(n), cov).logpdf(y), rel=1e-10)


def test_the_mixture_is_near_the_sum_over_all_patterns_of_shocks():
    """Ten readings, 2^10 patterns, each an exact Gaussian density; collapsing after each reading costs little.

    What the record begins with is a shock with the probability that one was within its decay before it.
    """
    n, step, tau, decay, rate, amplitude = 10, 1.0, 8.0, 4.0, 0.08, 5.0
    y = np.array([0.1, -0.3, 0.2, 4.8, 4.1, 2.9, 2.2, 1.9, 0.9, 1.2])
    states = np.array([[MARKOV, tau, 0, 0.5 * np.sqrt(2 / tau), 0.5, 1], [MARKOV, decay, 0, 0, 0, 1]])
    shocks = np.array([rate, amplitude**2, 1.0])
    ours = log_densities(
        y, np.ones(n, bool), np.full(n, step), np.zeros(n), np.full(n, 0.2), np.ones(n), states, shocks, NO_EXTRAS
    ).sum()
    jump = 1 - np.exp(-rate * step)
    lags = np.arange(n)[:, None] - np.arange(n)[None, :]
    response = np.where(lags >= 0, np.exp(-np.maximum(lags, 0) * step / decay), 0.0)
    gauss = covariance_of(np.arange(n) * step, [("markov", tau, 0, 0.5)], 0.2)
    terms = []
    odds = np.array([-np.expm1(-rate * decay), *[jump] * (n - 1)])
    for pattern in product((0, 1), repeat=n):
        jumps = np.array(pattern)
        cov = gauss + amplitude**2 * (response * jumps) @ response.T
        prior = np.log(np.where(jumps, odds, 1 - odds)).sum()
        terms.append(prior + multivariate_normal(np.zeros(n), cov).logpdf(y))

    assert ours == pytest.approx(np.logaddexp.reduce(terms), abs=0.05)


def test_residuals_of_the_true_shock_model_are_standard_normal():
    """Kolmogorov's test on 20,000 residuals, with shocks every 7 s: p above 0.001 at each of three seeds."""
    n, step, tau, decay = 20_000, 0.1, 1.0, 0.3
    states = np.array([[MARKOV, tau, 0, np.sqrt(2 / tau), 1, 1], [MARKOV, decay, 0, 0, 0, 1]])
    shocks = np.array([0.15, 64.0, 1.0])
    for seed in (1, 2, 3):
        rng = np.random.default_rng(seed)
        x = u = 0.0
        phi, fade = np.exp(-step / tau), np.exp(-step / decay)
        y = np.empty(n)
        for k in range(n):
            x = phi * x + np.sqrt(1 - phi**2) * rng.standard_normal()
            u = fade * u + (8 * rng.standard_normal() if rng.random() < 1 - np.exp(-0.15 * step) else 0.0)
            y[k] = x + u + 0.5 * rng.standard_normal()
        _, z, *_ = predict(
            y, np.ones(n, bool), np.full(n, step), np.zeros(n), np.full(n, 0.25), np.ones(n), states, shocks, NO_EXTRAS
        )

        assert kstest(z, "norm").pvalue > 1e-3
        assert np.corrcoef(z[1:], z[:-1])[0, 1] == pytest.approx(0, abs=4 / np.sqrt(n))


def test_whitening_a_template_is_the_difference_it_makes_to_the_innovations():
    n = 300
    rng = np.random.default_rng(4)
    states = np.array([[MARKOV, 5.0, 0, 0.4, 0.63, 1], [MARKOV, 90.0, 0, 0.1, 0.7, 1]])
    y, template, used = rng.standard_normal(n), np.sin(np.arange(n) / 7), rng.random(n) < 0.95
    model = (np.zeros(n), np.full(n, 0.3), np.ones(n), states, NO_SHOCKS, NO_EXTRAS)
    _, plain, _, variance, gains = predict(y, used, np.ones(n), *model)
    _, moved, *_ = predict(y + 0.1 * template, used, np.ones(n), *model)

    left = whiten(template, np.ones(n), states, gains, used)

    np.testing.assert_allclose((moved - plain)[used], (0.1 * left / np.sqrt(variance))[used], atol=1e-12)


@pytest.mark.parametrize(
    "extras",
    [
        [0, 0, 0, 0, 0, 0],
        [0, 0, 0.3, 4.0, 0, 0],
        [0.1, 0, 0.3, 4.0, 1.0, 0],
        [0, 0.1, 0, 0, 0, 0],
        [0, 0, 0, 0, 0, 0.8],
        [0, 0, 0.3, 4.0, 0, -0.6],
    ],
)
def test_predicted_densities_are_densities_and_z_is_their_quantile(extras):
    """Vary the last of five readings: its density integrates to one, and to the normal probability of its z."""
    states = np.array([[MARKOV, 3.0, 0, 0.5, 0.6, 1], [MARKOV, 2.0, 0, 0, 0, 1]])
    shocks = np.array([0.4, 9.0, 1.0])
    grid = np.linspace(-40, 40, 4001)
    y = np.array([0.2, 1.0, 3.0, 2.0, 0.0])
    model = (np.zeros(5), np.full(5, 0.2), np.ones(5), states, shocks, np.array(extras, float))
    density, z = np.empty(grid.size), np.empty(grid.size)
    for k, last in enumerate(grid):
        each, normal, *_ = predict(np.append(y[:4], last), np.ones(5, bool), np.ones(5), *model)
        density[k], z[k] = np.exp(each[4]), normal[4]
    total = np.cumsum(density) * (grid[1] - grid[0])

    assert total[-1] == pytest.approx(1, abs=1e-6)
    middle = (total > 0.01) & (total < 0.99)
    np.testing.assert_allclose(norm.cdf(z)[middle], total[middle], atol=0.01 if extras[5] == 0 else 0.04)
