"""What a name is weighed with beside the likelihood of its term."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from aemd.diagnose.checks.witnessed import gains_like_noise
from aemd.diagnose.fit import fit_base, refit, residuals
from aemd.diagnose.hypothesis import Base, base_box, make_data
from aemd.diagnose.naming import _does_not_fit, left_out
from aemd.diagnose.terms.noise import HeavyTails, SignalDependentNoise
from aemd.diagnose.terms.shapes import Nonlinearity
from tests.diagnose.plant import INTERVAL_S, N, clean, series

GAIN, NEWS_V = 0.1, 0.1


def white_plant():
    """Readings x + 0.1 x e of a white x about 1 V, and the base that describes x."""
    rng = np.random.default_rng(41)
    x = 1.0 + NEWS_V * rng.standard_normal(N)
    y = x * (1 + GAIN * rng.standard_normal(N))
    data = make_data(series(1.0 + np.hypot(NEWS_V, GAIN) * (y - y.mean()) / y.std()))  # as after a fit
    data = replace(data, aperture_s=0.0)  # or nothing of so fast an x would be left
    tau_s = 0.01 * INTERVAL_S
    rate = np.log(NEWS_V / data.unit_V * np.sqrt(2 / tau_s))
    level = (1.0 - data.origin_V) / data.unit_V
    base = Base(np.array([np.log(tau_s), rate, 0.0, -20.0, -9.0, level]), shocks=False, box=base_box(data))
    return data, base


def test_the_skewness_that_the_filter_leaves_out_is_what_the_exact_density_gains():
    """Exact: the mean over x of N(y; x, (0.1 x)^2), by a sum over its grid."""
    data, base = white_plant()
    term = SignalDependentNoise(GAIN, 0.0)
    y = data.y * data.unit_V + data.origin_V
    grid = 1.0 + NEWS_V * np.linspace(-5, 5, 401)
    weights = norm.pdf(grid, 1.0, NEWS_V) * (grid[1] - grid[0])
    exact = np.log(norm.pdf(y[:, None], grid, GAIN * grid) @ weights)
    plain = norm.logpdf(y, 1.0, np.hypot(NEWS_V, GAIN))

    owed = left_out([base, term], np.concatenate((base.start, term.start)), data)

    assert owed > 10
    assert owed == pytest.approx(float(np.sum(exact - plain)), rel=0.2)


def test_news_that_lift_no_reading_take_nothing_from_the_name():
    """The same spread without skewness, as of a meter's own noise that the base's fast process stands for."""
    data, base = white_plant()
    even = norm.ppf(np.random.default_rng(42).permutation(np.arange(1, N + 1) / (N + 1)))
    data = replace(data, y=(1.0 + np.hypot(NEWS_V, GAIN) * even - data.origin_V) / data.unit_V)
    term = SignalDependentNoise(GAIN, 0.0)

    assert 0 <= left_out([base, term], np.concatenate((base.start, term.start)), data) < 1


def test_of_other_names_nothing_is_left_out():
    data, base = white_plant()
    term = Nonlinearity(0.01, 0.0)

    assert left_out([base, term], np.concatenate((base.start, term.start)), data) == 0.0


def test_of_readings_about_nothing_the_noise_tells_how_a_gain_follows_the_supply():
    n = 1_500
    supply = np.sin(np.arange(n) / 40.0)
    fit = fit_base(make_data(series((clean(5, n) - 1.0) * (1 + 0.4 * supply), witnesses={"supply": supply})))
    (gain,) = gains_like_noise(fit)

    assert gain.coefficient == pytest.approx(0.4, abs=0.12)


@pytest.mark.parametrize(("outliers", "refused"), [(2, True), (12, False)])
def test_outliers_that_come_twice_are_no_law(outliers, refused):
    """The deviation of what such have more is hardly known: of two it is open from half to six times (chi-square)."""
    n = 1_000
    rng = np.random.default_rng(43)
    y = rng.standard_normal(n)
    y[rng.choice(n, outliers, replace=False)] += np.where(np.arange(outliers) % 2, 14.0, -11.0)
    data = make_data(series(1e-3 * y))
    unit = data.unit_V / 1e-3
    still = np.array([np.log(INTERVAL_S), -12.0, np.log(60.0), -12.0, -np.log(unit), 0.0])
    base = Base(still, shocks=False, box=tuple((value, value) for value in still))
    term = HeavyTails(0.01, 10 / unit, 0.0)

    found = refit([base, term], data)
    why = _does_not_fit(residuals([base], base.start, data), found)

    assert np.exp(found.theta[-2]) * n == pytest.approx(outliers, rel=0.4)
    assert why.startswith("which would come again and again") == refused
    assert bool(why) == refused
