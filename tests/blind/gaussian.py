"""The clean plant as a Gaussian process: five numbers, their spectrum, and the whitening of what comes on top of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, exp, log, sqrt

import numpy as np
from numba import njit
from scipy.optimize import minimize

from tests.blind.plant import Plant, Run, make_world

__all__ = [
    "Disturbances",
    "Part",
    "disturbances",
    "energy",
    "markov_spectrum",
    "numbers",
    "refit",
    "same",
    "spectrum",
    "turns",
    "whiten",
]


def numbers(plant: Plant) -> np.ndarray:
    """Return logarithms of two variances at lag 0 and their time constants, and of the white variance."""
    drift_sd = plant.drift_rate_V_per_rt_s * sqrt(plant.drift_tau_s / 2)
    pairs = [(plant.signal_sd_V, plant.signal_tau_s), (drift_sd, plant.drift_tau_s)]
    values, white = [], plant.white_sd_V**2
    for sd, tau in pairs:
        a = plant.inside * plant.step_s / tau
        shared = sd**2 * (-np.expm1(-a) / a) ** 2 * exp(a)  # times e^(-lag/tau) is the covariance of aperture means
        white += sd**2 * 2 * (a + np.expm1(-a)) / a**2 - shared
        values += [log(shared), log(tau)]
    return np.array([*values, log(white)])


def markov_spectrum(keep: float, turn: np.ndarray) -> np.ndarray:
    return (1 - keep**2) / (1 - 2 * keep * np.cos(turn) + keep**2)


def turns(plant: Plant) -> np.ndarray:
    return 2 * np.pi * np.arange(1, plant.n // 2) / plant.n


def spectrum(theta: np.ndarray, plant: Plant) -> np.ndarray:
    w = turns(plant)
    first, second = (
        exp(theta[2 * j]) * markov_spectrum(exp(-plant.interval_s / exp(theta[2 * j + 1])), w) for j in (0, 1)
    )
    return first + second + exp(theta[4])


@dataclass(frozen=True)
class Disturbances:
    """What else happens to the readings at known instants; shapes (n,)."""

    kept: np.ndarray
    """Which readings are not lost."""
    mark_var: np.ndarray
    """Variance, V^2, that a shock adds to the shocks' part of the input, as it stands at the reading's beginning."""
    part: np.ndarray
    """How much of it the reading sees: less where the shock comes within the aperture."""
    fade: float
    """Of a shock, from one reading to the next."""


def disturbances(run: Run) -> Disturbances:
    """Return a run's losses and shocks; two shocks between readings are one of both variances."""
    plant, world = run.plant, make_world(run)
    kept = ~(world.rng("lost").random(plant.n) < plant.lost_fraction)
    mark_var, seen = np.zeros(plant.n), np.zeros(plant.n)
    decay_s, aperture_s = plant.shock_decay_s, plant.inside * plant.step_s
    whole = decay_s / aperture_s * -np.expm1(-aperture_s / decay_s)
    for time_s, _ in world.shocks:
        at = max(ceil((time_s - aperture_s) / plant.interval_s), 0)  # the first reading that does not end before it
        if at == plant.n:
            continue
        late_s = time_s - at * plant.interval_s
        begun = exp(late_s / decay_s) * whole  # what a whole aperture would have seen
        part = begun if late_s <= 0 else decay_s / aperture_s * -np.expm1((late_s - aperture_s) / decay_s)
        mark_var[at] += (plant.shock_sd_V * begun) ** 2
        seen[at] += plant.shock_sd_V**2 * begun * part
    part = np.divide(seen, mark_var, out=np.ones(plant.n), where=mark_var > 0)
    return Disturbances(kept, mark_var, part, exp(-plant.interval_s / decay_s))


def same(s: np.ndarray) -> np.ndarray:
    return s


@dataclass(frozen=True)
class Part:
    """A part of the record, in no order."""

    share: float
    true_s: np.ndarray
    known: Callable[[np.ndarray], np.ndarray] = same
    """What who refits the plant knows to be there besides, as a change of the plant's spectrum."""


