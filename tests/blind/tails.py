"""What a clairvoyant can know of heavy tails: the law of the log likelihood ratio, and not its mean alone.

A few large readings carry most of it, so its variance is not twice its mean, as of a Gaussian one, and a mean that
would do for a Gaussian ratio does not do here. The ratio is summed over readings that count as independent, each with
the scatter that is left of it when all others are known (the harmonic mean of the spectrum; an innovation knows only
those before it): of noise that is its reading's own, the score's variance is the sum over pairs of readings of the
fourth power of the inverse covariance, in which the pairs of one and the same are nearly all.

The plant nearest to it is a clean one whose shocks imitate tails: perfectly, if they fade within a reading. A plant
with shocks of its own has one law for both, so that either these or the tails are fitted worse. Which is worse decides
its fit, so both are weighed together, and shocks are tried that fade as the plant's own do, at once, or in between: a
slow shock is met by some fast ones in succession, which are cheap once they are frequent. (Only the plant's own decay
and none were tried, with noise as wide as if its tails were all in it, and own shocks that no reading had seen fade.
On 40 records, of 1,500 to 9,000 readings, what likelihoods fitted to them came to fell short of that law by more than
two deviations in seven; of this law in one.)
"""

from dataclasses import dataclass
from math import ceil, exp, log, log1p, pi, sqrt

import numpy as np
from scipy.optimize import minimize
from scipy.signal import fftconvolve
from scipy.special import ndtri
from scipy.stats import norm
from scipy.stats import t as student

from tests.blind.gaussian import numbers, spectrum, turns
from tests.blind.plant import Effect, Plant, Run, make_world

__all__ = ["Law", "energy_taken", "seen_marks", "tails_laws", "tails_nats"]

GRID = np.sinh(np.linspace(-6, 6, 801)) / np.sinh(6) * 60
"""Of a reading's excess, in deviations; so many readings have none beyond."""
ACROSS, ACROSS_SHARE = np.polynomial.hermite_e.hermegauss(9)
ACROSS_SHARE = ACROSS_SHARE / ACROSS_SHARE.sum()
FINE = np.linspace(-80, 80, 40_001)
NATS = 0.01
"""Of the lattice on which ratios are summed."""
CELLS = 1 << 17
PLENTY = 60.0
FADES = (0.0, exp(-2.0), exp(-1.0), exp(-0.5))
"""Of a shock from reading to reading; those of half an interval, one and two, and of none."""
SUCCESSIVE = 4
"""Shocks that meet one."""
MOST_OFTEN = -0.4
"""Logit of the readings' part that are struck; no clean plant has more than one in each second reading."""


