"""A level that jumps between two: its D, by readings that are drawn and the densities of all histories of them.

D = E[log p(readings | plant with the level)] - E[log p(readings | the best plant without it)], and neither half is that
of a known mean. Who does not know when the level jumped sums over its paths. And the best plant without it is none
without shocks: of steps of about three deviations, many enough, a plant that is struck often and recovers slowly makes
most, also where the true one is never struck. A D whose best plant was Gaussian called 30 nats what came to 5 to 20 on
plants without shocks. On plants with shocks it came to 15 to 65: there the shocks' instants were taken for known, one
law of shocks can hardly be both, and by the means of a dozen paths alone small jumps cost more than need be.

So both halves are means over drawn readings, by one filter that knows no instants: for each level and each of the last
readings it keeps what is known if the last jump or shock was then (mean and covariance; histories that are older are
one). Of the true half three such ages are within 0.3 nats of twelve. The plant without the level is fitted to the
readings with all its numbers, shocks and level, each fit begun as the plant is and as its jumps would be if they were
shocks. Shocks fade within a fiftieth of the record or 30 readings, whichever is longer, as the plant under criticism
has them: what fades more slowly is a step.
"""

from math import exp, log

import numpy as np
from numba import njit
from scipy.optimize import minimize
from scipy.signal import lfilter

from tests.blind.gaussian import Disturbances, numbers, spectrum
from tests.blind.plant import Effect, Plant

__all__ = ["jumps_nats", "plain_jump"]

TWINS = 2
"""Pairs of noise that is drawn; one of each pair is the other's negative, so that what is linear in it drops out. Of D
= 30 other pairs make some 4 nats more or less."""
AGES = 3
FEW, MOST = 10, 40  # steps of a fit from each start, and from the best of them
NEGLIGIBLE = 1e-7  # probability of a history from which it is dropped
SLOWEST, SLOWEST_READINGS = 0.02, 30.0


def jumps_nats(path: np.ndarray, effect: Effect, plant: Plant, beside: Disturbances) -> float:
    """Return D of a level that jumps, its path as drawn and the noise averaged over.

    Of so few readings the fit takes half a nat for each number, shared by the pairs, which is given back.
    """
    unit_V, theta = plant.signal_sd_V, numbers(plant)
    theta[[0, 2, 4]] -= 2 * log(unit_V)
    size, jump = effect.size / unit_V, -np.expm1(-2 * plant.interval_s / effect.shape["dwell_s"]) / 2
    keeps, variances = fades(theta, plant, plant.shock_decay_s), np.exp(theta[[0, 2, 4]])
    struck, mark_var = -np.expm1(-plant.interval_s * plant.shocks_per_s), (plant.shock_sd_V / unit_V) ** 2
    rng = np.random.default_rng([plant.n, *np.flatnonzero(np.diff(path > 0.5))])  # one for all would err alike in all
    drawn = list[np.ndarray]()
    for _ in range(TWINS):
        noise = draw_noise(rng, plant.n, keeps, variances, beside, unit_V)
        drawn += [sign * noise + size * (path > 0.5) for sign in (1.0, -1.0)]
    true = [log_density(y, beside.kept, size, jump, struck, mark_var, keeps, variances, AGES) for y in drawn]
    starts = [as_shocks(theta, effect, plant)]
    if plant.shocks_per_s:
        own = [log(plant.shocks_per_s), log(plant.shock_sd_V / unit_V), log(plant.shock_decay_s)]
        starts.append(np.array([*theta, size / 2, *own]))
    return float(np.mean(true)) - best_plant(starts, drawn, beside.kept, plant) + starts[0].size / (2 * TWINS)


def plain_jump(plant: Plant) -> float:
    """Return the height, V, of jumps that are seen, but not each: 2.5 deviations of the innovation."""
    return float(2.5 * np.exp(np.mean(np.log(spectrum(numbers(plant), plant))) / 2))


def best_plant(starts: list[np.ndarray], drawn: list[np.ndarray], kept: np.ndarray, plant: Plant) -> float:
    """Return the most that a plant without the level makes of readings, the mean of their log densities."""
    span_s, begin = plant.n * plant.interval_s, starts[-1]
    slowest_s = max(SLOWEST * span_s, SLOWEST_READINGS * plant.interval_s)
    box = [(value - 6, value + 6) for value in begin[:5]]
    box += [(-1e3, 1e3), (log(0.1 / span_s), log(0.5 / plant.interval_s)), (log(1e-2), log(1e3))]
    box.append((log(plant.interval_s / 2), log(slowest_s)))

    def lost(values: np.ndarray) -> float:
        struck = -np.expm1(-plant.interval_s * exp(values[6]))
        keeps = fades(values, plant, exp(values[8]))
        variances, mark_var = np.exp(values[[0, 2, 4]]), exp(2 * values[7])
        left = (log_density(y - values[5], kept, 0.0, 0.0, struck, mark_var, keeps, variances, 1) for y in drawn)
        return -float(np.mean(list(left)))

    def fit(start: np.ndarray, steps: int) -> tuple[float, np.ndarray]:
        start = np.clip(start, *np.array(box).T)
        found = minimize(lost, start, method="L-BFGS-B", bounds=box, options={"maxiter": steps, "ftol": 1e-6})
        return float(found.fun), found.x

    if len(starts) > 1:
        _, begin = min((fit(start, FEW) for start in starts), key=lambda one: one[0])
    return -fit(begin, MOST)[0]


