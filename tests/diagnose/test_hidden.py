"""What is still known of readings that a defect hides."""

import numpy as np
import pytest

from aemd.diagnose.checks.integrity import check_raw
from aemd.diagnose.engine import criticise
from aemd.diagnose.hidden import hidden
from tests.diagnose.plant import clean, series


@pytest.mark.parametrize(("steps", "known"), [(0.5, False), (2.5, True)])
def test_of_coarsely_rounded_readings_an_interval_is_known_and_fine_rounding_is_noise(steps, known):
    made = series(np.round(np.random.default_rng(1).standard_normal(1_000) / steps) * steps)
    defects = check_raw(made, 1.0)
    _, interval = hidden(made, defects, frozenset(), rounded=False)

    assert [defect.cause for defect in defects] == ["quantisation"]
    assert (interval is not None) == known


def test_what_rounds_coarsely_has_no_companions():
    """By their density, readings that stay in a cell are worth thousands of nats to a mixture of noises."""
    value = clean(11, 1_500, shocks_per_s=0.02)
    told = criticise(series(np.round(value / 2e-3) * 2e-3))

    assert [finding.cause for finding in told.findings] == ["quantisation"]


def test_what_is_clipped_was_above_the_upper_end_or_below_the_lower_one():
    value = clean(6, 2_000)
    low, high = np.quantile(value, [0.03, 0.96])
    made = series(np.clip(value, low, high))
    dropped, interval = hidden(made, check_raw(made, 1e-3), frozenset(), rounded=False)

    assert not dropped.any()
    assert interval is not None
    np.testing.assert_array_equal(interval[0] == -np.inf, value <= low)
    np.testing.assert_array_equal(interval[1] == np.inf, value >= high)
