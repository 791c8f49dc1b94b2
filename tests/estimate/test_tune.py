"""Tuning: what is put into readings is found in them, and a model file gives back what was written."""

import math

import numpy as np
import pytest

from aemd.block import Block, Status, make_block
from aemd.errors import ConfigError
from aemd.estimate.tune import Kind, noise_of, tune

T = 0.1


def markov(rng: np.random.Generator, sd: float, tau_s: float, n: int) -> np.ndarray:
    """First-order Markov process (eq. 2), from its stationary law."""
    keep = math.exp(-T / tau_s)
    x = np.empty(n)
    x[0] = rng.normal(0, sd)
    for k, step in enumerate(rng.normal(0, sd * math.sqrt(1 - keep**2), n - 1), start=1):
        x[k] = keep * x[k - 1] + step
    return x


def shocks(rng: np.random.Generator, n: int, quiet_s: float, disturbed_s: float, sd: float) -> np.ndarray:
    """Abrupt disturbances of a two-state Markov chain."""
    mode, x = 0, np.zeros(n)
    for k in range(n):
        mode ^= int(rng.uniform() < 1 - math.exp(-T / (disturbed_s if mode else quiet_s)))
        x[k] = mode * rng.normal(0, sd)
    return x


def test_what_was_put_in_is_found() -> None:
    rng, n = np.random.default_rng(1), 6000
    slow, fast = markov(rng, 2e-3, 400.0, n), markov(rng, 1e-3, 0.8, n)
    readings = 5.0 + fast + slow + shocks(rng, n, 10.0, 1.0, 50e-3) + rng.normal(0, 0.2e-3, n)

    found = tune([make_block(readings)], T, origin_V=5.0)

    assert str(found.kind) == "markov + slow"
    # Of 6,000 readings some 5,400 are quiet; the widths are about three times the scatter over seeds.
    assert found.options.noise_V == pytest.approx(0.2e-3, rel=0.15)
    assert found.options.signal_V[0] == pytest.approx(1e-3, rel=0.15)
    assert found.options.signal_tau_s[0] == pytest.approx(0.8, rel=0.35)
    assert found.options.disturbed_V == pytest.approx(50e-3, rel=0.15)
    assert found.options.quiet_s == pytest.approx(10.0, rel=0.5)
    assert found.options.disturbed_s == pytest.approx(1.0, rel=0.5)
    rate = found.options.slow_V * math.sqrt(2 / found.options.slow_tau_s)
    assert rate == pytest.approx(2e-3 * math.sqrt(2 / 400.0), rel=0.3)
    assert found.readings == n


def test_a_sine_is_found_as_a_swing_of_its_frequency() -> None:
    rng, n = np.random.default_rng(2), 1000
    readings = 1e-3 * np.sin(2 * np.pi * 0.37 * T * np.arange(n)) + rng.normal(0, 1e-4, n)

    found = tune([make_block(readings)], T, origin_V=0.0)

    assert found.kind == Kind(("swing",), slow=False)
    # Cramer and Rao: sqrt(24) sigma / (A N^1.5) radians per reading; four of those
    bound_hz = math.sqrt(24) * 0.1 / n**1.5 / (2 * math.pi * T)
    assert found.options.signal_hz[0] == pytest.approx(0.37, abs=4 * bound_hz)
    assert found.options.noise_V == pytest.approx(1e-4, rel=0.1)


def test_what_only_drifts_is_no_input() -> None:
    rng, n = np.random.default_rng(4), 1500
    readings = markov(rng, 1e-3, 60.0, n) + rng.normal(0, 1e-4, n)

    found = tune([make_block(readings)], T, origin_V=0.0)

    assert found.kind == Kind((), slow=True)
    assert found.options.signal_V[0] < 0.1 * found.options.noise_V


def test_a_log_keeps_a_slow_part_and_follows_its_noise_even_if_the_stretch_did_neither() -> None:
    readings = 10.0 + np.random.default_rng(5).normal(0, 1e-6, 1000)

    found = tune([make_block(readings)], T, slow="input")

    assert found.kind.slow
    assert found.options.slow == "input"
    assert found.options.variance_memory_s <= 1000 * T
    assert found.options.origin_V == pytest.approx(10.0, abs=1e-6)


