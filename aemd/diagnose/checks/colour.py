"""Broad features of the residuals' spectrum: the score of each kind of noise that could be added.

If the model is right, the periodogram of z at its own frequencies is exponential and independent, and the effect of a
small addition with spectrum dS is dS/S of the base. Its score, the projection of power - 1 on that shape after the
shapes of the base's own parameters are taken out (C(alpha), Neyman 1959), is a weighted sum of exponentials.
"""

from math import exp, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.stats import gamma, norm

from aemd.diagnose.checks.gains import LONG, MOST_OF_ONE, gain_of, tail_of_one
from aemd.diagnose.evidence import Evidence, bonferroni, weighted_chi2_tail
from aemd.diagnose.fit import Fit, begin_with
from aemd.diagnose.hypothesis import Base, Term
from aemd.diagnose.kernels import MARKOV, PAIR
from aemd.diagnose.terms.lines import amplitude_cost
from aemd.diagnose.terms.noise import (
    DifferenceNoise,
    ExtraMarkov,
    Flicker,
    RandomWalk,
    Resonance,
    Smoothing,
    flicker_processes,
)

__all__ = ["check_colour", "check_resonance"]

Floats = NDArray[np.float64]

_PRESENT = 0.1
"""Of a part of the base: its spectrum over the whole, as the root of a sum of squares over the frequencies. Below it,
half a nat per hundred, the part is at its bound and nothing was fitted by it; its shape, at whatever time constant it
was left at, must not be taken out of what is tested."""
_KEPT = 0.4
"""Where the search for a smoothing begins; from there the likelihood leads to weak ones and to strong ones."""


