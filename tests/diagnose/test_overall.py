"""A stated model that expects too much noise, or too little, does not stand, whatever its colour."""

from dataclasses import replace

import numpy as np
import pytest

from aemd import model
from aemd.diagnose import criticise
from aemd.diagnose.given import Given
from tests.diagnose.plant import series

WHITE = model.Model((model.Level(level_V=1.0), model.WhiteNoise.from_sd(1e-3, 0.02)))


@pytest.mark.parametrize(("times", "stands"), [(1.0, True), (1.08, False), (0.92, False)])
def test_white_noise_of_another_size_than_stated_is_seen(times, stands):
    """Of 4,000 readings the variance is known to 2.2 %, so 8 % of amplitude are 7 deviations."""
    y = 1.0 + times * 1e-3 * np.random.default_rng(5).standard_normal(4000)
    found = criticise(replace(series(y), aperture_s=0.02), stated=(Given(WHITE), frozenset()))

    assert (found.verdict == "nothing_found") is stands
    assert any(item.check.startswith("variance of the residuals") for item in found.discrepancies) is not stands
