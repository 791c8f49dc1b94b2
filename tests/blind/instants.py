"""What rings after a shock whose instant nobody knows: between two readings it may have come at any time."""

from math import ceil, exp, pi

import numpy as np

from tests.blind.gaussian import Disturbances, numbers, whitened
from tests.blind.plant import Effect, Plant, Run, make_world

__all__ = ["cost_of_instants", "ringing"]

INSTANTS = 8
"""Of an interval; with fewer than two for each turn of the wave the true one would lie between them."""
FORGOTTEN = 12.0  # decays


def ringing(run: Run, effect: Effect, beside: Disturbances) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the whitened energies of one unit of each shock's wave; shape (shocks,), and (shocks, INSTANTS) of others.

    In turn: of the wave as it is; of the same wave times those that would have followed had the shock come at other
    instants of its interval; of those. Who reads a file knows a shock by the readings after it, so earlier ones were
    as much larger as they faded, and each rings in proportion to what it was.
    """
    plant, theta = run.plant, numbers(run.plant)
    aperture_s, own, across, tried = plant.inside * plant.step_s, [], [], []
    for time_s, size_V in make_world(run).shocks:
        at = ceil((time_s - aperture_s) / plant.interval_s)  # the first reading that does not end before it
        if at >= plant.n - 1:
            continue
        ended_s = max(at, 0) * plant.interval_s + aperture_s
        true = whitened(theta, plant, wave(plant, effect, time_s, size_V), beside)
        own.append(true @ true)
        across.append([])
        tried.append([])
        for part in (np.arange(INSTANTS) + 0.5) / INSTANTS:
            other_s = ended_s - part * plant.interval_s
            faded = exp((time_s - other_s) / plant.shock_decay_s)
            other = whitened(theta, plant, wave(plant, effect, other_s, size_V * faded), beside)
            across[-1].append(true @ other)
            tried[-1].append(other @ other)
    return np.array(own), np.array(across), np.array(tried)


def wave(plant: Plant, effect: Effect, time_s: float, size_V: float) -> np.ndarray:
    """Return the mean over each aperture of a damped sine that begins at an instant, in closed form."""
    turn = complex(-1 / effect.shape["decay_s"], 2 * pi * effect.shape["frequency_hz"])
    begin_s = np.arange(plant.n) * plant.interval_s - time_s
    aperture_s = plant.inside * plant.step_s
    heard = (begin_s + aperture_s > 0) & (begin_s < FORGOTTEN * effect.shape["decay_s"])
    begin_s = begin_s[heard]
    out = np.zeros(plant.n)
    edges = np.exp(turn * (begin_s + aperture_s)) - np.exp(turn * np.maximum(begin_s, 0.0))
    out[heard] = size_V * (edges / turn).imag / aperture_s
    return out


def cost_of_instants(own: np.ndarray, across: np.ndarray, tried: np.ndarray, size: float) -> float:
    """Return the nats that a known instant is worth, over all shocks.

    Known, a wave w is worth w'w/2; unknown, the logarithm of the mean, over the instants, of the likelihood ratio of
    each one's wave v, which at the readings' mean is e^(w'v - v'v/2).
    """
    if not own.size:
        return 0.0
    ratio = size**2 * (across - tried / 2)
    most = ratio.max(axis=1)
    unknown = most + np.log(np.mean(np.exp(ratio - most[:, None]), axis=1))
    return float(np.sum(size**2 * own / 2 - unknown))
