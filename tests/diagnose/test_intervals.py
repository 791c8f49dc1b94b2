"""An interval ends where the likelihood has fallen, and not where a parabola says it would have."""

import numpy as np
import pytest
from scipy.optimize import brentq

from aemd.diagnose.fit import refit
from aemd.diagnose.hypothesis import Base, base_box, make_data
from aemd.diagnose.intervals import covariance, describe
from aemd.diagnose.terms.shapes import WarmUp
from tests.diagnose.plant import INTERVAL_S, series, times


def profile_ends(y: np.ndarray, t_s: np.ndarray, tau_s: float) -> list[float]:
    """Where n/2 log(least squares) has risen by 1.96^2 / 2, level and amplitude being free: white noise's own."""

    def squares(log_tau: float) -> float:
        shapes = np.column_stack((np.ones(t_s.size), np.exp(-t_s / np.exp(log_tau))))
        return float(np.sum((y - shapes @ np.linalg.lstsq(shapes, y, rcond=None)[0]) ** 2))

    tried = np.log(tau_s) + np.linspace(-2, 2, 401)
    top = tried[np.argmin([squares(value) for value in tried])]

    def beyond(log_tau: float) -> float:
        return y.size / 2 * np.log(squares(log_tau) / squares(top)) - 1.96**2 / 2

    return [float(np.exp(brentq(beyond, top, top + side * 2.5))) for side in (-1.0, 1.0)]


def test_the_interval_of_a_short_time_constant_has_the_ends_of_its_profile():
    rng, n = np.random.default_rng(4), 1_000
    t_s = times(n)
    y = rng.standard_normal(n) + 1.6 * np.exp(-t_s / 1.5)
    data = make_data(series(1e-3 * y))
    u = data.unit_V / 1e-3
    theta = np.array([np.log(INTERVAL_S), -12.0, np.log(5 * INTERVAL_S), -12.0, np.log(1 / u), 0.0])
    still = tuple(
        (value, value) if number < 4 else bound
        for number, (value, bound) in enumerate(zip(theta, base_box(data), strict=True))
    )
    fit = refit([Base(theta, shocks=False, box=still), WarmUp(1.5, 1.6 / u, 0.0)], data)

    told = describe(fit, 1, covariance(fit))["tau_s"]

    low, high = profile_ends(y, t_s, 1.5)
    assert told.low == pytest.approx(low, rel=0.15)
    assert told.high == pytest.approx(high, rel=0.15)
