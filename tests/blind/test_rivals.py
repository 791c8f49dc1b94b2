"""How far one name is from another, against what theory says."""

from dataclasses import replace

import numpy as np
import pytest

from tests.blind.plant import Effect, Plant, Run, make_world, supply
from tests.blind.rivals import noisy_rivals, rival_nats

PLANT = Plant(
    n=2000,
    interval_s=0.1,
    aperture_s=0.01,
    signal_sd_V=1e-3,
    signal_tau_s=1.0,
    drift_rate_V_per_rt_s=1e-5,
    drift_tau_s=100.0,
    white_sd_V=1e-3,
    witness=True,
)


def with_level(level_V):
    return Run(replace(PLANT, level_V=level_V), seed=5)


def test_a_gain_that_follows_the_supply_is_told_from_a_late_offset_of_it():
    """At once an offset has the gain's name, also where the level dwarfs what moves and they are the same readings."""
    far = rival_nats(with_level(1.0), Effect("supply_coupling", 0.05))
    near = rival_nats(with_level(0.0), Effect("supply_coupling", 20.0))

    assert far is not None
    assert near is not None
    assert far[1] == "latency"  # of one reading, which is late at each edge of the load
    assert 1 < far[0] < 10
    assert near[0] > 30


def test_a_bent_scale_of_white_noise_leaves_a_rival_noise_its_skewness():
    """y = e + b e^2 of white e of variance S has the skewness 6 b sqrt(S); n/12 of its square are 3 n b^2 S nats."""
    white = replace(PLANT, signal_sd_V=1e-9, drift_rate_V_per_rt_s=1e-12)
    run = Run(white, seed=6)
    bend = 30.0

    left = min(nats for nats, _ in noisy_rivals(run, Effect("nonlinearity", bend), lambda y: y / white.white_sd_V))

    assert left == pytest.approx(3 * white.n * (bend * white.white_sd_V) ** 2, rel=0.05)


def test_a_noise_that_follows_the_level_takes_of_a_bent_scale_what_makes_it_louder():
    """Of a slow x, far from 0 V, the noise's shape (L + x)^2 is that of the slope; about 0 V it is x^2."""
    slow = replace(PLANT, signal_tau_s=20.0, white_sd_V=1e-4)
    effect = Effect("nonlinearity", 5.0)

    def left(level_V):
        run = Run(replace(slow, level_V=level_V), seed=7)
        return {name: nats for nats, name in noisy_rivals(run, effect, lambda y: np.zeros(y.size))}

    assert left(1.0)["signal_dependent_noise"] < left(0.0)["signal_dependent_noise"]


def test_rivals_of_what_the_readings_make_are_written_for_each():
    run = with_level(2e-3)
    assert np.ptp(supply(make_world(run))) > 0
    for effect in (
        Effect("nonlinearity", 20.0),
        Effect("supply_coupling", 5.0),
        Effect("range_switching", 3e-4, {"part": 0.7}),
    ):
        found = rival_nats(run, effect)

        assert found is not None
        assert found[0] > 0
        assert found[1] != effect.cause
