"""Ranges that move readings towards each other: what two ranges share, and how much it says."""

from math import log

import numpy as np
import pytest
from scipy.stats import beta, norm

from aemd.diagnose.checks.ranges import _score_of_share, check_hole, check_overlap
from aemd.diagnose.climb import densities
from aemd.diagnose.fit import fit_base, refit
from aemd.diagnose.hypothesis import Base, make_data
from aemd.diagnose.terms.ranges import RangeOverlap
from aemd.diagnose.translate import to_model
from tests.diagnose.plant import clean, series


def switched(seed, level_V, offset_V):
    """Return readings about a level, those above the 70th percentile of magnitude moved, and where that is."""
    y = clean(seed) + level_V
    threshold_V = float(np.quantile(np.abs(y), 0.7))
    return y + offset_V * (np.abs(y) >= threshold_V), threshold_V


def test_the_density_of_what_two_ranges_share_is_bounded_by_the_sum_of_both():
    y, _ = switched(1, 0.05, 0.0)
    data = make_data(series(y))
    sd, offset = 3.0, 1.1
    still = np.array([log(1.0), log(1e-9), log(1e3), log(1e-9), log(sd), 0.0])
    base = Base(still, shocks=False, box=((-30.0, 30.0),) * 6)  # white noise alone
    term = RangeOverlap(0.4, 0.4 + offset, True, sd**2, 0.0)
    each = densities([base, term], still, data)
    lower, upper = norm.logpdf(data.y, scale=sd), norm.logpdf(data.y + offset, scale=sd)
    shared = (data.y >= term.low) & (data.y < term.high)
    exact = np.where(shared, np.logaddexp(lower, upper), np.where(data.y < term.low, lower, upper))

    assert np.all(each <= exact + 1e-6)
    np.testing.assert_allclose(each, exact, atol=log(np.cosh(offset * (np.abs(data.y).max() + offset) / 2 / sd**2)))
    np.testing.assert_allclose(each[~shared], exact[~shared], atol=1e-6)


@pytest.mark.parametrize("level_V", [0.0, -2.0])  # beside the 1 V of the record
def test_readings_that_were_moved_towards_the_other_range_are_found_at_its_edge(level_V):
    offset_V = -4e-4 if level_V == 0 else 4e-4
    y, threshold_V = switched(2, level_V, offset_V)
    fit = fit_base(make_data(series(y)))
    evidence = check_overlap(fit)
    told = {item.name: item.value(np.empty(0)) for item in evidence.terms[0].parameters(fit.data)}

    assert evidence.p_value < 1e-6
    assert told["offset_V"] == pytest.approx(offset_V, rel=0.5)
    assert told["level_V"] == pytest.approx(threshold_V, abs=abs(offset_V))
    made, without = to_model(refit([*fit.terms, evidence.terms[0]], fit.data), 0.0)
    assert not without
    assert [effect.offset_V for effect in made.effects] == [told["offset_V"]]


@pytest.mark.parametrize("seed", range(3))
def test_readings_of_one_range_share_nothing(seed):
    y, _ = switched(seed, 0.05, 0.0)

    assert check_overlap(fit_base(make_data(series(y)))).p_value > 0.1


@pytest.mark.parametrize("deviations", [-3.0, 0.5, 4.0, 5.0])
def test_the_squares_of_a_few_readings_are_judged_by_their_own_law(deviations):
    """Whose tail is far from normal: 5 deviations come as often as 6.9 would by their mean and variance."""
    n, m = 600, 30
    share = beta.isf(norm.sf(deviations), m / 2, (n - m) / 2)
    squares, wide = np.full(n, (1 - share) / (n - m)), np.zeros(n)
    squares[:m], wide[:m] = share / m, 1.0

    assert _score_of_share(squares, wide, 1.0) ** 2 == pytest.approx(deviations**2, rel=1e-6)
    assert deviations < 5 or (share * n - m) / np.sqrt(2 * m * (1 - m / n)) == pytest.approx(6.9, abs=0.1)


def test_a_hole_shows_where_many_readings_should_be_though_nearly_as_wide_ones_are_where_few_are():
    """A slow wave dwells at its top; on its slope the readings are spread over many more volts."""
    y = clean(3)
    y = y + 0.03 * np.sin(2 * np.pi * np.arange(y.size) / y.size)
    moved = y + 2.4e-4 * (y >= np.quantile(y, 0.85))
    second, widest = np.sort(np.diff(np.sort(moved)[y.size // 20 : -y.size // 20]))[-2:]
    found = check_hole(fit_base(make_data(series(moved))))

    assert second > widest / 2
    assert found.p_value < 1e-6
