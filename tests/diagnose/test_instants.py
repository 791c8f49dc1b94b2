"""A ring is measured by the shock at its instant, which no reading shows, and not by what a reading shows of it."""

from functools import cache

import numpy as np

from aemd.diagnose.checks.rings import likely_marks
from aemd.diagnose.fit import refit
from aemd.diagnose.hypothesis import Base, base_box, make_data
from aemd.diagnose.instants import rings
from aemd.diagnose.intervals import covariance, describe
from aemd.diagnose.terms.events import RingDown
from tests.diagnose.plant import INTERVAL_S, series

PITCH_HZ, RING_S, RATIO = 4.0, 1.2, 0.15
SHOCK_S = 0.6 * INTERVAL_S


@cache
def rung(seed):
    """Return the fit of white noise of deviation 1 with 12 shocks at any instants, which ring; in closed form."""
    rng, n = np.random.default_rng(seed), 1_500
    t_s = np.arange(n) * INTERVAL_S
    y = rng.standard_normal(n)
    for time_s, size in zip(rng.uniform(0, t_s[-1], 12), 15 * rng.standard_normal(12), strict=True):
        since = np.maximum(t_s - time_s, 0.0)
        wave = np.exp(-since / SHOCK_S) + RATIO * np.exp(-since / RING_S) * np.sin(2 * np.pi * PITCH_HZ * since)
        y += size * (since > 0) * wave
    data = make_data(series(1e-3 * y))
    unit = data.unit_V / 1e-3
    still = [np.log(INTERVAL_S), -12.0, np.log(5 * INTERVAL_S), -12.0]
    theta = np.array([*still, -np.log(unit), 0.0, np.log(12 / t_s[-1]), np.log(9 / unit), np.log(SHOCK_S)])
    box = (*((value, value) for value in still), *base_box(data)[4:], (-6.0, 0.0), (0.0, 6.0), (-6.0, 0.0))
    base = refit([Base(theta, shocks=True, box=box)], data)
    marks = likely_marks(base)
    assert marks is not None
    term = RingDown(marks, PITCH_HZ + 0.02, 1.0, (0.05, 0.05), 0.0)
    return refit([base.base, term], data)


def test_the_numbers_of_a_ring_are_those_of_a_shock_at_its_instant():
    """Of 18 intervals of 95 % 15 or more hold in 998 of 1,000 times, and their middles are not shifted."""
    truth, held, apart = {"frequency_hz": PITCH_HZ, "decay_s": RING_S, "ratio": RATIO}, 0, []
    for seed in range(6):
        fit = rung(seed)
        told = describe(fit, 1, covariance(fit))
        held += sum(told[name].low <= true <= told[name].high for name, true in truth.items())
        assert all(one.low < one.value < one.high for one in told.values())
        apart.append(np.log(told["ratio"].value / RATIO))

    assert held >= 15
    assert abs(np.mean(apart)) < 0.2


def test_of_another_term_nothing_is_drawn():
    assert rings(rung(0), 0, covariance(rung(0))) is None
