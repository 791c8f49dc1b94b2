"""The adaptive line enhancer against padasip's filters, and its own treatment of the first readings."""

import numpy as np
import padasip
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from aemd.block import Block, Status, make_block
from aemd.errors import ConfigError
from aemd.estimate import make_estimator

INTERVAL_S = 1 / 15


def sine(seed: int, n: int) -> Block:
    random = np.random.default_rng(seed)
    return make_block(2e-3 * np.sin(2 * np.pi * 0.2 * INTERVAL_S * np.arange(n)) + random.normal(0, 1e-3, n))


@given(seed=st.integers(0, 10**6), taps=st.integers(1, 20), step=st.floats(0.01, 1.0), plain=st.booleans())
def test_predictions_are_those_of_padasip(seed: int, taps: int, step: float, plain: bool) -> None:
    block = sine(seed, 150)
    z = block["value_V"]
    first_weights = np.full(taps, 1 / taps)
    if plain:
        step = step / (taps * 10e-6)  # within the bound of stability: one over the power of the line
        theirs = padasip.filters.FilterLMS(n=taps, mu=step, w=first_weights)
    else:
        theirs = padasip.filters.FilterNLMS(n=taps, mu=step, eps=2e-6, w=first_weights)
    expected, line = [z[0]], np.full(taps, z[0])
    for reading in z[1:]:
        expected.append(float(theirs.predict(line)))
        theirs.adapt(reading, line)
        line = np.concatenate([[reading], line[:-1]])

    options = {"taps": taps, "step": step, "least_power_V2": 2e-6, "form": "plain" if plain else "normalised"}
    ours = make_estimator("lms", options, INTERVAL_S).push(block)

    np.testing.assert_allclose(ours["value_V"], expected, rtol=1e-9, atol=1e-14)


def test_start_up_lasts_until_the_line_holds_readings_only() -> None:
    estimates = make_estimator("lms", {"taps": 6}, INTERVAL_S).push(sine(1, 10))

    assert (estimates["status"] == int(Status.START_UP)).tolist() == [True] * 6 + [False] * 4


def test_sigma_follows_the_size_of_the_prediction_error() -> None:
    block = make_block(np.random.default_rng(2).normal(0, 5e-3, 4000))

    estimates = make_estimator("lms", {}, INTERVAL_S).push(block)
    error = block["value_V"] - estimates["value_V"]

    assert estimates["sigma_V"][500:].mean() == pytest.approx(error[500:].std(), rel=0.05)


def test_the_likelihood_is_that_of_the_prediction_under_the_sigma_before_across_holes_too() -> None:
    block = sine(4, 100)
    block["status"][[40, 41, 70]] = int(Status.OVERLOAD_LOW)

    estimates = make_estimator("lms", {}, INTERVAL_S).push(block)
    expected = norm.logpdf(block["value_V"][1:], estimates["value_V"][1:], estimates["sigma_V"][:-1])

    np.testing.assert_allclose(estimates["log_likelihood"][1:], np.where(block["status"][1:], 0.0, expected), rtol=1e-9)


def test_weights_that_diverge_are_forgotten_and_nothing_infinite_comes_out() -> None:
    estimates = make_estimator("lms", {"form": "plain", "step": 1e9}, INTERVAL_S).push(sine(3, 2000))

    assert np.isfinite(estimates["value_V"]).all()
    assert np.isfinite(estimates["sigma_V"]).all()
    assert np.isfinite(estimates["log_likelihood"]).all()
    assert np.any(estimates["status"] & int(Status.RESTARTED))


def test_a_normalised_step_that_cannot_be_stable_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"step = 2\.5: must be below 2"):
        make_estimator("lms", {"step": 2.5}, INTERVAL_S)
