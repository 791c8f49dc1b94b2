"""A ring is measured by the shock at its instant, which no reading shows, and not by what a reading shows of it."""

from functools import cache

import numpy as np
import pytest

from aemd.diagnose import instants
from aemd.diagnose.checks.rings import likely_marks
from aemd.diagnose.engine import _tables
from aemd.diagnose.fit import refit, residuals
from aemd.diagnose.hypothesis import Base, base_box, make_data
from aemd.diagnose.instants import rings
from aemd.diagnose.intervals import covariance, describe
from aemd.diagnose.terms.events import RingDown
from tests.diagnose.plant import INTERVAL_S, series

PITCH_HZ, RING_S, RATIO = 4.0, 1.2, 0.15
SHOCK_S = 0.6 * INTERVAL_S
LOUD_HZ, LOUD_S, LOUD = 3.0, 1.5, 0.5


def struck(rng, n, sizes, shock_s, wave):
    """Return the fit of white noise of deviation 1 with shocks at any instants and what follows them."""
    t_s = np.arange(n) * INTERVAL_S
    y = rng.standard_normal(n)
    for time_s, size in zip(rng.uniform(0, t_s[-1], sizes.size), sizes, strict=True):
        since = np.maximum(t_s - time_s, 0.0)
        y += size * (since > 0) * (np.exp(-since / shock_s) + wave(since))
    data = make_data(series(1e-3 * y))
    unit = data.unit_V / 1e-3
    still = [np.log(INTERVAL_S), -12.0, np.log(5 * INTERVAL_S), -12.0]
    law = np.log([sizes.size / t_s[-1], sizes.std() / unit, shock_s])
    box = (*((value, value) for value in still), *base_box(data)[4:], (-6.0, 0.0), (0.0, 6.0), (-6.0, 2.0))
    return refit([Base(np.array([*still, -np.log(unit), 0.0, *law]), shocks=True, box=box)], data)


def with_ring(base, *begun):
    """Return the fit with a ring, from a pitch, a decay and two amplitudes on."""
    marks = likely_marks(base)
    assert marks is not None
    return refit([base.base, RingDown(marks, *begun, 0.0)], base.data)


@cache
def rung(seed):
    """Return the fit of 12 shocks that ring, in closed form."""
    rng = np.random.default_rng(seed)
    base = struck(
        rng,
        1_500,
        15 * rng.standard_normal(12),
        SHOCK_S,
        lambda since: RATIO * np.exp(-since / RING_S) * np.sin(2 * np.pi * PITCH_HZ * since),
    )
    return with_ring(base, PITCH_HZ + 0.02, 1.0, (0.05, 0.05))


@cache
def loud():
    """Return the fit of a loud ring after 4 shocks of about 20 deviations, and their sizes."""
    rng = np.random.default_rng(0)
    sizes = 20 * rng.choice([-1.0, 1.0], 4) * rng.uniform(0.7, 1.3, 4)
    base = struck(
        rng, 1_000, sizes, 0.6, lambda since: LOUD * np.exp(-since / LOUD_S) * np.sin(2 * np.pi * LOUD_HZ * since)
    )
    return with_ring(base, LOUD_HZ, 0.3, (0.05, 0.1)), sizes


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


@pytest.mark.parametrize("deviations", [1.0, 5.0])
def test_a_loud_ring_that_is_fitted_far_too_short_is_found_as_it_is(deviations):
    """A wave of one angle tells a short piece of several; whatever deviation it has, it does not tell the ring's.

    As wide as an interval is at least: of e^(-t/d), its amplitude known, the logarithm of d has the information
    sum of a^2 d/(8 h) in white noise of deviation 1, h from reading to reading; half of that where it is not known.
    """
    fit, sizes = loud()
    spread = covariance(fit)
    spread[9:11, 9:11] *= deviations**2
    told = describe(fit, 1, spread)
    information = np.sum((LOUD * sizes) ** 2) * LOUD_S / (8 * INTERVAL_S)
    wide = np.log(told["decay_s"].high / told["decay_s"].low) / (2 * 1.96)

    assert np.exp(fit.parts_of(1)[0]) < 0.5 * LOUD_S
    for name, true in (("decay_s", LOUD_S), ("frequency_hz", LOUD_HZ), ("ratio", LOUD)):
        assert told[name].low < true < told[name].high
    assert 0.8 / np.sqrt(information) < wide < 1.4 / np.sqrt(information / 2)


def test_a_ring_that_is_fitted_as_two_halves_is_told_whole():
    fit, spread = rung(0), covariance(rung(0))
    half = fit.parts_of(1) * np.array([1.0, 1.0, 0.5, 0.5])
    theta = np.concatenate((fit.parts_of(0), half, half))
    halves = residuals([*fit.terms, fit.terms[1]], theta, fit.data)

    assert np.median(rings(halves, 1, spread)["ratio"]) == pytest.approx(np.median(rings(fit, 1, spread)["ratio"]))


def test_where_no_grid_is_about_the_ring_nothing_is_drawn(monkeypatch):
    monkeypatch.setattr(instants, "_GRIDS", 1)
    fit, _ = loud()

    assert rings(fit, 1, covariance(fit)) is None


def test_the_ring_that_is_written_is_the_one_that_is_reported():
    tables = _tables(rung(0), 0.0, {0: {}, 1: describe(rung(0), 1, covariance(rung(0)))})
    (shocks,) = [term for term in tables["terms"] if term["term"] == "shocks"]
    told = tables["parameters"]["1_ring_down"]

    assert shocks["ring_fraction"] == told["ratio"].value
    assert shocks["ring_hz"] == told["frequency_hz"].value
    assert shocks["ring_decay_s"] == told["decay_s"].value
    assert told["decay_s"].low < RING_S < told["decay_s"].high
