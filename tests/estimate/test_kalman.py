"""The Kalman filter against filterpy, and against conditioning the whole Gaussian at once."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from aemd.block import Block, Status, make_block
from aemd.estimate import make_estimator

INTERVAL_S = 1 / 15


def noisy(seed: int, n: int) -> Block:
    random = np.random.default_rng(seed)
    return make_block(np.cumsum(random.normal(0, 1e-3, n)) + random.normal(0, 1e-3, n), interval_ns=1e9 * INTERVAL_S)


@given(seed=st.integers(0, 10**6), tau_s=st.floats(0.1, 100.0) | st.just(float("inf")))
def test_estimate_and_variance_are_those_of_the_joint_gaussian(seed: int, tau_s: float) -> None:
    """All states and readings as one normal vector: condition on the readings with a dense solve."""
    n, phi, Q, R, prior_P = 12, np.exp(-INTERVAL_S / tau_s), 0.93e-3**2, 0.99e-3**2, 0.1**2
    block = noisy(seed, n)
    state = np.linalg.inv(np.eye(n) - phi * np.eye(n, k=-1))  # states from the shocks that drive them
    shocks = np.full(n, Q)
    shocks[0] = phi**2 * prior_P + Q
    cov_x = state @ np.diag(shocks) @ state.T
    cov_z = cov_x + R * np.eye(n)
    gain = np.linalg.solve(cov_z, cov_x[-1])

    estimates = make_estimator("kalman", {"tau_s": tau_s, "prior_sigma_V": 0.1}, INTERVAL_S).push(block)

    assert estimates["value_V"][-1] == pytest.approx(gain @ block["value_V"], rel=1e-9, abs=1e-12)
    assert estimates["sigma_V"][-1] == pytest.approx(np.sqrt(cov_x[-1, -1] - gain @ cov_x[-1]), rel=1e-9)
    assert estimates["log_likelihood"].sum() == pytest.approx(
        multivariate_normal(cov=cov_z).logpdf(block["value_V"]), rel=1e-9
    )


@given(seed=st.integers(0, 10**6), tau_s=st.floats(0.1, 100.0) | st.just(float("inf")))
def test_it_equals_filterpy_to_rounding_across_holes_too(seed: int, tau_s: float) -> None:
    random = np.random.default_rng(seed)
    block = noisy(seed, 80)
    block["index"][random.integers(1, 80) :] += random.choice([1, 15, 16, 50])
    block["status"][random.integers(0, 80)] = int(Status.OVERLOAD_LOW)
    block["status"][60:][: random.choice([3, 18])] = int(Status.INVALID)
    block["value_V"][random.integers(0, 80)] = 1e30
    block["value_V"][block["status"] != 0] = np.nan

    ours = make_estimator("kalman", {"tau_s": tau_s}, INTERVAL_S).push(block)
    theirs = make_estimator("filterpy", {"tau_s": tau_s}, INTERVAL_S).push(block)

    np.testing.assert_array_equal(ours["status"], theirs["status"])
    for name in ("value_V", "sigma_V", "log_likelihood"):
        np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-11, atol=1e-15, err_msg=name)


def test_the_variance_settles_at_the_root_of_the_riccati_equation() -> None:
    Q, R = 0.93e-3**2, 0.99e-3**2
    M = (Q + np.sqrt(Q * Q + 4 * Q * R)) / 2  # M = M R / (M + R) + Q

    estimates = make_estimator("kalman", {}, INTERVAL_S).push(noisy(1, 100))

    assert estimates["sigma_V"][-1] ** 2 == pytest.approx(M * R / (M + R), rel=1e-12)
