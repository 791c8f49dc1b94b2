"""Nats of noise that is not Gaussian or not stationary, as if innovations were independent."""

from dataclasses import replace
from math import exp, sqrt

import numpy as np
from scipy.special import erf
from scipy.stats import norm

from tests.blind.gaussian import markov_spectrum, numbers, spectrum
from tests.blind.injector import calm
from tests.blind.plant import Effect, Plant, Run

__all__ = ["innovation_kl", "louder_kl"]


def louder_kl(run: Run, effect: Effect) -> float:
    """Return the nats of noise that grows with the reading, given the input as drawn.

    Of the input is known what the readings tell, the less the more of them is noise. To second order D is half of what
    the score comes to. Noise of variance R + a, of which a follows the input x, has the score

        sum over readings of :(2 level m + m^2) r^2: / (2 R^2), times the effect's square,

    m being what all readings tell of the input's deviation and r what they leave of each reading; between colons are
    powers less whatever is Gaussian, so no plant refitted takes any of it. Where the input is known this is the mean
    square of a over 4 R^2; where it is no more than the one reading's part, the skewness of that reading. (Innovations
    that knew their input, news and all, promised 24 nats where likelihoods came to 4, of a fast input in much noise,
    and where they came to 46 and 60, of a slow one.)
    """
    plant, part = run.plant, effect.size**2
    x = calm(replace(run, plant=replace(plant, white_sd_V=0.0)))
    own, level = plant.white_sd_V**2 + part * float(np.mean(x**2)), float(x.mean())
    louder, away = part * (x**2 - np.mean(x**2)), x - level
    theta, turn = numbers(plant), 2 * np.pi * np.fft.fftfreq(x.size)
    whole = exp(theta[4]) + part * np.mean(x**2)
    for at in (0, 2):
        whole = whole + exp(theta[at]) * markov_spectrum(exp(-plant.interval_s / exp(theta[at + 1])), turn)
    left = own / whole
    r = np.fft.ifft(left * np.fft.fft(away)).real
    m = away - r
    stays = np.fft.ifft(left).real  # of a reading's noise, in what is left of it and of those about it
    goes = -stays
    goes[0] += 1
    # Noise that is louder is so in both factors of r^2, in one of r and one of m, or, where that is squared, in both.
    seen = [
        (2 * level * m + m**2, stays**2),
        (2 * (level + m) * r, 2 * stays * goes),
        (r**2, goes**2),
    ]
    told = sum(float(np.sum(of * around(louder, lag))) for of, lag in seen)
    return max(part * told / (4 * own**2), 0.0)


def around(column: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the sum, about each reading, of a column times the weights of their distances."""
    return np.fft.ifft(np.fft.fft(column) * np.fft.fft(weights)).real


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
