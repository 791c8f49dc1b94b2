"""The certificates of a changed mean: what shocks and losses take of it, against the dense covariance."""

from dataclasses import replace

import numpy as np
import pytest

from tests.blind.certificate import d_nats
from tests.blind.gaussian import disturbances, energy, numbers
from tests.blind.injector import template
from tests.blind.instants import cost_of_instants, ringing, wave
from tests.blind.made import USUAL
from tests.blind.plant import Effect, Run, add_shock, make_world

PLANT = replace(USUAL, n=300)


def test_shocks_at_known_instants_and_lost_readings_are_part_of_the_covariance():
    plant = replace(PLANT, shocks_per_s=0.3, shock_sd_V=3e-3, shock_decay_s=0.2, lost_fraction=0.1)
    run = Run(plant, seed=11)
    world, theta = make_world(run), numbers(plant)
    lag = np.abs(np.subtract.outer(np.arange(plant.n), np.arange(plant.n))) * plant.interval_s
    covariance = np.exp(theta[0] - lag / np.exp(theta[1])) + np.exp(theta[2] - lag / np.exp(theta[3]))
    covariance += np.exp(theta[4]) * np.eye(plant.n)
    for at_s, _ in world.shocks:
        shock = np.zeros(world.t.size)
        add_shock(world, shock, at_s, plant.shock_sd_V)
        column = world.read(shock)
        covariance += np.outer(column, column)
    kept = ~(world.rng("lost").random(plant.n) < plant.lost_fraction)
    mean = np.cos(2.0 * np.arange(plant.n)) + (np.arange(plant.n) > 150)
    inverse = np.linalg.inv(covariance[np.ix_(kept, kept)])
    a, b = mean[kept], np.ones(int(kept.sum()))

    expected = a @ inverse @ a - (a @ inverse @ b) ** 2 / (b @ inverse @ b)
    assert len(world.shocks) > 3
    assert kept.sum() < plant.n
    assert energy(theta, plant, mean, disturbances(run)) == pytest.approx(expected, rel=5e-3)
    assert energy(theta, plant, mean) > 1.05 * expected


def test_without_shocks_and_losses_nothing_else_happens():
    beside, theta = disturbances(Run(PLANT, seed=3)), numbers(PLANT)
    mean = np.sin(0.7 * np.arange(PLANT.n))

    assert beside.kept.all()
    assert not beside.mark_var.any()
    assert energy(theta, PLANT, mean, beside) == pytest.approx(energy(theta, PLANT, mean), rel=1e-12)


def test_a_bend_of_white_readings_is_known_by_their_skewness():
    """6 b s of skewness, whose score has the variance 6/n: a D of 3 n b^2 s^2, a third of it in the mean of x^2."""
    plant = replace(PLANT, n=3000, signal_sd_V=1e-9, drift_rate_V_per_rt_s=1e-12, level_V=0.0)
    bend = 0.05 / plant.white_sd_V

    expected = 3 * plant.n * 0.05**2
    assert d_nats(Run(plant, seed=2), Effect("nonlinearity", bend)) == pytest.approx(expected, rel=0.1)


def test_a_slow_decay_is_taken_by_a_drift_that_becomes_a_random_walk():
    plant = replace(
        PLANT,
        n=5000,
        interval_s=0.06712,
        signal_sd_V=1e-3,
        signal_tau_s=1.98,
        drift_tau_s=68.0,
        drift_rate_V_per_rt_s=0.82e-3 / np.sqrt(34.0),
        white_sd_V=0.32e-3,
    )
    run, effect = Run(plant, seed=5), Effect("warmup_drift", 6e-3, {"tau_s": 100.0})
    plain = energy(numbers(plant), plant, effect.size * template(run, effect)) / 2
    wandering = numbers(plant) + np.array([0.0, 0.0, 4.0, 4.0, 0.0])  # of the same speed, forgotten 55 times later
    left = energy(wandering, plant, effect.size * template(run, effect)) / 2

    assert left < 0.6 * plain
    assert d_nats(run, effect) < left + 3


def test_who_does_not_know_when_shocks_came_knows_less_of_a_fast_wave_after_them():
    plant = replace(PLANT, n=600, shocks_per_s=0.3, shock_sd_V=9e-3, shock_decay_s=0.3)
    run = Run(plant, seed=11)
    fast, slow = (Effect("ring_down", 1.0, {"frequency_hz": hz, "decay_s": 1.0}) for hz in (6.0, 1.0))
    beside = disturbances(run)
    own = ringing(run, fast, beside)[0]
    waves = sum(wave(plant, fast, time_s, size_V) for time_s, size_V in make_world(run).shocks)

    assert waves == pytest.approx(template(run, fast), abs=2e-2 * np.abs(template(run, fast)).max())
    assert own.size > 5
    assert cost_of_instants(own, np.tile(own[:, None], 8), np.tile(own[:, None], 8), 0.1) == pytest.approx(0, abs=1e-9)
    costs = [cost_of_instants(*ringing(run, effect, beside), 0.1) for effect in (slow, fast)]
    assert 0 < costs[0] < costs[1] < 0.1**2 * own.sum() / 2
