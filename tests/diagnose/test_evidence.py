"""The laws that p-values are taken from, against closed forms."""

from math import exp, sqrt

import numpy as np
import pytest
from scipy.stats import chi2

from aemd.diagnose.evidence import weighted_chi2_tail


@pytest.mark.parametrize("count", [3, 30, 300])
@pytest.mark.parametrize("deviations", [1.0, 3.0, 6.0])
def test_the_tail_of_equal_weights_is_chi_squares(count, deviations):
    observed = deviations * sqrt(2 * count)

    assert weighted_chi2_tail(np.ones(count), observed) == pytest.approx(chi2.sf(observed + count, count), rel=0.02)


@pytest.mark.parametrize("weights", [(1.0, 1.0), (3.0, 0.5), (0.5, 2.0), (0.3, 3.0)])
@pytest.mark.parametrize("wanted", [0.01, 1e-3, 1e-6])
def test_the_tail_of_a_difference_of_two_exponentials_is_its_own(weights, wanted):
    """P(2 a E - 2 b F - 2 a + 2 b > x) = a/(a + b) e^(-(x + 2 a - 2 b)/(2 a)): the skewed ones have no gamma law."""
    a, b = weights
    p_value = min(wanted, 0.5 * a / (a + b))
    x = 2 * b - 2 * a - 2 * a * np.log(p_value * (a + b) / a)

    assert p_value == pytest.approx(a / (a + b) * exp(-(x + 2 * a - 2 * b) / (2 * a)))
    assert weighted_chi2_tail(np.array([a, -b]), x, dof=2) == pytest.approx(p_value, rel=0.15)


def test_beyond_the_greatest_sum_there_is_nothing():
    assert weighted_chi2_tail(-np.ones(4), 4.1) == 0.0
