"""A model that fits leaves residuals that stay as they are all along the record, and one that does not is told."""

from dataclasses import replace

import numpy as np
import pytest

from aemd.diagnose import criticise
from aemd.diagnose.fit import fit_base, residuals
from aemd.diagnose.goodness import FITS, check_steadiness, leaves_a_line, leaves_a_wave, share_a_period
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.terms.events import PeriodicGlitch
from aemd.diagnose.terms.lines import Sines
from aemd.diagnose.terms.noise import Resonance
from tests.diagnose.plant import INTERVAL_S, N, clean, series, times

MET_WITH_HUMPS = [33, 6]
"""A seed at which humps were called a bent scale."""


@pytest.fixture(scope="module")
def fit():
    return fit_base(make_data(series(clean(3))))


def drawn(fit, z):
    return replace(fit, z=z)


def test_independent_normal_residuals_are_doubted_no_more_than_stated(fit):
    """Of 200, at most 2 are expected below 1 %; seven or more have a probability of half a percent."""
    rng = np.random.default_rng(8)
    low = [check_steadiness(drawn(fit, rng.standard_normal(N))).p_value < FITS for _ in range(200)]

    assert sum(low) < 7


def test_records_of_the_base_are_doubted_no_more_than_stated():
    """Of 16, one in six tries has one below 1 %; two or more have a probability of one percent."""
    fits = [
        fit_base(make_data(series(clean(seed, shocks_per_s=shocks_per_s))))
        for seed in range(1, 9)
        for shocks_per_s in (0.0, 0.2)
    ]

    assert sum(check_steadiness(fit).p_value < FITS for fit in fits) < 2


def louder(z):
    """Half as loud again in a third of the record."""
    return z * np.where(np.arange(N) % N < N // 3, 1.25, 1.0)


def linked(z):
    """Neighbours that share a fifth in the first half, and have the reverse in the second."""
    signs = np.where(np.arange(N) < N // 2, 0.15, -0.15)
    return z + signs * np.roll(z, 1)


def slow(z):
    """A slow wave for a fifth of the record."""
    inside = (times() > 100) & (times() < 160)
    return z + 0.8 * inside * np.sin(2 * np.pi * times() / 12.0)


@pytest.mark.parametrize("change", [louder, linked, slow])
def test_what_comes_and_goes_is_told(fit, change):
    z = np.random.default_rng(9).standard_normal(N)

    assert check_steadiness(drawn(fit, z)).p_value > 10 * FITS
    assert check_steadiness(drawn(fit, change(z))).p_value < FITS


def with_period(fit, line_hz, period_s):
    line = Sines("periodic_interference", line_hz, 1.0, (1,), (1.0, 0.0), 0.0)
    train = PeriodicGlitch(period_s, 1.0, 0.3, 1.0, 0.0)
    theta = np.concatenate((fit.theta, line.start, train.start))
    return replace(fit, terms=(*fit.terms, line, train), theta=theta)


def test_pulses_with_a_line_on_their_period_are_one_wave(fit):
    span_s = N * INTERVAL_S

    assert share_a_period(with_period(fit, 1.0, 3.0), 1)
    assert share_a_period(with_period(fit, 1.0, 3.0), 2)
    assert not share_a_period(with_period(fit, 1.0 + 2 / span_s, 3.0), 2)
    assert not share_a_period(with_period(fit, 3.0, 3.0), 2)
    assert not share_a_period(fit, 0)


def test_what_a_train_of_pulses_leaves_at_its_own_period_is_told(fit):
    z = np.random.default_rng(10).standard_normal(N)
    trains = with_period(fit, 1.0, 3.0)
    wave = 0.15 * np.sin(2 * np.pi * 2 * times() / 3.0)

    assert not leaves_a_wave(drawn(trains, z), 2)
    assert leaves_a_wave(drawn(trains, z + wave), 2)
    assert not leaves_a_wave(drawn(trains, z + wave), 1)


def test_a_resonance_that_leaves_a_line_in_its_band_may_be_some_lines(fit):
    """D = A^2 n / 4 = 40 nats, where one of the band's 40 cells exceeds 13 in ten thousandths of cases."""
    term = Resonance(2.0, 5.0, 5.0, 1.0, 0.0)
    resonant = residuals([*fit.terms, term], np.concatenate((fit.theta, term.start)), fit.data)
    z = np.random.default_rng(13).standard_normal(N)
    inside, outside = (0.2 * np.sin(2 * np.pi * hz * times()) for hz in (2.05, 3.0))

    assert not leaves_a_line(drawn(resonant, z), 1)
    assert leaves_a_line(drawn(resonant, z + inside), 1)
    assert not leaves_a_line(drawn(resonant, z + outside), 1)
    assert not leaves_a_line(drawn(resonant, z + inside), 0)


def test_a_sawtooth_is_neither_a_line_nor_pulses():
    y = clean(6) + 0.5e-3 * (2 * (times() / 3.3 % 1) - 1)
    findings = criticise(series(y)).findings

    assert findings
    assert all("unexplained" in f.names for f in findings)


def test_two_humps_are_no_bent_scale():
    """A bend explains some of them, where the drift has swallowed the rest; a hump of its own explains more."""
    bells = sum(np.exp(-(((times() - at) / 3.0) ** 2)) for at in (101.0, 115.0))
    findings = criticise(series(clean(MET_WITH_HUMPS) + 23e-3 * bells)).findings

    assert findings
    assert all(f.cause == "unexplained" for f in findings)


def test_a_louder_noise_is_named_beside_a_line_that_would_have_coloured_it():
    """The line is left in the residuals when the noise is named, and taken off them afterwards."""
    n = 4000
    rng = np.random.default_rng(31)
    inside = (np.arange(n) >= 1200) & (np.arange(n) < 3000)
    louder = 0.6e-3 * inside * rng.standard_normal(n)
    line = 0.3e-3 * np.sin(2 * np.pi * 3.1 * times(n))
    findings = criticise(series(clean(32, n) + louder + line)).findings

    assert {f.cause for f in findings} == {"changing_noise", "periodic_interference"}
