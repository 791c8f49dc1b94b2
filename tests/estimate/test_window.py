"""The spread of slopes that chooses AEM's window."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from aemd.block import make_block
from aemd.estimate import make_estimator
from aemd.estimate.window import fit_matrices
from tests.estimate import plain

INTERVAL_S = 1 / 15
MILLI = 1e-3
VALUES = st.floats(-1e3, 1e3, allow_subnormal=False)


@given(curve=st.lists(VALUES, min_size=2, max_size=20))
def test_slopes_of_all_pairs_spread_as_far_as_those_of_neighbours(curve: list[float]) -> None:
    every = plain.slopes_between_all_pairs(curve)
    adjacent = np.diff(curve)

    assert max(every) == pytest.approx(adjacent.max(), rel=1e-12, abs=1e-12)
    assert min(every) == pytest.approx(adjacent.min(), rel=1e-12, abs=1e-12)


@given(readings=st.lists(VALUES, min_size=6, max_size=25), order=st.integers(2, 5), offset=st.floats(-1e4, 1e4))
def test_the_matrices_give_the_slopes_of_a_least_squares_polynomial(
    readings: list[float], order: int, offset: float
) -> None:
    curve, slopes = fit_matrices(len(readings), order)
    place = np.arange(len(readings))
    fitted = np.polynomial.Polynomial.fit(place, readings, order)(place)

    ours = slopes @ (curve @ (np.array(readings) + offset))

    assert np.ptp(ours) == pytest.approx(np.ptp(np.diff(fitted)), rel=1e-9, abs=1e-9)


def parabola(bend_mV: float) -> float:
    """Spread that the estimator reports on z = bend k^2, whose neighbouring slopes rise by 2 bend each."""
    block = make_block(bend_mV * MILLI * np.arange(16.0) ** 2)
    return float(make_estimator("aem", {}, INTERVAL_S).push(block)["spread"][-1])


def test_a_parabola_has_the_spread_of_its_formula() -> None:
    assert parabola(0.05) == pytest.approx(2 * 0.05 * 13, rel=1e-9)  # 14 slopes, 13 steps between them


@pytest.mark.parametrize(("spread", "window"), [(0.57, 15), (0.58, 10), (1.73, 10), (1.74, 5)], ids=str)
def test_the_window_changes_at_tan_30_and_tan_60_degrees(spread: float, window: int) -> None:
    block = make_block(spread / 26 * MILLI * np.arange(16.0) ** 2)

    assert make_estimator("aem", {}, INTERVAL_S).push(block)["window"][-1] == window


def test_white_noise_of_the_paper_leaves_the_longest_window_85_times_in_100() -> None:
    """The bend of a parabola through 15 readings has variance 180 sigma^2 / (n (n^2 - 1) (n^2 - 4))."""
    n, sigma_mV = 15, 0.99
    sigma_spread = 26 * sigma_mV * np.sqrt(180 / (n * (n * n - 1) * (n * n - 4)))
    expected = 1 - 2 * norm.sf(np.sqrt(3) / 3 / sigma_spread)
    block = make_block(np.random.default_rng(4).normal(0, sigma_mV * MILLI, 100_000))

    longest = np.mean(make_estimator("aem", {}, INTERVAL_S).push(block)["window"] == 15)

    assert expected == pytest.approx(0.85, abs=0.005)
    assert longest == pytest.approx(expected, abs=0.01)


def test_an_offset_a_straight_rise_and_the_unit_do_not_change_the_window() -> None:
    block = make_block(np.random.default_rng(5).normal(0, 2 * MILLI, 300))
    moved = make_block(block["value_V"] * 1e-3 + 5 + 1e-4 * np.arange(300))

    here = make_estimator("aem", {}, INTERVAL_S).push(block)["window"]
    there = make_estimator("aem", {"slope_unit_V": 1e-6}, INTERVAL_S).push(moved)["window"]

    assert set(np.unique(here)) == {0, 5, 10, 15}
    np.testing.assert_array_equal(here, there)
