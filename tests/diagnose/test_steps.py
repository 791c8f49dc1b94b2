"""A step that a drift or a shock was fitted to is found by what a fit with it gains."""

import numpy as np
import pytest
from scipy.stats import norm

from aemd.diagnose.checks.shapes import check_step
from aemd.diagnose.fit import fit_base, residuals
from aemd.diagnose.hypothesis import make_data
from tests.diagnose.plant import N, clean, series


def stepped(seed, step_V):
    return series(clean(seed, white=0.2) + step_V * (np.arange(N) >= 1_500))


def test_a_step_that_made_the_drift_fast_is_found_by_what_it_gains():
    fit = fit_base(make_data(stepped(3, 3.5e-3)))
    fast = fit.theta.copy()
    fast[3] += 0.7  # nearer to a base that the step has misled altogether
    misled = residuals(fit.terms, fast, fit.data)
    found = check_step(misled)

    assert norm.sf(found.observed) * N > 1e-4  # what the score alone would say
    assert found.p_value < 1e-6
    assert any(abs(term.time_s - fit.data.t_s[1_500]) < 0.1 for term in found.terms)


def test_a_step_that_was_taken_for_a_shock_is_sought_at_its_reading():
    rng = np.random.default_rng(5)
    y = stepped(4, 6e-3).value_V.copy()
    for at in np.sort(rng.choice(N - 50, 12, replace=False)):
        y[at : at + 40] += 20e-3 * rng.standard_normal() * np.exp(-np.arange(40) / 3)
    fit = fit_base(make_data(series(y)))
    found = check_step(fit)

    assert fit.base.shocks
    assert abs(fit.z[1_500]) < 4  # what the law of shocks leaves of 15 deviations
    assert found.p_value < 1e-6
    assert any(abs(term.time_s - fit.data.t_s[1_500]) < 0.01 for term in found.terms)


@pytest.mark.parametrize("seed", range(6))
def test_where_there_is_no_step_none_is_gained(seed):
    shocks = 0.05 * (seed % 2)

    assert check_step(fit_base(make_data(series(clean(seed, shocks_per_s=shocks))))).p_value > 0.01