def refit(
    theta: np.ndarray,
    plant: Plant,
    parts: Sequence[Part],
    mean: np.ndarray | None,
    beside: Disturbances | None = None,
) -> float:
    """Return the least that the best clean plant loses, beside what is known to be there.

    Of a mean, what is known besides takes the share that it takes of each of its frequencies: of what lasts, as a line
    does, but not of a step.
    """
    count = plant.n if beside is None else np.count_nonzero(beside.kept)
    alone = all(part.known is same for part in parts)
    power = np.zeros(0) if mean is None else np.abs(np.fft.rfft(mean - np.mean(mean))[1 : plant.n // 2]) ** 2

    def lost(s: np.ndarray) -> float:
        ratios = ((part.share, part.true_s / part.known(s)) for part in parts)
        return count / 2 * sum(share * float(np.mean(ratio - np.log(ratio) - 1)) for share, ratio in ratios)

    def left(s: np.ndarray) -> float:
        if alone:
            return 1.0
        return sum(part.share * float(np.sum(power / part.known(s))) for part in parts) / float(np.sum(power / s))

    def loss(numbers: np.ndarray) -> float:
        s = spectrum(numbers, plant)
        if mean is None:
            return lost(s + averaged_out(numbers, plant))
        return lost(s) + energy(numbers, plant, mean, beside) / 2 * left(s)

    slower = theta + np.array([0.0, 0.0, 2.0, 2.0, 0.0])
    starts = [min((theta, slower), key=loss)]  # what is slow leads a drift that begins as it is into a lesser minimum
    if mean is None:  # of a plant's white noise apertures leave less than there is, or less than none
        real = log(exp(theta[4]) - averaged_out(theta, plant))
        starts = [np.append(theta[:4], white) for white in (real, real - 4)]
    tries = []
    for start in starts:
        box = [(value - 6, value + 6) for value in start]
        tries.append(minimize(loss, start, method="L-BFGS-B", bounds=box, options={"maxiter": 60}).fun)
    return float(min(tries))


def averaged_out(theta: np.ndarray, plant: Plant) -> float:
    """Return the variance, which is negative, that an aperture's mean of two processes has beyond their covariance."""
    a = plant.inside * plant.step_s / np.exp(theta[[1, 3]])
    whole = 2 * (a + np.expm1(-a)) * np.exp(-a) / np.expm1(-a) ** 2
    return float(np.sum(np.exp(theta[[0, 2]]) * (whole - 1)))


def energy(theta: np.ndarray, plant: Plant, mean: np.ndarray, beside: Disturbances | None = None) -> float:
    """Return mean' C^-1 mean, less what a constant takes of it."""
    seen, level = (whitened(theta, plant, column, beside) for column in (mean, np.ones(plant.n)))
    return float(seen @ seen - (seen @ level) ** 2 / (level @ level))


def whitened(theta: np.ndarray, plant: Plant, column: np.ndarray, beside: Disturbances | None = None) -> np.ndarray:
    """Return C^-1/2 times a column, with what happens beside it in C, or without."""
    keeps = [exp(-plant.interval_s / exp(theta[j])) for j in (1, 3)]
    column = np.ascontiguousarray(column, dtype=float)
    if beside is None:
        return whiten(column, *keeps, *np.exp(theta[[0, 2, 4]]))
    return whiten_struck(
        *(column, *keeps, *np.exp(theta[[0, 2, 4]])), beside.kept, beside.mark_var, beside.part, beside.fade
    )


def whiten(y: np.ndarray, keep1: float, keep2: float, var1: float, var2: float, noise: float) -> np.ndarray:
    """Return innovations over their standard deviations, of two Markov states and white noise."""
    calm = np.zeros(y.size)
    return whiten_struck(y, keep1, keep2, var1, var2, noise, np.ones(y.size, bool), calm, calm, 0.0)


@njit(cache=True)
def whiten_struck(
    y: np.ndarray,
    keep1: float,
    keep2: float,
    var1: float,
    var2: float,
    noise: float,
    kept: np.ndarray,
    mark_var: np.ndarray,
    part: np.ndarray,
    fade: float,
) -> np.ndarray:
    """Return the same with a third state that is struck at known readings; 0 where a reading is lost.

    A reading sees `part` of what strikes at it, and the next one `fade` of it; until then the state is its sum.
    """
    x1 = x2 = x3 = 0.0
    p11, p12, p22, p13, p23, p33 = var1, 0.0, var2, 0.0, 0.0, 0.0
    out = np.zeros(y.size)
    for k in range(y.size):
        q, share = mark_var[k], part[k]
        if kept[k]:
            c1, c2, c3 = p11 + p12 + p13, p12 + p22 + p23, p13 + p23 + p33
            s = c1 + c2 + c3 + share * share * q + noise
            e = y[k] - x1 - x2 - x3
            c3 += share * q
            out[k] = e / np.sqrt(s)
            x1, x2, x3 = x1 + c1 / s * e, x2 + c2 / s * e, x3 + c3 / s * e
            p11, p12, p22 = p11 - c1 * c1 / s, p12 - c1 * c2 / s, p22 - c2 * c2 / s
            p13, p23, p33 = p13 - c1 * c3 / s, p23 - c2 * c3 / s, p33 - c3 * c3 / s
        p33 += q
        x1, x2, x3 = keep1 * x1, keep2 * x2, fade * x3
        p11 = keep1**2 * p11 + (1 - keep1**2) * var1
        p12 *= keep1 * keep2
        p22 = keep2**2 * p22 + (1 - keep2**2) * var2
        p13 *= keep1 * fade
        p23 *= keep2 * fade
        p33 *= fade**2
    return out
