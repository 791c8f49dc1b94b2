"""Nats of noise that is not Gaussian or not stationary, as if innovations were independent."""

from dataclasses import replace
from math import exp, sqrt

import numpy as np
from scipy.special import erf
from scipy.stats import norm

from tests.blind.gaussian import numbers, spectrum
from tests.blind.injector import calm
from tests.blind.plant import Effect, Plant, Run

__all__ = ["innovation_kl", "louder_kl"]


def louder_kl(run: Run, effect: Effect) -> float:
    """Return the nats of noise that grows with the reading, given the readings as drawn.

    Each innovation's variance against their mean, which a refitted plant has for all. What counts is how much the slow
    part of the input moves against its level, and a record of a few turns of it may move much or little.
    """
    plant = run.plant
    variance = exp(float(np.mean(np.log(spectrum(numbers(plant), plant)))))
    each = variance + effect.size**2 * calm(replace(run, plant=replace(plant, white_sd_V=0.0))) ** 2
    return 0.5 * float(np.sum(np.log(np.mean(each) / each)))


def uneven_kl(plant: Plant, bias: float, struck: float, sd: float) -> float:
    """Return nats per reading of shocks whose signs are uneven, with innovations of a deviation when there is none.

    A reading is struck or not, nobody says which, and of a shock smaller than the noise nobody knows the sign. What it
    shows is its mark, faded since its instant, an even choice in the interval before. The clean plant nearest to it is
    the even part of its density, since what is odd only changes its sign with the innovation. What a shock leaves in
    the readings after it is left out, which for a slow one is a little more.
    """
    faded = plant.shock_sd_V * np.exp(-(np.arange(20) + 0.5) / 20 * plant.interval_s / plant.shock_decay_s)[:, None]
    whole = np.sqrt(sd**2 + faded**2)
    reach = 8 * float(whole.max())
    grid = np.sort(np.concatenate((np.linspace(-reach, reach, 1601), np.linspace(-8 * sd, 8 * sd, 1601))))
    marked = norm.pdf(grid, scale=whole)
    even = (1 - struck) * norm.pdf(grid, scale=sd) + struck * marked.mean(axis=0)
    odd = bias * struck * (marked * erf(grid * faded / (sqrt(2) * sd * whole))).mean(axis=0)
    uneven = np.maximum(even + odd, 0.0)
    told = np.log(np.maximum(uneven, 1e-300) / np.maximum(even, 1e-300))
    return float(np.trapezoid(uneven * told, grid))


def innovation_kl(plant: Plant, effect: Effect, shocks: int) -> float:
    """Return nats per reading of shocks whose signs are uneven."""
    variance = exp(float(np.mean(np.log(spectrum(numbers(plant), plant)))))  # of one innovation (Kolmogorov)
    return uneven_kl(plant, effect.size, shocks / plant.n, sqrt(variance))
