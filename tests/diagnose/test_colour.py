"""What is left of a noise's colour, where the base has begun to imitate it, still finds it its name."""

import numpy as np
import pytest

from aemd.diagnose.checks import colour
from aemd.diagnose.fit import residuals
from aemd.diagnose.hypothesis import Base, base_box, make_data
from tests.diagnose.plant import N, series


def rising(seed: int) -> np.ndarray:
    """White noise of deviation 1 and differences of white noise of deviation 0.3: 1 + 0.09 * 4 sin^2(w/2)."""
    rng = np.random.default_rng(seed)
    return 1.0 + 1e-3 * (rng.standard_normal(N) + 0.3 * np.diff(rng.standard_normal(N + 1)))


def test_a_process_that_is_not_there_is_not_taken_out_of_what_is_tested():
    """Fitted or not, a rate of e^-12 adds nothing, and a time constant of a reading shows nearly the rise's shape."""
    data = make_data(series(rising(1)))
    level = np.log(np.std(data.y))
    theta = np.array([np.log(data.interval_s), -12.0, np.log(5 * data.interval_s), -12.0, level, 0.0])
    fit = residuals([Base(theta, shocks=False, box=base_box(data))], theta, data)
    rises = colour.check_colour(fit)[0]

    # (power - 1) against 0.36 sin^2 / 1.18 less its mean: its deviation 0.36 / 1.18 / sqrt(8), over n/2 frequencies.
    assert rises.observed == pytest.approx(0.36 / 1.18 / np.sqrt(8) * np.sqrt(N / 2), abs=3)
    assert rises.p_value < 1e-3
