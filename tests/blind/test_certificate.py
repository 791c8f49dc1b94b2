"""The certificates of a changed mean: what shocks and losses take of it, against the dense covariance."""

from dataclasses import replace

import numpy as np
import pytest

from tests.blind.gaussian import disturbances, energy, numbers
from tests.blind.made import USUAL
from tests.blind.plant import Run, add_shock, make_world

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
