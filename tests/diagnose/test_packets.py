"""A wave that comes once, anywhere, against what rings after a shock."""

import numpy as np
import pytest
from scipy.signal import lfilter

from aemd.diagnose.checks.local import best_packets
from aemd.diagnose.checks.rings import check_ring_down
from aemd.diagnose.fit import fit_base
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.naming import name
from tests.diagnose.plant import INTERVAL_S, clean, series, times

N = 1_600
LOUD_V, STRUCK_AT = 30e-3, 800


def struck(seed):
    """Readings with 12 shocks, one of them louder than all others together."""
    rng = np.random.default_rng([seed, 6])
    marks = np.bincount(rng.choice(N - 100, 12, replace=False), 4e-3 * rng.standard_normal(12), N)
    marks[STRUCK_AT] = LOUD_V
    return clean(seed, N) + lfilter([1], [1, -np.exp(-INTERVAL_S / 0.2)], marks)


def wave(since_s, hz, fades_s):
    return np.where(since_s > 0, np.exp(-since_s / fades_s) * np.sin(2 * np.pi * hz * since_s), 0.0)


def named(y):
    fit = fit_base(make_data(series(y)))
    rings = check_ring_down(fit)[0].terms
    assert rings
    return name(fit, [rings[0], *best_packets(fit)], 4.0)


def test_a_bells_place_width_and_frequency_are_found():
    since_s = times(N) - 60.0
    y = clean(3, N) + 3e-3 * np.exp(-0.5 * (since_s / 2.0) ** 2) * np.cos(2 * np.pi * 3.1 * since_s)
    bell = next(packet for packet in best_packets(fit_base(make_data(series(y)))) if not packet.begins)

    assert bell.at_s == pytest.approx(60.0, abs=2.0)
    assert bell.frequency_hz == pytest.approx(3.1, abs=0.1)
    assert 0.5 < bell.width_s / 2.0 < 2.0


def test_what_rings_after_one_loud_shock_keeps_its_name():
    """The other shocks' rings are far below what can be told."""
    ringing = 0.2 * LOUD_V * wave(times(N) - STRUCK_AT * INTERVAL_S, 2.3, 1.0)

    found = named(struck(4) + ringing)

    assert found.names[0] == "ring_down"
    assert not found.refused


def test_a_wave_that_begins_before_a_loud_shock_is_not_what_rings_after_it():
    since_s = times(N) - STRUCK_AT * INTERVAL_S
    bell = 3e-3 * np.exp(-0.5 * ((since_s - 1.0) / 2.0) ** 2) * np.cos(2 * np.pi * 2.3 * since_s)

    assert named(struck(4) + bell).refused