class _Score:
    """The residuals' periodogram and the directions that the base's own parameters take up."""

    def __init__(self, fit: Fit) -> None:
        data = fit.data
        even = np.zeros(int(data.slot[-1]) + 1)
        even[data.slot[data.used]] = fit.z[data.used]
        self.power = (np.abs(np.fft.rfft(even)) ** 2 / data.n)[1 : (even.size - 1) // 2 + 1]
        self.w = 2 * pi * np.arange(1, self.power.size + 1) / even.size
        self.step_s = data.interval_s
        self.base = np.full(self.w.size, fit.white**2)
        fitted = isinstance(fit.terms[0], Base)
        # Beside what apertures average out of the processes, which leaves less white noise than there is, or none.
        shapes = [np.full(self.w.size, exp(2 * fit.theta[4])) if fitted else self.base.copy()]
        for kind, tau, omega, rate, _, _ in fit.states:
            if kind == MARKOV and rate > 0:
                here = rate**2 * self.markov(tau)
                wider = rate**2 * self.markov(tau * 1.02)
                shapes += [here, (wider - here) / 0.02]
                self.base += here
            elif kind == PAIR:
                here = rate**2 * self.pair(tau, omega / (2 * pi))
                shapes.append(here)
                self.base += here
        taken = np.column_stack([shape / self.base for shape in shapes])
        scale = np.sqrt(np.sum(taken**2, axis=0))
        present = scale > _PRESENT
        self.lost = not present.all()
        kept = taken[:, present] / scale[present]
        left, singular, _ = np.linalg.svd(kept, full_matrices=False)
        # Of a stated model nothing has been fitted away.
        self.taken = left[:, singular > (1e-4 if fitted else np.inf) * singular[0]]

    def markov(self, tau_s: float) -> Floats:
        """Return the spectrum, per reading, of a first-order process of unit rate."""
        if np.isinf(tau_s):
            return np.asarray(self.step_s / (4 * np.sin(self.w / 2) ** 2))
        phi = np.exp(-self.step_s / tau_s)
        return np.asarray(tau_s / 2 * (1 - phi**2) / (1 - 2 * phi * np.cos(self.w) + phi**2))

    def pair(self, tau_s: float, frequency_hz: float) -> Floats:
        """Return the spectrum, per reading, of a swinging pair of unit deviation: two shifted first-order ones."""
        phi = np.exp(-self.step_s / tau_s)
        turn = 2 * pi * frequency_hz * self.step_s
        sides = [(1 - phi**2) / (1 - 2 * phi * np.cos(self.w + s * turn) + phi**2) for s in (-1, 1)]
        return np.asarray(0.5 * (sides[0] + sides[1]))

    def test(self, added: Floats) -> tuple[float, float]:
        """Return the standardised score of an added spectrum and its one-sided probability."""
        shape = added / self.base
        shape = shape - self.taken @ (self.taken.T @ shape)
        size = float(np.sqrt(np.sum(shape**2)))
        if size < 1e-6 * float(np.sqrt(np.sum((added / self.base) ** 2))):
            return 0.0, 1.0  # the base can do the same
        score = float(shape @ (self.power - 1)) / size
        p_value = weighted_chi2_tail(0.5 * shape / size, score, dof=2)
        # A part is lost where the readings speak against it, and so for other shapes; that is one case of two at most.
        return score, bonferroni(p_value, 2) if self.lost else p_value

    def size_of(self, added: Floats, score: float) -> float:
        """Return the multiple of the added spectrum that the score points at, at least a little."""
        shape = added / self.base
        shape = shape - self.taken @ (self.taken.T @ shape)
        return max(score, 0.5) / max(float(np.sqrt(np.sum(shape**2))), 1e-12)


def check_colour(fit: Fit) -> list[Evidence]:
    """Test for each kind of noise with a spectrum of its own."""
    score, data = _Score(fit), fit.data
    n = data.n
    one = amplitude_cost(1, n)
    sine = 4 * np.sin(score.w / 2) ** 2
    found = []

    value, p_value = score.test(sine)
    sd = sqrt(score.size_of(sine, value))
    found.append(_one_sided("noise that rises towards half the rate", value, p_value, (DifferenceNoise(sd, one),)))

    found.append(_smoothed(fit, score, sine))

    processes = zip(*flicker_processes(0.3 / data.span_s, 0.5 / data.interval_s), strict=True)
    flicker = np.sum([v * 2 / tau * score.markov(tau) for tau, v in processes], axis=0)
    walk = score.markov(np.inf)
    tries: list[tuple[float, float, Floats, float | None]] = []
    for added, tau in [(flicker, None), (walk, np.inf)]:
        value, p_value = score.test(added)
        tries.append((p_value, value, added, tau))
    taus = np.geomspace(data.interval_s, data.span_s / 5, 10)
    for tau in taus:
        added = 2 / tau * score.markov(float(tau))
        value, p_value = score.test(added)
        tries.append((p_value, value, added, float(tau)))
    # Twelve shapes of which neighbours are nearly the same; counting all of them is on the safe side.
    p_value, value, _, _ = min(tries, key=lambda item: item[0])
    terms: list[ExtraMarkov | Flicker | RandomWalk] = []
    if p_value < 0.01:
        terms.append(Flicker(sqrt(score.size_of(flicker, tries[0][1])), one))
        terms.append(RandomWalk(sqrt(score.size_of(walk, tries[1][1])), one))
        _, best, added, tau = min(tries[2:], key=lambda item: item[0])
        assert tau is not None  # noqa: S101 - only the first has none
        terms.append(ExtraMarkov(tau, sqrt(score.size_of(added, best)), one + log(len(taus))))
    found.append(
        _one_sided(
            "slow noise beyond signal and drift", value, bonferroni(p_value, len(tries)), tuple(terms), len(tries)
        )
    )
    return found


def _one_sided(check: str, value: float, p_value: float, terms: tuple[Term, ...], trials: float = 1.0) -> Evidence:
    return Evidence(
        check=f"{check}: score in deviations",
        p_value=p_value,
        observed=value,
        low=float(norm.ppf(0.025 ** (1 / trials))),
        high=float(norm.ppf(0.975 ** (1 / trials))),
        terms=terms,
    )


def _smoothed(fit: Fit, score: _Score, sine: Floats) -> Evidence:
    """Look for a smoothing: by what it adds to the likelihood, or in a long record by the score of a weak one."""
    terms, gain = smoothings(fit.data.n), gain_of_smoothing(fit)
    if gain is None:
        value, p_value = score.test(-sine * score.base)
        return _one_sided("noise that falls towards half the rate", value, p_value, terms)
    return Evidence(
        check="noise that falls towards half the rate: nats gained by a smoothing",
        p_value=tail_of_one(gain),
        observed=gain,
        low=0.0,
        high=MOST_OF_ONE,
        terms=terms,
    )


def gain_of_smoothing(fit: Fit) -> float | None:
    """Return the log-likelihood that a smoothing adds to a fit, all else fitted again; None where it is not sought.

    The slope at no smoothing sees a weak one. A strong one bends the spectrum in another way, to which the refitted
    base gives in, and what comes after a shock shows it as well as the spectrum does.
    """
    if fit.data.n > LONG or any(isinstance(term, Smoothing) for term in fit.terms):
        return None
    term = Smoothing(_KEPT, 0.0)
    return gain_of(fit, [(term, begin_with(fit, term)[0])])[0]


def smoothings(n: int) -> tuple[Smoothing, ...]:
    """Return a smoothing that is weak, one that is middling, one that is strong."""
    return tuple(Smoothing(kept, amplitude_cost(1, n)) for kept in (0.1, 0.4, 0.75))


def check_resonance(fit: Fit) -> Evidence:
    """Look for a band, four frequencies wide or more, with too much power: sums of exponentials are gamma variables."""
    score, data = _Score(fit), fit.data
    total = np.concatenate(([0.0], np.cumsum(score.power)))
    count = score.power.size
    best, trials, width = (1.0, 0, 4, 0.0), 0.0, 4
    while width <= count // 4:
        sums = total[width:] - total[:-width]
        at = int(np.argmax(sums))
        p_value = float(gamma.sf(sums[at], width))
        trials += 3 * count / width  # windows a third of their width apart are independent enough
        if p_value < best[0]:
            best = p_value, at, width, float(sums[at])
        width = int(np.ceil(width * 1.7))
    p_value, at, width, power = best
    corrected = bonferroni(p_value, trials)
    terms: tuple[DifferenceNoise | Resonance | Smoothing, ...] = ()
    if corrected < 0.01:
        frequency = float(score.w[at] + score.w[min(at + width, count) - 1]) / 2 / (2 * pi * data.interval_s)
        band_hz = width / (count * 2 * data.interval_s)
        longest = data.span_s / (4 * pi)  # a width of four frequencies of the record
        tau = min(1 / (pi * band_hz), longest)
        excess = max(power / width - 1, 0.05) * float(np.mean(score.base[at : at + width]))
        sd = sqrt(excess * pi * 2 * width / (2 * count))
        cost = amplitude_cost(1, data.n) + log(max(count / width, 1)) + log(5)
        terms = tuple(Resonance(frequency, start, longest, sd, cost) for start in (tau, min(3 * tau, longest)))
        # What smoothing bends, or noise that neighbours share lifts, a wide band may fill up.
        terms = (*terms, *smoothings(data.n), DifferenceNoise(sd, amplitude_cost(1, data.n)))
    return Evidence(
        check="strongest band of the residuals' spectrum: power over its mean",
        p_value=corrected,
        observed=power / width,
        low=0.0,
        high=float(gamma.isf(0.025 / trials, width)) / width,
        terms=terms,
    )