def as_shocks(theta: np.ndarray, effect: Effect, plant: Plant) -> np.ndarray:
    """Return numbers of a plant whose shocks are the jumps: up or down, fading before the next."""
    dwell_s, size = effect.shape["dwell_s"], effect.size / plant.signal_sd_V
    return np.array([*theta, size / 2, log(2 / dwell_s), log(1.5 * size), log(dwell_s / 2)])


def fades(theta: np.ndarray, plant: Plant, decay_s: float) -> np.ndarray:
    """Return what is left of signal, drift and shocks a reading later."""
    return np.exp(-plant.interval_s / np.array([exp(theta[1]), exp(theta[3]), decay_s]))


def draw_noise(
    rng: np.random.Generator, n: int, keeps: np.ndarray, variances: np.ndarray, beside: Disturbances, unit_V: float
) -> np.ndarray:
    """Return readings of the clean plant, in units, with its shocks at their instants and of chance marks."""
    noise = np.sqrt(variances[2]) * rng.standard_normal(n)
    for keep, variance in zip(keeps, variances[:2], strict=False):
        kicks = np.sqrt(variance * (1 - keep**2)) * rng.standard_normal(n)
        kicks[0] = np.sqrt(variance) * rng.standard_normal()
        noise += lfilter([1], [1, -keep], kicks)
    marks = np.sqrt(beside.mark_var) / unit_V * rng.standard_normal(n)
    return np.asarray(noise + lfilter([1], [1, -keeps[2]], marks) - (1 - beside.part) * marks)


@njit(cache=True)
def take(
    weight: np.ndarray, x: np.ndarray, p: np.ndarray, at: int, more: float, other_x: np.ndarray, other_p: np.ndarray
) -> None:
    """Make one history of that at a place and another, of weight `more`: mean and covariance of both."""
    whole = weight[at] + more
    old, new = weight[at] / whole, more / whole
    for i in range(3):
        for j in range(3):
            apart = old * new * (x[at, i] - other_x[i]) * (x[at, j] - other_x[j])
            p[at, i, j] = old * p[at, i, j] + new * other_p[i, j] + apart
    for i in range(3):
        x[at, i] = old * x[at, i] + new * other_x[i]
    weight[at] = whole


@njit(cache=True)
def log_density(
    y: np.ndarray,
    kept: np.ndarray,
    size: float,
    jump: float,
    struck: float,
    mark_var: float,
    keeps: np.ndarray,
    variances: np.ndarray,
    ages: int,
) -> float:
    """Return the logarithm of the density of readings, less n ln(2 pi)/2.

    Signal, drift, and a state that a shock strikes before a reading with probability `struck`; a level that is 0 or
    `size`, and before a reading another with probability `jump`; of size 0 there is none.
    """
    levels = 1 if size == 0.0 else 2
    count = levels * ages
    weight, x, p = np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3, 3))
    next_weight, next_x, next_p = np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3, 3))
    one, known, c = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    for q in range(ages - 1, count, ages):
        weight[q], p[q, 0, 0], p[q, 1, 1] = 1.0 / levels, variances[0], variances[1]
    total = 0.0
    for k in range(y.size):
        next_weight[:] = 0.0
        next_x[:] = 0.0
        next_p[:] = 0.0
        least = 1e300
        for q in range(count):  # below what any history makes of the reading, lest all vanish
            if weight[q] > 0.0 and kept[k]:
                e = abs(y[k] - x[q].sum() - size / 2) - abs(size) / 2
                least = min(least, max(e, 0.0) ** 2 / (p[q].sum() + variances[2] + mark_var) / 2)
        whole = 0.0
        for q in range(count):
            if weight[q] <= NEGLIGIBLE:
                continue
            level, age = q // ages, q % ages
            jumps = jump if k and levels == 2 else 0.0
            for event in range(3):  # nothing, a shock, a jump
                now, prior = level, (1.0 - struck) * (1.0 - jumps)
                at = level * ages + min(age + 1, ages - 1)
                if event == 1:
                    prior, at = struck, level * ages
                elif event == 2:
                    now, prior, at = 1 - level, jumps, (1 - level) * ages
                if prior == 0.0:
                    continue
                more = weight[q] * prior
                one[:] = x[q]
                known[:] = p[q]
                if event == 1:
                    known[2, 2] += mark_var
                if kept[k]:
                    s = variances[2]
                    for i in range(3):
                        c[i] = known[i, 0] + known[i, 1] + known[i, 2]
                        s += c[i]
                    e = y[k] - one[0] - one[1] - one[2] - size * now
                    more *= np.exp(least - e * e / s / 2) / np.sqrt(s)
                    for i in range(3):
                        one[i] += c[i] / s * e
                        for j in range(3):
                            known[i, j] -= c[i] * c[j] / s
                if more > 0.0:
                    whole += more
                    take(next_weight, next_x, next_p, at, more, one, known)
        if kept[k]:
            total += np.log(whole) - least
        for q in range(count):
            weight[q] = next_weight[q] / whole
            for i in range(3):
                x[q, i] = next_x[q, i] * keeps[i]
                for j in range(3):
                    p[q, i, j] = next_p[q, i, j] * keeps[i] * keeps[j]
                if i < 2:
                    p[q, i, i] += (1.0 - keeps[i] ** 2) * variances[i]
    return total
