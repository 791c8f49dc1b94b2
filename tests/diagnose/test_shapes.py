"""A bent scale is undone exactly, and a gain and an offset that a witness brings are told apart where they can be."""

from dataclasses import replace

import numpy as np
import pytest

from aemd.diagnose import criticise
from aemd.diagnose.climb import densities
from aemd.diagnose.hypothesis import Base, base_box, make_data
from aemd.diagnose.terms.shapes import Nonlinearity, straight
from tests.diagnose.plant import N, clean, markov, series

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


def with_supply(*, gain, level_V):
    """Readings with a supply that couples by 0.4 mV, as a gain or as an offset."""
    rng = np.random.default_rng(2021)
    supply = 5 + 0.1 * markov(rng, N, 10.0, 1.0)
    value = level_V + clean(21)
    apart = supply - supply.mean()
    value = value * (1 + 4e-3 / level_V * apart) if gain else value + 4e-3 * apart
    (finding,) = criticise(series(value, witnesses={"supply": supply})).findings
    return finding.names


def test_a_gain_on_a_still_level_is_in_one_set_with_an_offset_and_first_of_a_supply():
    """What moves is a hundredth of the level, so of D some ten thousandths tell them apart, and of 60 nats nothing."""
    assert with_supply(gain=True, level_V=1.0) == ("supply_coupling", "thermal_drift")
