"""How much a hidden effect can be known: D, in nats, by a likelihood written for this purpose alone.

D = E[log p(readings | plant with the effect)] - E[log p(readings | the best plant without it)]

The best plant is found by refitting all five numbers of the clean plant, so what it absorbs is no part of D. A change
of covariance costs n/2 times the mean over the spectrum of log(S'/S) + S/S' - 1 (asymptotic; S folded, apertures
included); a change of the mean costs half the energy of what the refitted plant's whitening leaves of it (exact).
Shocks and lost readings are left out, except of a change of the mean: there readings that are lost tell nothing, and
shocks come at known instants and fade as the plant's do, but with unknown marks, which the first readings after each
are spent on. Who reads a file does not know the instants, so D is still a little too large, and much where shocks at
any instant can imitate the effect, as they can a step. Kind of D by cause, in KINDS below:

    mean         deterministic, given the draws (phases, shock times, temperature, the readings it bends): as above
    covariance   Gaussian: as above; where the noise changes, segment by segment
    path         telegraph noise: the mean's D of the path as drawn, less what the path itself costs who does not know
                 it, ln(stay/interval) + 1 for each jump (a lower bound)
    innovation   noise that is not Gaussian or not stationary: as if innovations were independent, with their variance;
                 of heavy tails, against a plant whose shocks fade within a reading, which imitates them well; of the
                 shocks' signs, as far as a reading tells that it was struck and by what; of noise that grows with the
                 reading, given the readings as drawn
    counted      nothing is refitted: the effect is seen by counting, and a size is drawn instead of a D
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import ceil, exp, log, sqrt

import numpy as np
from numba import njit
from scipy.optimize import brentq, minimize
from scipy.signal import fftconvolve
from scipy.special import erf, ndtri
from scipy.stats import norm
from scipy.stats import t as student

from tests.blind.injector import AT_INPUT, make_record, template
from tests.blind.plant import Effect, Plant, Run, make_world, supply

__all__ = ["KINDS", "LEVEL", "clairvoyant_d95", "d_nats", "size_for"]

LEVEL = 0.003 / 33
"""False-alarm rate of one mechanism, if 0.3 % is shared by 33 of them."""

KINDS = dict.fromkeys(AT_INPUT, "mean") | {
    "resonance": "covariance",
    "difference_noise": "covariance",
    "smoothing": "covariance",
    "popcorn_noise": "path",
    "changing_noise": "covariance",
    "signal_dependent_noise": "innovation",
    "heavy_tails": "innovation",
    "shock_law": "innovation",
    "nonlinearity": "mean",
    "supply_coupling": "mean",
    "range_switching": "mean",
    "reading_pattern": "mean",
    "quantisation": "counted",
    "saturation": "counted",
    "stuck_readings": "counted",
    "replayed_block": "counted",
    "missing_samples": "counted",
    "timestamp_jitter": "counted",
    "clock_error": "counted",
    "dead_band": "counted",
    "ooc_echo": "covariance",
    "ooc_gain_step": "mean",
    "ooc_breath": "covariance",
}


def d_nats(run: Run, effect: Effect, shown: "Shown | None" = None) -> float:
    """Return D of an effect in an otherwise clean run; NaN where it is counted.

    `shown` is what one unit of it shows, where that is known from another size of it.
    """
    plant, n = run.plant, run.plant.n
    kind, theta = KINDS[effect.cause], numbers(plant)
    if kind == "counted":
        return float("nan")
    if effect.cause == "signal_dependent_noise":
        return louder_kl(run, effect)
    if kind == "innovation":
        return n * innovation_kl(plant, effect, len(make_world(run).shocks))
    clean_s = spectrum(theta, plant)
    if kind in ("mean", "path"):
        shown = shown or Shown(unit_template(run, effect), disturbances(run))
        known = refit(theta, plant, [(1.0, clean_s)], effect.size * shown.unit, shown.beside)
        return known - (path_cost(shown.unit, effect, plant) if kind == "path" else 0.0)
    if effect.cause == "changing_noise":
        part = effect.shape["end"] - effect.shape["begin"]
        changed_s = clean_s + (effect.size**2 - 1) * plant.white_sd_V**2
        return refit(theta, plant, [(1 - part, clean_s), (part, changed_s)], None)
    if effect.cause == "ooc_breath":  # a sine's turn by six of its instants, of which four differ
        parts = ((1 / 3, 0.5), (1 / 3, -0.5), (1 / 6, 1.0), (1 / 6, -1.0))
        louder = [(part, plant.white_sd_V**2 * (exp(2 * effect.size * at) - 1)) for part, at in parts]
        return refit(theta, plant, [(part, clean_s + more) for part, more in louder], None)
    return refit(theta, plant, [(1.0, EXTENDED[effect.cause](clean_s, effect, plant))], None)


def size_for(d_target: float, run: Run, effect: Effect, low: float, high: float) -> Effect | None:
    """Return the effect with the size that has this D, within a range; None where no size there has it."""

    shown = None
    if KINDS[effect.cause] in ("mean", "path"):
        shown = Shown(unit_template(run, effect), disturbances(run))
        if not shown.unit.any():
            return None  # such as a ring-down without a shock

    def excess(log_size: float) -> float:
        return log(max(d_nats(run, replace(effect, size=exp(log_size)), shown), 1e-9)) - log(d_target)

    at, slope = first_guess(d_target, run, effect, shown, low, high), 2.0
    beyond = excess(at)
    for _ in range(8):  # secant steps, for a curve that is nearly straight in logarithms
        if abs(beyond) < 0.03:
            return replace(effect, size=exp(at)) if low <= exp(at) <= high else None
        last, was = at, beyond
        at = last - min(max(beyond / slope, -3.0), 3.0)
        if not log(low) - 1 < at < log(high) + 1:
            break
        beyond = excess(at)
        slope = min(max((beyond - was) / (at - last), 0.5), 8.0)
    if excess(log(high)) < 0 or excess(log(low)) > 0:
        return None
    return replace(effect, size=exp(brentq(excess, log(low), log(high), xtol=0.01)))


def first_guess(d_target: float, run: Run, effect: Effect, shown: "Shown | None", low: float, high: float) -> float:
    """Return the logarithm of a size to begin with: of the mean, what would do if nothing were refitted."""
    if shown is None:
        return (log(low) + log(high)) / 2
    known = energy(numbers(run.plant), run.plant, shown.unit, shown.beside)
    return log(2 * d_target / max(known, 1e-300)) / 2


def clairvoyant_d95(cause: str, n: int, level: float = LEVEL) -> float:
    """Return the D at which who knows the family and the plant detects in 95 %: (u + 1.645)^2/2.

    u is the threshold of one standard normal number, or for a line of the root of twice an exponential one, after as
    many independent looks as the family's grid has; those numbers are estimates of the grids' sizes.
    """
    looks, line = LOOKS.get(cause, (1.0, False))
    looks = looks if looks < 1e3 else looks / 1e3 * n
    threshold = sqrt(2 * log(looks / level)) if line else -ndtri(level / (2 * looks))
    return float((threshold + 1.645) ** 2 / 2)


LOOKS = {  # (looks, whether it has two quadratures); from 1000 on in thousandths of the readings
    "mains_alias": (6.0, True),
    "periodic_interference": (1e3, True),
    "wandering_line": (30e3, True),
    "periodic_glitch": (30e3, False),
    "resonance": (200.0, False),
    "step": (0.1e3 + 900, False),
    "ring_down": (500.0, True),
    "thermal_drift": (10.0, False),
    "latency": (10.0, False),
    "range_switching": (20.0, False),
    "supply_coupling": (2.0, False),
    "warmup_drift": (10.0, False),
    "changing_noise": (50.0, False),
    "popcorn_noise": (20.0, False),
}


# --- Gaussian: five numbers, their spectrum, their whitening ---------------------------------------------------------


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


@dataclass(frozen=True)
class Shown:
    """What one unit of an effect adds to each reading, and what else happens to them."""

    unit: np.ndarray
    beside: Disturbances


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


def refit(
    theta: np.ndarray,
    plant: Plant,
    true_s: Sequence[tuple[float, np.ndarray]],
    mean: np.ndarray | None,
    beside: Disturbances | None = None,
) -> float:
    """Return the least that the best clean plant loses; the true spectrum in segments, each with its share."""
    count = plant.n if beside is None else np.count_nonzero(beside.kept)

    def lost(s: np.ndarray) -> float:
        return count / 2 * sum(share * float(np.mean(true / s - np.log(true / s) - 1)) for share, true in true_s)

    def loss(numbers: np.ndarray) -> float:
        if mean is None:
            return lost(spectrum(numbers, plant) + averaged_out(numbers, plant))
        return lost(spectrum(numbers, plant)) + energy(numbers, plant, mean, beside) / 2

    starts = [theta]
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


def calm(run: Run) -> np.ndarray:
    """Return the readings of the twin without effects, losses and shocks."""
    return make_record(replace(run, effects=(), plant=replace(run.plant, lost_fraction=0.0, shocks_per_s=0.0))).value_V


def unit_template(run: Run, effect: Effect) -> np.ndarray:
    if effect.cause in AT_INPUT:
        return template(run, effect)
    if effect.cause == "reading_pattern":
        return (np.arange(run.plant.n) % int(effect.shape["period_readings"]) == 0).astype(float)
    value = calm(run)
    if effect.cause == "supply_coupling":
        return value * (supply(make_world(run)) - 5)
    if effect.cause == "range_switching":
        return (np.abs(value) >= np.quantile(np.abs(value), effect.shape["part"])).astype(float)
    deviation = value - value.mean()
    if effect.cause == "ooc_gain_step":
        return np.where(np.arange(run.plant.n) * run.plant.interval_s >= effect.shape["time_s"], deviation, 0.0)
    return deviation**2 - np.mean(deviation**2)  # nonlinearity


def with_resonance(s: np.ndarray, effect: Effect, plant: Plant) -> np.ndarray:
    f, quality = effect.shape["frequency_hz"], effect.shape["quality"]
    keep, turn = exp(-np.pi * f / quality * plant.interval_s), 2 * np.pi * f * plant.interval_s
    seen = np.sinc(f * plant.inside * plant.step_s) ** 2
    both = markov_spectrum(keep, turns(plant) - turn) + markov_spectrum(keep, turns(plant) + turn)
    return s + effect.size**2 * seen * both / 2


def path_cost(path: np.ndarray, effect: Effect, plant: Plant) -> float:
    jumps = np.count_nonzero(np.diff(path > 0.5))
    return jumps * (1 + log(effect.shape["dwell_s"] / plant.interval_s))


EXTENDED: dict[str, Callable[[np.ndarray, Effect, Plant], np.ndarray]] = {
    "resonance": with_resonance,
    "difference_noise": lambda s, effect, plant: s + effect.size**2 * (2 - 2 * np.cos(turns(plant))),
    "smoothing": lambda s, effect, plant: (
        s * (1 - effect.size) ** 2 / (1 - 2 * effect.size * np.cos(turns(plant)) + effect.size**2)
    ),
    "ooc_echo": lambda s, effect, plant: (
        s * (1 + 2 * effect.size * np.cos(effect.shape["lag_readings"] * turns(plant)) + effect.size**2)
    ),
}


# --- innovations ------------------------------------------------------------------------------------------------------


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
    """Return nats per reading of noise that is not Gaussian, or not of one variance."""
    variance = exp(float(np.mean(np.log(spectrum(numbers(plant), plant)))))  # of one innovation (Kolmogorov)
    if effect.cause == "shock_law":
        return uneven_kl(plant, effect.size, shocks / plant.n, sqrt(variance))
    share = effect.size * plant.white_sd_V**2 / variance  # heavy_tails; in units of the innovation's sd
    grid = np.linspace(-25, 25, 20_001)
    scale = sqrt(share / 3)
    jump = student.pdf(grid / scale, 3) / scale
    core = norm.pdf(grid, scale=sqrt(max(1 - share, 1e-4)))
    density = np.maximum(fftconvolve(jump, core, mode="same") * (grid[1] - grid[0]), 1e-300)

    def loss(best: np.ndarray) -> float:  # of the clean plant with shocks that fade within a reading
        struck, narrow, wide = 1 / (1 + exp(-best[0])), exp(best[1]), exp(best[1]) + exp(best[2])
        clean = (1 - struck) * norm.pdf(grid, scale=narrow) + struck * norm.pdf(grid, scale=wide)
        return float(np.sum(density * (np.log(density) - np.log(np.maximum(clean, 1e-300)))) * (grid[1] - grid[0]))

    return min(minimize(loss, start, method="Nelder-Mead").fun for start in ([-4.0, -0.2, 1.0], [-2.0, -0.3, 0.5]))
