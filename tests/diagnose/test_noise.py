"""White noise that changes: the noise alone, and not what apertures average out of the processes beside it."""

from math import log

import numpy as np
import pytest

from aemd.diagnose.climb import assemble
from aemd.diagnose.given import Given
from aemd.diagnose.hypothesis import Base, base_box, make_data
from aemd.diagnose.terms.courses import BreathingNoise
from aemd.diagnose.terms.noise import ChangingNoise, SwellingNoise
from aemd.model import DifferenceNoise, GaussMarkov, Model, SupplyCoupling, WhiteNoise
from tests.diagnose.plant import INTERVAL_S, clean, series, times

N = 300
WHITE = 0.4
TURN = 2 * np.pi * 3 * times(N) / (N * INTERVAL_S)
BETWEEN = (times(N) >= 5.0) & (times(N) < 12.0)


def parts_of(*terms):
    """The filter's parts for a base with processes as fast as its apertures, and these terms as they start."""
    data = make_data(series(clean(1, N), aperture_s=0.9 * INTERVAL_S))
    theta = np.array([log(0.1), 1.5, log(60.0), -1.0, log(WHITE), 0.0])
    base = Base(theta, shocks=False, box=base_box(data))
    return assemble([base, *terms], np.concatenate((theta, *(term.start for term in terms))), data)[1]


@pytest.mark.parametrize(
    ("term", "times_louder"),
    [
        (ChangingNoise(5.0, 12.0, 3.0, 0.0), np.where(BETWEEN, 9.0, 1.0)),
        (SwellingNoise(8.0, 2.0, 3.0, 0.0), 9.0 ** np.exp(-0.5 * ((times(N) - 8.0) / 2.0) ** 2)),
        (BreathingNoise(3.0, 0.5, -0.7, 0.0), np.exp(0.5 * np.cos(TURN) - 0.7 * np.sin(TURN))),
    ],
)
def test_where_white_noise_changes_what_apertures_take_off_stays(term, times_louder):
    steady, changed = parts_of(), parts_of(term)

    assert (steady.noise_var < 0).all()  # apertures take off more than the white noise is
    assert changed.noise_var - steady.noise_var == pytest.approx(WHITE**2 * (times_louder - 1))
    assert (changed.scale == 1).all()


def test_beside_a_stated_model_too_what_apertures_take_off_stays():
    data = make_data(series(clean(1, N), aperture_s=0.9 * INTERVAL_S, witnesses={"supply": 5 + 0.1 * np.sin(TURN)}))
    walk = GaussMarkov(role="internal", rate_V_per_rt_s=1e-2, tau_s=10.0)
    gain = SupplyCoupling(coefficient_per_V=0.3, sd_V=0.1, tau_s=10.0, mean_V=5.0)
    white = WhiteNoise.from_sd(1e-3, 0.9 * INTERVAL_S)
    louder = ChangingNoise(5.0, 12.0, 3.0, 0.0)
    steady, changed = (
        assemble(
            [Given(Model((walk, white), 1, (gain, DifferenceNoise(sd_V=1e-4))), 0.9 * INTERVAL_S), *terms],
            np.array([log(3.0)] * len(terms)),
            data,
        )[1].noise_var
        for terms in ((), (louder,))
    )

    expected = (1e-3 / data.unit_V * (1 + 0.03 * np.sin(TURN))) ** 2 * np.where(BETWEEN, 8.0, 0.0)
    assert changed - steady == pytest.approx(expected)


def test_where_everything_changes_so_does_what_apertures_take_off():
    steady, changed = parts_of(), parts_of(ChangingNoise(5.0, 12.0, 3.0, 0.0, everything=True))

    assert changed.noise_var == pytest.approx(steady.noise_var * np.where(BETWEEN, 9.0, 1.0))
    assert changed.scale == pytest.approx(np.where(BETWEEN, 3.0, 1.0))
