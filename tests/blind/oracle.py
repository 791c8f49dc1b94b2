"""What knowing the truth is worth: held-out nats of the true model over those of the best clean one.

As the critic's gain is defined: the record is cut into blocks that alternate between two folds; the clean model is
fitted with the blocks of a fold missing; the score is log p(test | train), which is the log-likelihood of all readings
less that of the readings without the test blocks. Of an event, all of which is told within a few readings, the folds
are four, of every fourth reading; there are no shocks here to be dealt. Each is fitted to, and scored by, the densities
of its readings given all before: a block that holds the event has nobody to learn from. The true model is not fitted
but known. Both likelihoods are written for this purpose alone: a Kalman filter whose states are the plant's two Markov
processes and the effect's own.

Readings without shocks only, which a Gaussian likelihood has no place for.
"""

from math import cos, exp, inf, log, pi, sin

import numpy as np
from numba import njit
from scipy.linalg import block_diag
from scipy.optimize import minimize

from tests.blind.certificate import KINDS, unit_template
from tests.blind.gaussian import numbers
from tests.blind.plant import Effect, Plant, Record, Run

__all__ = ["oracle_gain"]

BLOCK_S = 60.0
LEAST_BLOCKS = 20
EVENTS = ("step", "warmup_drift", "ring_down")
READINGS = 4


def oracle_gain(run: Run, effect: Effect, record: Record) -> float:
    """Return the nats by which the true model predicts held-out blocks better than a clean one, fitted to the rest."""
    plant = run.plant
    y = np.full(plant.n, np.nan)
    y[record.index] = record.value_V
    y -= plant.level_V
    block = (np.arange(plant.n) * plant.interval_s // block_s(plant)).astype(int)
    mean, noise = np.zeros(plant.n), np.ones(plant.n)
    if KINDS[effect.cause] == "mean":
        mean = effect.size * unit_template(run, effect)
        if effect.cause == "reading_pattern":
            mean = mean - mean.mean()
    if effect.cause == "changing_noise":
        part = np.arange(plant.n) / plant.n
        noise[(part >= effect.shape["begin"]) & (part < effect.shape["end"])] = effect.size**2
    true = numbers(plant)
    added = plant.white_sd_V**2 * (noise - 1)
    states = with_effect(plant, effect)
    gained = 0.0
    if effect.cause in EVENTS:
        for fold in range(READINGS):
            test = np.cumsum(np.isfinite(y)) % READINGS == fold
            clean = fitted(plant, y, ~test)
            gained += filtered(plant, true, y - mean, added, states, test)
            gained -= filtered(plant, clean[:5], y - clean[5], counted=test)
        return gained
    for fold in (0, 1):
        train = np.where(block % 2 == fold, np.nan, y)
        clean = fitted(plant, train)
        known = filtered(plant, true, y - mean, added, states) - filtered(plant, true, train - mean, added, states)
        gained += known - (filtered(plant, clean[:5], y - clean[5]) - filtered(plant, clean[:5], train - clean[5]))
    return gained


def block_s(plant: Plant) -> float:
    """Return the length of a block, s: a minute, or a twentieth of the record."""
    return max(min(BLOCK_S, plant.n * plant.interval_s / LEAST_BLOCKS), 4 * plant.interval_s)


States = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Transition, covariance at rest, and what of each a reading shows."""


def with_effect(plant: Plant, effect: Effect) -> States | None:
    """Return the states that an effect adds."""
    if effect.cause == "resonance":
        f, quality = effect.shape["frequency_hz"], effect.shape["quality"]
        keep, turn = exp(-pi * f / quality * plant.interval_s), 2 * pi * f * plant.interval_s
        seen = np.sinc(f * plant.inside * plant.step_s)
        turning = keep * np.array([[cos(turn), -sin(turn)], [sin(turn), cos(turn)]])
        return turning, np.eye(2) * (effect.size * seen) ** 2, np.array([1.0, 0.0])
    if effect.cause == "difference_noise":
        return np.array([[0.0, 0.0], [1.0, 0.0]]), np.eye(2) * effect.size**2, np.array([1.0, -1.0])
    return None


def fitted(plant: Plant, y: np.ndarray, counted: np.ndarray | None = None) -> np.ndarray:
    """Return the most likely five numbers of a clean plant and its level, of the densities that are counted."""
    start = np.append(numbers(plant), np.nanmean(y))
    scale = np.append(np.ones(5), plant.signal_sd_V)

    def loss(free: np.ndarray) -> float:
        at = free * scale
        return -filtered(plant, at[:5], y - at[5], counted=counted)

    box = [(value - 6, value + 6) for value in start[:5]] + [(-inf, inf)]
    tries = [start / scale, start / scale + np.array([0.3, -0.3, 1.0, -1.0, 0.1, 0.0])]
    best = min((minimize(loss, at, method="L-BFGS-B", bounds=box) for at in tries), key=lambda found: found.fun)
    return best.x * scale


def filtered(
    plant: Plant,
    theta: np.ndarray,
    y: np.ndarray,
    added: np.ndarray | None = None,
    effect: States | None = None,
    counted: np.ndarray | None = None,
) -> float:
    """Return the log-likelihood of readings, NaN where one is missing.

    Args:
        plant: for its interval.
        theta: its five numbers; see certificate.py.
        y: readings less their mean.
        added: variance beyond the white noise's of each, shape (n,).
        effect: states beside the plant's two.
        counted: whose densities are summed, shape (n,); those of all, where it is not given.
    """
    keeps = [exp(-plant.interval_s / exp(theta[j])) for j in (1, 3)]
    parts = [(np.diag(keeps), np.diag(np.exp(theta[[0, 2]])), np.ones(2)), *([effect] if effect else [])]
    f, rest = (block_diag(*(part[at] for part in parts)) for at in (0, 1))
    shown = np.concatenate([part[2] for part in parts])
    noise = np.full(y.size, exp(theta[4])) if added is None else exp(theta[4]) + added
    counted = np.ones(y.size, bool) if counted is None else counted
    return float(kalman(y, f, rest, rest - f @ rest @ f.T, shown, noise, counted))


@njit(cache=True)
def kalman(
    y: np.ndarray,
    f: np.ndarray,
    rest: np.ndarray,
    q: np.ndarray,
    shown: np.ndarray,
    noise: np.ndarray,
    counted: np.ndarray,
) -> float:
    x, p, total = np.zeros(shown.size), rest.copy(), 0.0
    for k in range(y.size):
        if not np.isnan(y[k]):
            c = p @ shown
            s = shown @ c + noise[k]
            e = y[k] - shown @ x
            if counted[k]:
                total -= 0.5 * (log(2 * pi * s) + e * e / s)
            x = x + c * (e / s)
            p = p - np.outer(c, c) / s
        x = f @ x
        p = f @ p @ f.T + q
    return total
