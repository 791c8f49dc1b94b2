"""A smoothing across gaps: what is left of the last reading is taken off, and a missing reading has no density."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

from aemd.diagnose.climb import densities
from aemd.diagnose.fit import begin_with, fit_base
from aemd.diagnose.hypothesis import Base, base_box, make_data
from aemd.diagnose.terms.noise import Smoothing
from tests.diagnose.plant import INTERVAL_S, markov, series

KEPT = 0.7


@pytest.mark.parametrize("lost", [[], [50], [50, 51, 52, 130], [*range(3, 200, 4)]])
def test_the_likelihood_across_gaps_is_that_of_the_dense_covariance_within_a_tenth_of_a_nat_for_each(lost):
    white = np.random.default_rng(8).standard_normal(200)
    y = lfilter([1 - KEPT], [1, -KEPT], white, zi=[KEPT * white[0]])[0]  # begins with the first reading itself
    data = replace(make_data(series(1e-3 * y)), aperture_s=0.0)
    scale = data.unit_V / 1e-3
    used = np.ones(y.size, dtype=bool)
    used[lost] = False
    data = data.only(used)
    theta = np.array([np.log(INTERVAL_S), -30.0, 0.0, -30.0, -np.log(scale), -data.origin_V / data.unit_V])
    terms = [Base(theta, shocks=False, box=base_box(data)), Smoothing(KEPT, 0.0)]
    each = densities(terms, np.append(theta, np.log(KEPT / (1 - KEPT))), data)

    response = np.tril((1 - KEPT) * KEPT ** np.maximum(np.subtract.outer(np.arange(200), np.arange(200)), 0))
    response[:, 0] /= 1 - KEPT
    covariance = (response @ response.T)[np.ix_(used, used)]
    expected = multivariate_normal(cov=covariance).logpdf(y[used]) + np.count_nonzero(used) * np.log(scale)

    assert each[~used].tolist() == [0.0] * len(lost)
    assert each.sum() == pytest.approx(expected, abs=0.4)


def test_a_reading_of_which_an_interval_is_known_is_never_more_than_certain():
    values = np.random.default_rng(9).standard_normal(200)
    data = make_data(series(1e-3 * values))
    data = replace(data, low=data.y - 50.0, high=data.y + 50.0)
    theta = np.array([np.log(INTERVAL_S), -30.0, 0.0, -30.0, 0.0, 0.0, np.log(KEPT / (1 - KEPT))])
    each = densities([Base(theta[:6], shocks=False, box=base_box(data)), Smoothing(KEPT, 0.0)], theta, data)

    assert each == pytest.approx(0.0, abs=1e-3)


def test_the_search_for_a_smoothing_among_loud_shocks_begins_where_it_is_likely():
    """From there a few steps lead to the top; from the spectrum of the shocks themselves they lead nowhere."""
    n = 1_500
    rng = np.random.default_rng(12)
    marks = 40.0 * (rng.random(n) < 0.004) * rng.standard_normal(n)
    y = markov(rng, n, 5.0, 3.0) + rng.standard_normal(n) + lfilter([1], [1, -np.exp(-INTERVAL_S / 0.5)], marks)
    fit = fit_base(make_data(series(1e-3 * lfilter([0.5], [1, -0.5], y))))
    term = Smoothing(0.4, 0.0)
    begun = densities([*fit.terms, term], begin_with(fit, term)[0], fit.data).sum()

    assert fit.base.shocks
    assert begun > fit.log_likelihood - 0.05 * n
