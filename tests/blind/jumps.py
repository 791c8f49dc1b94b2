"""What it costs not to know when a level jumped: all paths of two levels, each as likely as the readings make it."""

from math import exp, log

import numpy as np
from numba import njit

from tests.blind.gaussian import Disturbances, numbers
from tests.blind.plant import Effect, Plant

__all__ = ["path_cost"]

PATHS = 12
"""That are carried from one reading to the next; those that differ by less than CLOSE deviations are one."""
CLOSE = 0.1
TWINS = 1
"""Pairs of noise that is drawn; one of each pair is the other's negative, so that what is linear in it drops out."""


def path_cost(path: np.ndarray, effect: Effect, plant: Plant, beside: Disturbances) -> float:
    """Return the mean of the logarithm of the readings' density, the path known, over that of all paths together.

    The path is drawn, the noise is averaged over. Beside a large jump other instants are possible that fit as well, and
    of a small one it is not sure that there was any: ln(stay/interval) + 1 for each jump is what it costs to know
    exactly those of the path, and more than it costs not to know them.
    """
    theta = numbers(plant)
    keeps = (exp(-plant.interval_s / exp(theta[1])), exp(-plant.interval_s / exp(theta[3])), beside.fade)
    levels = (path > 0.5).astype(np.int64)
    jump = -np.expm1(-2 * plant.interval_s / effect.shape["dwell_s"]) / 2
    rng, costs = np.random.default_rng(15), []
    for _ in range(TWINS):
        noise = draw_noise(rng, plant.n, keeps, np.exp(theta[[0, 2, 4]]), beside)
        for sign in (1.0, -1.0):
            of_path, of_all = two_levels(
                *(sign * noise + effect.size * levels, levels, effect.size, jump, np.array(keeps)),
                *(np.exp(theta[[0, 2, 4]]), beside.kept, beside.mark_var, beside.part),
            )
            costs.append(of_path - of_all)
    return float(np.mean(costs))


def draw_noise(
    rng: np.random.Generator, n: int, keeps: tuple[float, float, float], variances: np.ndarray, beside: Disturbances
) -> np.ndarray:
    """Return readings of the clean plant, with its shocks at their instants and of chance marks."""
    noise = np.sqrt(variances[2]) * rng.standard_normal(n)
    struck = np.sqrt(beside.mark_var) * rng.standard_normal(n)
    x1, x2 = np.sqrt(variances[:2]) * rng.standard_normal(2)
    kicks = np.sqrt(variances[:2] * (1 - np.square(keeps[:2]))) * rng.standard_normal((n, 2))
    x3 = 0.0
    for k in range(n):
        noise[k] += x1 + x2 + x3 + beside.part[k] * struck[k]
        x1, x2, x3 = keeps[0] * x1 + kicks[k, 0], keeps[1] * x2 + kicks[k, 1], keeps[2] * (x3 + struck[k])
    return noise


@njit(cache=True)
def two_levels(
    y: np.ndarray,
    levels: np.ndarray,
    size: float,
    jump: float,
    keeps: np.ndarray,
    variances: np.ndarray,
    kept: np.ndarray,
    mark_var: np.ndarray,
    part: np.ndarray,
) -> tuple[float, float]:
    """Return the logarithms of the density of readings given these levels, and given that they jump at a rate.

    Both without what is the same in both. A path's past is in the means of the states alone: what is not known of
    these is the same for all paths, since a level that is known only shifts them.
    """
    p = np.diag(np.array([variances[0], variances[1], 0.0]))
    x = np.zeros((2 * PATHS, 3))
    at = np.zeros(2 * PATHS, np.int64)
    weight = np.full(2 * PATHS, -np.inf)
    at[1], weight[0], weight[1] = 1, log(0.5), log(0.5)
    count, known, of_path, of_all = 2, np.zeros(3), 0.0, 0.0
    for k in range(y.size):
        if k:
            for j in range(count):
                x[count + j], at[count + j] = x[j], 1 - at[j]
                weight[count + j] = weight[j] + log(jump)
                weight[j] += log(1 - jump)
            count *= 2
        if kept[k]:
            c = np.array([p[0].sum(), p[1].sum(), p[2].sum()])
            s = c.sum() + part[k] ** 2 * mark_var[k] + variances[2]
            c[2] += part[k] * mark_var[k]
            e = y[k] - known.sum() - size * levels[k]
            of_path -= e * e / s / 2
            known = known + c / s * e
            most = -np.inf
            for j in range(count):
                e = y[k] - x[j].sum() - size * at[j]
                weight[j] -= e * e / s / 2
                x[j] += c / s * e
                most = max(most, weight[j])
            total = 0.0
            for j in range(count):
                total += np.exp(weight[j] - most)
            of_all += most + np.log(total)
            weight[:count] -= most + np.log(total)
            p[2, 2] += mark_var[k]
            p = p - np.outer(c, c) / s
        else:
            p[2, 2] += mark_var[k]
        order, left = np.argsort(-weight[:count]), 0
        for j in order:  # the likeliest first; what lies beside one that is kept is counted with it
            new = True
            for i in range(left):
                near = at[order[i]] == at[j]
                for state in range(2):
                    near = near and abs(x[order[i], state] - x[j, state]) < CLOSE * np.sqrt(p[state, state])
                if near:
                    weight[order[i]] = np.logaddexp(weight[order[i]], weight[j])
                    new = False
                    break
            if new and left < PATHS:
                order[left] = j
                left += 1
        chosen = order[:left].copy()
        x[:left], at[:left], weight[:left] = x[chosen], at[chosen], weight[chosen]
        count = left
        known = known * keeps
        x[:count] *= keeps
        p = p * np.outer(keeps, keeps)
        p[0, 0] += (1 - keeps[0] ** 2) * variances[0]
        p[1, 1] += (1 - keeps[1] ** 2) * variances[1]
    return of_path, of_all