@dataclass(frozen=True)
class Law:
    """Of the log likelihood ratio of a whole record, where the tails are real."""

    each: np.ndarray
    """Nats that a reading of some excess gives, shape (cells,)."""
    share: np.ndarray
    """Probabilities of these."""
    n: int
    own: float
    """Nats of the plant's own shocks, which the nearest clean plant fits worse."""

    def power(self, level: float) -> tuple[float, float]:
        """Return how often the tails pass the threshold that the nearest clean plant passes at a level; how often not.

        Where a ratio is a likelihood's, the clean plant's law of it is e^-ratio times the tails' law. What one reading
        gives beyond PLENTY is left out, since it is found by then.
        """
        place = np.clip(self.each, -PLENTY, PLENTY) / NATS
        below = np.floor(place)
        one = np.zeros(CELLS)
        for cell, part in ((below, below + 1 - place), (below + 1, place - below)):
            one += np.bincount(cell.astype(int) % CELLS, self.share * part, minlength=CELLS)
        law = np.maximum(np.roll(np.fft.irfft(np.fft.rfft(one) ** self.n, CELLS), CELLS // 8), 0.0)
        nats = (np.arange(CELLS) - CELLS // 8) * NATS + self.own
        clean = np.cumsum((law * np.exp(np.minimum(-nats, 100.0)))[::-1])[::-1]
        threshold = int(np.argmax(clean <= level))
        return float(np.sum(law[threshold:])), float(np.sum(law[:threshold]))

    def nats(self, level: float) -> float:
        """Return the D of a Gaussian ratio, whose variance is 2 D, that passes as often at this level."""
        passed, missed = self.power(level)
        beyond = ndtri(passed) if passed < 0.5 else -ndtri(max(missed, 1e-12))
        return float(max(beyond - ndtri(level), 0.0) ** 2 / 2)


def tails_nats(run: Run, effect: Effect, level: float) -> float:
    """Return the D of the Gaussian ratio that is found as often, against the clean plant from which tails are least."""
    return min(law.nats(level) for law in tails_laws(run, effect))


def tails_laws(run: Run, effect: Effect) -> list[Law]:
    """Return the law against the best plant without shocks of its own, or of those whose shocks fade thus or thus."""
    plant, marks = run.plant, seen_marks(run)
    own = exp(-plant.interval_s / plant.shock_decay_s)
    fades = (*(fade for fade in FADES if fade < own), own) if marks.size else FADES[:1]
    return [against(plant, effect, marks, fade, own) for fade in fades]


def seen_marks(run: Run) -> np.ndarray:
    """Return the plant's own shocks, V, as the first reading after each sees them: those have faded since."""
    plant = run.plant
    firsts = [
        (ceil((time_s - plant.inside * plant.step_s) / plant.interval_s), time_s, mark_V)
        for time_s, mark_V in make_world(run).shocks
    ]
    late_s = [(max(at, 0) * plant.interval_s - time_s, mark_V) for at, time_s, mark_V in firsts if at < plant.n]
    return np.array([mark_V * exp(-max(late, 0.0) / plant.shock_decay_s) for late, mark_V in late_s])


def against(plant: Plant, effect: Effect, marks: np.ndarray, fade: float, own: float) -> Law:
    """Return the law against the best clean plant whose shocks keep `fade` of themselves from reading to reading.

    In deviations of a reading that all others tell of: an excess of it, what of this a shock's shape takes along with
    what that shows besides, and both again where the plant's own shocks strike. The clean plant's noise is fitted, too:
    what its shocks take is not in it.
    """
    s, w = spectrum(numbers(plant), plant), turns(plant)
    heard = float(np.mean(1 / s))
    shape, true = (1 / (1 - keep * np.exp(-1j * w)) for keep in (fade, own))
    energy, true_energy = (float(np.mean(np.abs(of) ** 2 / s)) for of in (shape, true))
    along = float(np.mean(shape.real / s)) / sqrt(heard * energy)
    next_to = float(np.mean(np.abs(shape) ** 2 * np.cos(w) / s)) / energy
    taken = energy_taken(shape, true, s, w)
    across = sqrt(max(1 - along**2, 0.0))
    density = excess(effect.size * plant.white_sd_V**2 * heard)
    calm = density * np.gradient(GRID)
    u, share = np.repeat(GRID, ACROSS.size), np.outer(calm / calm.sum(), ACROSS_SHARE).ravel()
    v = along * u + across * np.tile(ACROSS, GRID.size)
    struck = marks.size / plant.n
    real = float(np.mean(marks**2)) * taken[0] if marks.size else 1.0  # variance of a mark
    if marks.size:
        hit, beside = (column.ravel() for column in np.meshgrid(sqrt(1 + real) * ACROSS, ACROSS))
        u, v = np.append(u, along * hit + across * beside), np.append(v, hit)
        share = np.append((1 - struck) * share, struck * np.outer(ACROSS_SHARE, ACROSS_SHARE).ravel())
    told = np.log(np.interp(u, GRID, density)) + u**2 / 2 + log(2 * pi) / 2 + log(1 - struck)
    if marks.size:
        told = np.logaddexp(told, log(struck) - log(1 + real) / 2 + v**2 / 2 * real / (1 + real))

    def each(free: np.ndarray) -> np.ndarray:
        """Return nats, all laws over that of Gaussian noise alone."""
        rate, narrow = 1 / (1 + exp(-free[0])), exp(2 * free[1])
        still = along**2 * narrow + across**2
        both = still + exp(2 * free[2])
        plain = log(1 - rate) - log(narrow) / 2 - u**2 / 2 * (1 / narrow - 1)
        one = plain + free[0] - log(both / still) / 2 + v**2 / 2 * (1 / still - 1 / both)
        clean = np.logaddexp(plain, one)
        if fade:  # a second shock takes back in the next reading what is left of the first: two marks of two shapes
            size = both / still - 1
            cost = log((1 + size) ** 2 - (next_to * size) ** 2) / 2
            clean = np.logaddexp(clean, plain + 2 * free[0] - cost + u**2 / 2 * (1 / narrow - 1 / both))
            clean = clean - log1p(rate**2 / (1 - rate) * sqrt(both / narrow) * exp(-cost))  # a law, then
        return told - clean

    def lost(free: np.ndarray) -> float:
        """Return the nats of the plant's own shocks, each met by as many of the clean plant's as is best."""
        more = np.arange(taken.size) * (log(1 + exp(2 * free[2])) / 2 - free[0])
        return float(np.sum(np.min(marks[:, None] ** 2 / 2 * (true_energy - taken) + more, axis=1)))

    def loss(free: np.ndarray) -> float:
        if not (-14 < free[0] < MOST_OFTEN and -2 < free[1] < 1 and -3 < free[2] < 12):
            return 1e9
        return plant.n * float(share @ each(free)) + lost(free)

    starts = [[-4.0, -0.2, 1.0], [-2.0, -0.3, 0.5]]
    if marks.size:
        starts = [[log(struck), -0.02, log(real) / 2], starts[0]]
    found = (minimize(loss, start, method="Nelder-Mead", tol=0.01) for start in starts)
    best = min(found, key=lambda one: one.fun)
    return Law(each(best.x), share, plant.n, lost(best.x))


def energy_taken(shape: np.ndarray, true: np.ndarray, s: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return what of the true shape's whitened energy shocks of another shape at 1, 2, ... successive readings meet.

    Shapes are given by their spectra, of a mark of 1 V, on the turns `w` of the spectrum `s`.
    """
    lags = np.arange(SUCCESSIVE)
    along = np.array([float(np.mean((true * (shape * np.exp(-1j * w * lag)).conj()).real / s)) for lag in lags])
    own = np.array([float(np.mean(np.abs(shape) ** 2 * np.cos(w * lag) / s)) for lag in lags])
    gram = own[np.abs(np.subtract.outer(lags, lags))]
    return np.array([along[:k] @ np.linalg.solve(gram[:k, :k], along[:k]) for k in lags + 1])


def excess(share: float) -> np.ndarray:
    """Return the density, on GRID, of a deviation of variance 1 of which this share is Student's with 3 degrees."""
    scale = sqrt(share / 3)
    core = norm.pdf(FINE, scale=sqrt(max(1 - share, 1e-4)))
    density = fftconvolve(student.pdf(FINE / scale, 3) / scale, core, mode="same") * (FINE[1] - FINE[0])
    far = 2 / (pi * sqrt(3)) * 9 * scale**3 / np.maximum(np.abs(GRID), 10.0) ** 4
    return np.where(np.abs(GRID) > 20, far, np.interp(GRID, FINE, np.maximum(density, 1e-300)))
