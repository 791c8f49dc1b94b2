"""An interval ends where the likelihood has fallen, and not where a parabola says it would have."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

from aemd.diagnose.fit import refit, residuals
from aemd.diagnose.hypothesis import Base, Parameter, base_box, make_data
from aemd.diagnose.intervals import covariance, describe
from aemd.diagnose.mixture import Weighed
from aemd.diagnose.terms.ranges import RangeOffset
from aemd.diagnose.terms.shapes import ReadingPattern, WarmUp
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


def test_the_ends_of_a_mixture_leave_their_share_of_both_laws():
    mixed = Weighed(np.array([0.7, 0.3]), np.array([[0.0], [5.0]]), np.array([[[1.0]], [[4.0]]]))
    low, high = mixed.ends(Parameter("level_V", "V", lambda v: float(v[0]), positive=False), 0.025)

    for end, share in ((low, 0.025), (high, 0.975)):
        assert 0.7 * norm.cdf(end) + 0.3 * norm.cdf((end - 5) / 2) == pytest.approx(share, abs=1e-9)


def still_base(y: np.ndarray, white_V: float = 1e-3) -> tuple[Base, np.ndarray]:
    """White noise of a known deviation and nothing else: all of the base is held but its level."""
    data = make_data(series(1e-3 * y))
    theta = np.array([np.log(INTERVAL_S), -12.0, np.log(5 * INTERVAL_S), -12.0, np.log(white_V / data.unit_V), 0.0])
    box = tuple(
        (value, value) if at < 5 else bound for at, (value, bound) in enumerate(zip(theta, base_box(data), strict=True))
    )
    return Base(theta, shocks=False, box=box), theta


def test_the_interval_of_the_largest_difference_reaches_farther_down():
    """Of three offsets the lower two are equal, and differ by a deviation of 0.2 2^0.5.

    So the lower of them is too low on average by 0.2 pi^-0.5, and half of that is what the interval's middle lies below
    the estimate.
    """
    rng, n = np.random.default_rng(5), 300
    base, theta = still_base(rng.standard_normal(n))
    data = make_data(series(1e-3 * rng.standard_normal(n)))
    spread = np.zeros((8, 8))
    spread[6:, 6:] = 0.04 * (np.eye(2) - 1 / 3)  # of means of as many readings each, balanced
    fit = residuals([base, ReadingPattern(3, (1.0, -0.5), 0.0)], np.append(theta, [1.0, -0.5]), data)

    told = describe(fit, 1, spread)["amplitude_V"]

    assert told.value == pytest.approx(0.75 * data.unit_V)
    assert told.value - (told.low + told.high) / 2 == pytest.approx(0.1 / np.sqrt(np.pi) * data.unit_V, rel=0.3)


def test_an_offset_leaves_its_hole_room_for_the_threshold():
    """The offset is the hole less two spacings of readings; so the law of what it lacks is a gamma law of two.

    The interval ends where 2.5 % of that law lack more, and at the other end with the estimate, which is the hole.
    """
    rng, n = np.random.default_rng(6), 2_000
    x = np.cumsum(rng.standard_normal(n)) * 0.05 + rng.standard_normal(n)
    y = x + 2.0 * (x >= 0.5)
    data = make_data(series(1e-3 * y))
    hole = np.sort(data.y)
    at = int(np.argmax(np.diff(hole)))
    term = RangeOffset(float(hole[at]), float(hole[at + 1]), True, 0.0)
    base, theta = still_base(y, white_V=1.5e-3)
    fit = refit([base, term], data, np.append(theta, 1.0))
    told = describe(fit, 1, covariance(fit))["offset_V"]

    def lost(part: float) -> float:
        return fit.log_likelihood - residuals([base, term], np.append(fit.theta[:-1], part), data).log_likelihood

    width_V, slope = (term.high - term.low) * data.unit_V, lost(0.999) / 0.001

    assert told.high == pytest.approx(width_V, rel=1e-9)
    assert (1 - told.low / width_V) * slope == pytest.approx(5.572, rel=0.1)
