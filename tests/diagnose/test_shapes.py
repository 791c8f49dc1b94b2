"""A bent scale is undone exactly, and a gain and an offset that a witness brings are told apart where they can be."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

from aemd.diagnose import criticise
from aemd.diagnose.climb import densities
from aemd.diagnose.hypothesis import Base, base_box, make_data
from aemd.diagnose.terms.shapes import Nonlinearity, straight
from tests.diagnose.plant import INTERVAL_S, N, clean, markov, series

BENDS = (0.3, -0.3, 1e-9)


@pytest.mark.parametrize("bend", BENDS)
def test_a_bent_scale_is_undone_where_it_has_slope_and_goes_on_evenly_where_it_has_none(bend):
    x = np.linspace(-1.2, 1.2, 401)  # 1 + 2 b x >= 0.28
    found, slope = straight(x + bend * x**2, bend)
    beyond, least = straight(np.sign(-bend) * np.array([2.0, 3.0, 4.0]) / max(abs(bend), 0.3), bend)

    assert found == pytest.approx(x, abs=1e-12)
    assert slope == pytest.approx(1 / (1 + 2 * bend * x))
    if abs(bend) > 0.1:
        assert least == pytest.approx(4.0)
        assert np.diff(beyond) == pytest.approx(4.0 * np.sign(-bend) / abs(bend))


@pytest.mark.parametrize("bend", BENDS)
def test_the_density_of_a_bent_reading_is_that_of_the_straight_one_times_the_slope(bend):
    """And nothing of a reading that is left out."""
    data = make_data(series(clean(4)))
    data = data.only(np.arange(N) % 7 != 3)
    base = Base(np.array([0.0, -1.0, 3.0, -3.0, -0.3, 0.1]), shocks=False, box=base_box(data))
    y, slope = straight(data.y, bend)

    plain = densities([base], base.start, replace(data, y=y))
    bent = densities([base, Nonlinearity(0.0, 0.0)], np.append(base.start, bend), data)

    assert bent == pytest.approx(np.where(data.used, plain + np.log(slope), 0.0))
    assert not bent[~data.used].any()


@pytest.mark.parametrize("bend", [0.2, -0.2])
def test_of_a_bent_reading_known_by_an_interval_the_straight_intervals_probability_counts(bend):
    """Of white noise of deviation 0.8; every third interval is open on one side or the other."""
    rng = np.random.default_rng(12)
    x = 0.8 * np.clip(rng.standard_normal(90), -1.6, 1.6)
    ends = np.sort(x[:, None] + rng.uniform(-0.5, 0.5, (90, 2)), axis=1)
    bent, data = ends + bend * ends**2, make_data(series(1.0 + 1e-3 * x))
    low, high = (
        np.where(np.arange(90) % 6 == at, side * np.inf, bent[:, end]) for at, side, end in ((1, -1, 0), (4, 1, 1))
    )
    theta = np.array([np.log(INTERVAL_S), -30.0, 0.0, -30.0, np.log(0.8), 0.0])
    base = Base(theta, shocks=False, box=((-40.0, 40.0),) * 6)

    told = densities([base, Nonlinearity(0.0, 0.0)], np.append(theta, bend), replace(data, low=low, high=high))

    def straightened(end: float) -> float:
        if np.isinf(end):
            return end
        return float(brentq(lambda one: one + bend * one**2 - end, -2.2, 2.2))  # on the branch that rises

    probability = [
        norm.cdf(straightened(b) / 0.8) - norm.cdf(straightened(a) / 0.8) for a, b in zip(low, high, strict=True)
    ]
    assert told == pytest.approx(np.log(probability), abs=1e-6)


def with_supply(*, gain, level_V):
    """Readings with a supply that couples by 0.4 mV, as a gain or as an offset."""
    rng = np.random.default_rng(2021)
    supply = 5 + 0.1 * markov(rng, N, 10.0, 1.0)
    value = level_V + clean(21)
    apart = supply - supply.mean()
    value = value * (1 + 4e-3 / value.mean() * apart) if gain else value + 4e-3 * apart
    return criticise(series(value, witnesses={"supply": supply}))


def test_a_gain_on_a_still_level_has_one_name_with_an_offset_and_is_told_first_of_a_supply():
    """What moves is a hundredth of the level, so of D some ten thousandths tell them apart, and of 60 nats nothing."""
    (finding,) = with_supply(gain=True, level_V=1.0).findings

    assert finding.names == ("supply_coupling",)
    told = finding.parameters
    assert told["coefficient_per_V"].low < 2e-3 < told["coefficient_per_V"].high  # of a level of 2 V
    assert told["coefficient_V_per_V"].low < 4e-3 < told["coefficient_V_per_V"].high


def test_what_is_let_through_of_a_supply_is_called_so_and_extends_the_model():
    """Of readings about 0 V a gain would leave hardly anything."""
    diagnosis = with_supply(gain=False, level_V=-1.0)
    (finding,) = diagnosis.findings
    told = finding.parameters["coefficient_V_per_V"]

    assert finding.names == ("supply_coupling",)
    assert finding.probability > 0.95
    assert told.low < 4e-3 < told.high
    assert told.unit == "V/V"
    (effect,) = diagnosis.extended_model["effects"]
    assert effect["coefficient_V_per_V"] == pytest.approx(told.value)
    assert effect["coefficient_per_V"] == 0
