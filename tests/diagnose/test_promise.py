"""A promise is tried on figures that the readings leave open, and says where one more record's are in 95 %."""

import numpy as np
import pytest

from aemd.diagnose.estimator import estimator_for
from aemd.diagnose.fit import refit, residuals
from aemd.diagnose.hypothesis import Base, base_box, make_data
from aemd.diagnose.intervals import covariance
from aemd.diagnose.promise import _further, _left_open, errors_of
from aemd.diagnose.report import format_promise
from aemd.diagnose.result import Likely, Promise
from aemd.model import GaussMarkov, Model, WhiteNoise
from tests.diagnose.plant import INTERVAL_S, clean, markov, series

N = 250
SD, TAU_S, WHITE = 1.0, 3.0, 0.2
RATE = SD * np.sqrt(2 / TAU_S)


@pytest.fixture(scope="module")
def short():
    """Some turns of a drift whose rate is known, and the most likely time constant and level."""
    rng = np.random.default_rng(5)
    data = make_data(series(1e-3 * (markov(rng, N, TAU_S, SD) + WHITE * rng.standard_normal(N))))
    u = data.unit_V / 1e-3
    theta = np.array([np.log(INTERVAL_S), -12.0, np.log(TAU_S), np.log(RATE / u), np.log(WHITE / u), 0.0])
    box = tuple(
        bound if number in (2, 5) else (value, value)
        for number, (value, bound) in enumerate(zip(theta, base_box(data), strict=True))
    )
    return refit([Base(theta, shocks=False, box=box)], data)


def law_of_log_tau(fit, u: float) -> tuple[float, float]:
    """Mean and deviation of log tau by dense covariances, the level integrated out, tau even in its logarithm."""
    t_s = fit.data.t_s
    tried = np.linspace(np.log(3 * INTERVAL_S), np.log(2 * fit.data.span_s), 40)
    logs = []
    for tau_s in np.exp(tried):
        dense = RATE**2 * tau_s / 2 * np.exp(-np.abs(t_s[:, None] - t_s) / tau_s) + WHITE**2 * np.eye(N)
        solved = np.linalg.solve(dense, np.column_stack((fit.data.y * u, np.ones(N))))
        known = solved[:, 1].sum()
        squares = fit.data.y * u @ solved[:, 0] - solved[:, 0].sum() ** 2 / known
        logs.append(-0.5 * (np.linalg.slogdet(dense)[1] + np.log(known) + squares))
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    mean = float(weights @ tried)
    return mean, float(np.sqrt(weights @ (tried - mean) ** 2))


def test_drifts_are_drawn_as_slow_as_the_readings_allow(short):
    mean, sd = law_of_log_tau(short, short.data.unit_V / 1e-3)
    drawn = _left_open(short, covariance(short), np.random.default_rng(1))[:, 2]

    assert mean > short.theta[2] + 0.2  # the likeliest is too short
    assert drawn.mean() == pytest.approx(mean, abs=0.3 * sd)
    assert drawn.std() == pytest.approx(sd, rel=0.3)


def test_what_is_known_well_is_drawn_from_its_normal_law():
    data = make_data(series(clean(3, 3_000)))
    theta = np.array([np.log(0.5), 0.0, np.log(60.0), -2.5, -0.7, 0.0])
    fit = refit([Base(theta, shocks=False, box=base_box(data))], data)
    spread = covariance(fit)
    drawn = _left_open(fit, spread, np.random.default_rng(1))

    for number in (0, 1, 4):  # signal and white noise
        assert drawn[:, number].std() == pytest.approx(np.sqrt(spread[number, number]), rel=0.35)


def test_one_more_record_is_within_the_ends_in_95_of_100():
    rng = np.random.default_rng(2)
    within = []
    for _ in range(2_000):
        *seen, further = rng.lognormal(size=80)
        _, low, high = _further(np.array(seen))
        within.append(low <= further <= high)

    assert np.mean(within) == pytest.approx(0.95, abs=0.015)


@pytest.mark.parametrize("n", [6_000, 10_100])
def test_a_drift_that_is_hardly_there_is_not_drawn_as_one_that_the_readings_rule_out(n):
    """The logarithm of its rate is open by 25 downwards; upwards the white noise ends what is likely."""
    rng = np.random.default_rng(8)
    data = make_data(series(1e-3 * rng.standard_normal(n)))
    theta = np.array([np.log(INTERVAL_S), -12.0, np.log(30.0), -9.0, np.log(1e-3 / data.unit_V), 0.0])
    fit = residuals([Base(theta, shocks=False, box=base_box(data))], theta, data)
    spread = np.diag([1.0, 1.0, 1.0, 25.0, 0.01, 0.01]) ** 2
    drawn = _left_open(fit, spread, np.random.default_rng(1))
    of_the_noise = np.exp(drawn[:, 3]) * np.sqrt(INTERVAL_S) / np.exp(theta[4])

    assert of_the_noise.max() < 0.3  # a step of the drift in each interval, as a share of the white noise


def test_a_drift_that_outlasts_the_record_is_a_constant_and_no_error():
    """Of a signal of 1 mV; the readings differ by little more than that, wherever the drift has them."""
    made = Model(
        (
            GaussMarkov.from_sd(1e-3, 0.5, role="signal"),
            GaussMarkov.from_sd(50e-3, 1e6, role="internal"),
            WhiteNoise.from_sd(0.5e-3, 0.02),
        ),
        7,
    )
    choice, _ = estimator_for(made, interval_s=INTERVAL_S, aperture_s=0.02, span_s=100.0)
    errors_V, _ = errors_of([choice.options], made, 1_500, INTERVAL_S, 0.02)

    assert errors_V[0] < 1.1e-3


@pytest.mark.parametrize(("after_V", "gains"), [(1.7594e-3, False), (1.2e-3, True)])
def test_a_promise_whose_two_errors_read_alike_says_that_nothing_is_gained(after_V, gains):
    told = format_promise(Promise(1.7560e-3, after_V, Likely(0.99, 0.96, 1.02), Likely(0.1, 0.1, 0.1), 6_000))

    assert ("gains nothing" in told) is not gains
    assert ("instead of 1.76 mV" in told) is gains
