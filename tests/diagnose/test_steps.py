"""A step that a drift or a shock was fitted to is found by what a fit with it gains."""

import numpy as np
import pytest
from scipy.stats import norm

from aemd.diagnose.checks.shapes import _Promised, check_step
from aemd.diagnose.fit import fit_base
from aemd.diagnose.hypothesis import make_data
from tests.diagnose.plant import N, clean, markov, series


@pytest.mark.parametrize("seed", [3, 4])  # the drift is the first of the fit's two processes, or the second
def test_a_step_that_made_a_drift_is_found_by_what_it_gains(seed):
    rng = np.random.default_rng([seed, 7])
    y = markov(rng, N, 0.5, 1.0) + 0.2 * rng.standard_normal(N) + 2.0 * (np.arange(N) >= 1_500)
    fit = fit_base(make_data(series(1 + 1e-3 * y)))
    found = check_step(fit)

    assert 2 * norm.sf(found.observed) * N > 2e-5  # what the score alone would say
    assert found.p_value < 1e-6
    assert any(abs(term.time_s - fit.data.t_s[1_500]) < 0.1 for term in found.terms)


def test_beside_the_best_place_a_step_is_sought_where_a_reading_was_taken_for_a_shock():
    fit = fit_base(make_data(series(clean(4))))
    fit.innovation[1_503] = 30.0
    scores = np.where(np.arange(N) == 1_499, 5.0, 0.0)

    assert _Promised(fit.theta, scores, np.ones(N), 0.0).places(fit) == {1_499, 1_503}


@pytest.mark.parametrize("seed", range(2))
def test_where_there_is_no_step_none_is_gained(seed):
    shocks = 0.05 * (seed % 2)

    assert check_step(fit_base(make_data(series(clean(seed, shocks_per_s=shocks))))).p_value > 0.01