def test_the_log_likelihood_is_that_of_a_gaussian_where_there_is_nothing_else() -> None:
    readings = np.random.default_rng(6).normal(0, 1e-3, 3000)

    found = tune([make_block(readings)], T, origin_V=0.0)

    gaussian = -0.5 * math.log(2 * math.pi * math.e * np.mean(readings**2))
    assert found.log_likelihood == pytest.approx(gaussian, abs=0.005)


def test_volts_and_seconds_are_only_units() -> None:
    rng, n = np.random.default_rng(7), 1000
    readings = markov(rng, 1e-3, 0.8, n) + rng.normal(0, 1e-4, n)
    kinds = [Kind(("markov",), slow=False)]

    small = tune([make_block(readings)], T, origin_V=0.0, kinds=kinds).options
    large = tune([make_block(1e6 * readings)], 50 * T, origin_V=0.0, kinds=kinds).options

    assert large.noise_V == pytest.approx(1e6 * small.noise_V, rel=1e-3)
    assert large.signal_V[0] == pytest.approx(1e6 * small.signal_V[0], rel=1e-3)
    assert large.signal_tau_s[0] == pytest.approx(50 * small.signal_tau_s[0], rel=1e-3)


def test_lost_and_flagged_readings_are_no_obstacle() -> None:
    rng, n = np.random.default_rng(8), 2000
    block = make_block(markov(rng, 1e-3, 0.8, n) + rng.normal(0, 1e-4, n))
    block["value_V"][300:310] = np.nan
    block["status"][300:310] = Status.OVERLOAD_HIGH
    block = np.delete(block, slice(700, 750))

    found = tune([block], T, origin_V=0.0, noise_V=1e-4, kinds=[Kind(("markov",), slow=False)])

    assert found.readings == n - 60
    assert found.options.noise_V == pytest.approx(1e-4)
    assert found.options.signal_V[0] == pytest.approx(1e-3, rel=0.2)


def test_the_noise_is_found_under_drift_and_shocks() -> None:
    rng, n = np.random.default_rng(9), 4000
    drift = 5e-3 * np.sin(2 * np.pi * np.arange(n) / 400)
    readings = drift + rng.normal(0, 17e-6, n)
    readings[::97] += 4e-3

    # 4,000 third differences, of which a shock spoils four; a standard deviation to 2 % is three of its own
    assert noise_of(make_block(readings)) == pytest.approx(17e-6, rel=0.05)


def test_too_little_is_refused() -> None:
    few, flat = make_block(np.arange(50.0)), make_block(np.full(500, 2.5))

    with pytest.raises(ConfigError, match="50 readings with a value: too few to tune by, at least 100"):
        tune([few], T)
    with pytest.raises(ConfigError, match=r"all 500 readings are 2\.5 V: nothing to tune by"):
        tune([flat], T)
    with pytest.raises(ConfigError, match="0 readings"):
        tune([], T)
    with pytest.raises(ConfigError, match="0 readings"):
        tune([make_block(np.linspace(1e299, 1e300, 200))], T)
    with pytest.raises(ConfigError, match="all 200 readings are 0 V: nothing to tune by"):
        tune([make_block(np.append(np.zeros(199), 1e-300))], T)
    with pytest.raises(ConfigError, match="too few, at least 100"):
        noise_of(few)


def block_of(readings: np.ndarray, first_index: int) -> Block:
    return make_block(readings, first_index=first_index)


def test_independent_stretches_count_together() -> None:
    rng = np.random.default_rng(10)
    parts = [block_of(markov(rng, 1e-3, 0.8, 500) + rng.normal(0, 1e-4, 500), first) for first in (0, 10_000, 0)]

    found = tune(parts, T, origin_V=0.0, kinds=[Kind(("markov",), slow=False)])

    assert found.readings == 1500
    assert found.options.signal_V[0] == pytest.approx(1e-3, rel=0.25)
