"""Rivals are fitted side by side; the odds say which names the data can carry.

Every candidate is refitted together with all that is already in the model. Its evidence is Laplace's: the
log-likelihood it adds less what its freedom costs, half log n for an amplitude (a prior as wide as one reading's
information allows) and the logarithm of the number of places it could have been for a location (frequency, instant,
time constant). Equal prior odds, except where a term states others.

The best of the catalogue may still be the wrong name of what the catalogue does not have. A name is refused where a
rival from outside explains more, and where a mechanism that acts all the time explains what happened once; so what
rings after shocks, of which one is often most, runs against a wave that comes once, at any time. What is left once
every name is given is judged elsewhere (goodness.py).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, log

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from aemd.diagnose.checks.shapes import check_step
from aemd.diagnose.climb import Climb, assemble, race
from aemd.diagnose.evidence import exceedance_of_peaks
from aemd.diagnose.fit import Fit, begin_with, residuals, steps_for
from aemd.diagnose.hypothesis import Data, Term
from aemd.diagnose.terms.events import Popcorn
from aemd.diagnose.terms.lines import Sines, WanderingLine, amplitude_cost, fold
from aemd.diagnose.terms.noise import ChangingNoise, HeavyTails, Resonance, SignalDependentNoise
from aemd.diagnose.terms.witnessed import called

__all__ = ["NOT_WHITE", "Named", "acts_throughout", "is_coloured", "left_out", "name"]

Floats = NDArray[np.float64]

_CREDIBLE = 0.95
"""The set of names holds the truth with this probability; two rivals 5.4 nats apart are told apart by it."""
_PARTS = 12
"""Of the record, over which a gain is compared."""
_ONCE = 1e-4
"""p of a gain so uneven, below which what acts all the time is no name for it."""
_ONCE_UNRESOLVED = 0.01
"""The same for a resonance as narrow as the record can tell: then one swell is as likely."""
_HARDLY_UNEVEN = 0.35
"""Deviation of the parts' gains over their mean that goes with what acts all the time: of thousands of nats a tenth
more here and there is many deviations, and no sign of anything that comes and goes."""
_EVEN = ("mains_alias", "periodic_interference", "wandering_line", "resonance", "difference_noise", "reading_pattern")
"""Mechanisms that act all the time."""
_LINKED = ("nonlinearity", "signal_dependent_noise", "smoothing")
"""Mechanisms that act as much as the input moves, which may be uneven."""
_MOST_IN_ONE = 0.7
"""Of their gain, from one of the parts."""
_CROWDED = (*_LINKED, "shock_law")
_MOST_IN_A_STRETCH = 0.5
"""Of their gain, and of what a change of the shocks' law brings, from the best twentieth of the record."""
_LEAST_TURNS = 3.0
"""Of what is said to come again, in a record."""
_LEAST_TO_COLOUR = 20
"""Readings."""
_MOST_LINES = 6
_MOST_TO_SPLIT = 200_000
"""Readings; lines are fitted with all of them at hand."""
_CLEARLY = 2.0
"""Nats."""
_SELDOM = log(3.0)
"""Nats against a rival from outside of the catalogue: a judgement of how seldom those are, derived from nothing."""
NOT_WHITE = "which would be white, and this is not"
"""Why a noise that changes is refused; what else is in the record may be what colours it."""


@dataclass(frozen=True, slots=True)
class Named:
    """The winner of a round."""

    fit: Fit
    term: Term
    names: tuple[str, ...]
    probability: float
    refused: str = ""
    """Why the names are not to be claimed, in words that follow the first of them; empty where they are."""


def name(fit: Fit, candidates: Sequence[Term], least_nats: float) -> Named | None:
    """Return the best candidate and the names it cannot be told from; None if none is worth its freedom.

    What is worth its freedom but not its name comes back as well, `refused`: kept in the model, it does not hide what
    else there is.

    Args:
        fit: what is explained so far.
        candidates: terms with starts.
        least_nats: log-likelihood that the winner must add.
    """
    if not candidates:
        return None
    starts = [
        Climb([*fit.terms, term], start, fit.data, term.cost_nats + (_SELDOM if term.cause == "unexplained" else 0.0))
        for term in {repr(term): term for term in candidates}.values()  # checks that fail together nominate the same
        for start in begin_with(fit, term)
    ]
    ended = race(starts, steps_for(fit.data))
    if isinstance(ended[0].terms[-1], WanderingLine):  # a line that stands still gets the winner's base to begin with
        beside = ended[0].theta[: fit.theta.size]
        still = [
            Climb([*fit.terms, term], np.concatenate((beside, term.start)), fit.data, term.cost_nats)
            for term in {repr(term): term for term in candidates if isinstance(term, Sines)}.values()
        ]
        ended = sorted([*ended, *(race(still, steps_for(fit.data)) if still else [])], key=lambda one: -one.worth)
    if _jumps_seldom(ended[0]):
        ended = _race_steps(ended)
    for one in ended:
        one.cost_nats -= left_out(one.terms, one.theta, fit.data)
    ended = sorted(ended, key=lambda one: -one.worth)
    fitted: dict[str, Climb] = {}
    for one in ended:
        fitted.setdefault(one.terms[-1].cause, one)
    ranked = list(fitted.values())
    best = ranked[0]
    if best.value - fit.log_likelihood < least_nats:
        return None
    weights = [exp(max(one.worth - best.worth, -700.0)) for one in ranked]
    shares = dict[str, float]()  # a gain and an offset of one voltage are two kinds to fit, and one name
    for weight, rival in zip(weights, ranked, strict=True):
        shares[called(rival.terms[-1])] = shares.get(called(rival.terms[-1]), 0.0) + weight / sum(weights)
    names, mass = list[str](), 0.0
    for name_of, share in shares.items():
        names.append(name_of)
        mass += share
        if mass >= _CREDIBLE:
            break
    winner = residuals(best.terms, best.theta, fit.data)
    refused = ""
    if best.terms[-1].cause == "unexplained":
        refused = "but something that is not in the catalogue explains more"
        causes = [rival.terms[-1].cause for rival in ranked] + [term.cause for term in candidates]
        names = [next((cause for cause in causes if cause != "unexplained"), "nothing of the catalogue")]
    else:
        refused = _does_not_fit(fit, winner)
    return Named(winner, best.terms[-1], tuple(names), shares[called(best.terms[-1])], refused)


def left_out(terms: Sequence[Term], theta: Floats, data: Data) -> float:
    """Return the log-likelihood of the skewness that a noise which grows with the reading has, nats; 0 of all others.

    The filter takes that noise by its variance R at the prediction. But a reading that the input's news u, of variance
    P, has lifted has more of it, R' u, so the innovation has the third moment 3 R' P, and by the first term of its
    Gram-Charlier series the likelihood gains c He3(z) - 3 c^2 with c = R' P/(2 S^(3/2)). A bent scale is skew in the
    same way, and would be the name of this noise for nothing else. News may be the meter's own noise as well, which
    lifts no reading of the input: where the fast process of a base stands for that, all of it. So what share of the
    news counts, from none to all, the readings say.
    """
    if not isinstance(terms[-1], SignalDependentNoise):
        return 0.0
    fit, used = residuals(terms, theta, data), data.used
    noise_var = assemble(terms, theta, data)[2][1][used]
    per_square, reading = exp(2 * float(theta[-1])), (fit.predicted + data.origin_V / data.unit_V)[used]
    news = np.maximum(fit.variance[used] - noise_var - per_square * reading**2, 0.0)
    c, z = per_square * reading * news / fit.variance[used] ** 1.5, fit.z[used]
    along, size = float(np.sum(c * (z**3 - 3 * z))), float(np.sum(3 * c**2))
    share = float(np.clip(along / max(2 * size, 1e-300), 0.0, 1.0))
    return share * along - share**2 * size


def _does_not_fit(before: Fit, after: Fit) -> str:
    """Return what the last term's mechanism would do and the readings do not, in words; empty where there is nothing.

    The best of the catalogue is held against what only it would do: go on, come back, be white.
    """
    term, theta, span_s = after.terms[-1], after.parts_of(len(after.terms) - 1), after.data.span_s
    if not acts_throughout(before, after):
        return "which would act all the time, and this does not"
    if term.cause in _CROWDED and _share_of_the_best_stretch(before, after) > _MOST_IN_A_STRETCH:
        return "which would show wherever the readings move, and this shows in one place"
    if isinstance(term, Sines):
        turns = fold(term.harmonics[0] * (term.frequency_hz + theta[0] / span_s), 1 / after.data.interval_s) * span_s
        if turns < _LEAST_TURNS:
            return "which would come again and again, and the record holds less than three turns of it"
    if isinstance(term, Resonance) and _is_some_lines(before, after, term):
        return "which would swing at random, and some lines beside each other explain more"
    if isinstance(term, Popcorn) and _visits(theta, span_s) < _LEAST_TURNS:
        return "which would jump again and again, and the record holds less than three visits"
    if isinstance(term, HeavyTails) and exp(theta[0]) * np.count_nonzero(after.data.used) < _LEAST_TURNS:
        return "which would come again and again, and the record holds less than three readings of it"
    if is_coloured(after, term):
        return NOT_WHITE
    return ""


def _visits(theta: Floats, span_s: float) -> float:
    """Return how often a level that jumps has been at both of its values in a record, on average."""
    return float(span_s / (exp(theta[1]) + exp(theta[2])))


def _jumps_seldom(best: Climb) -> bool:
    return isinstance(best.terms[-1], Popcorn) and _visits(best.theta[-3:], best.data.span_s) < _LEAST_TURNS


def _race_steps(ended: list[Climb]) -> list[Climb]:
    """Return the same with steps among them, where the best is a level that has hardly jumped twice.

    Shocks may have imitated a step so well that no check asked for one; a level that replaces them shows it. So the
    steps are looked for beside what is beside that level, and begin from there.
    """
    best, rest = ended[0], ended[0].terms[:-1]
    beside = best.theta[: -best.terms[-1].start.size]
    steps = check_step(residuals(rest, beside, best.data)).terms
    starts = [Climb([*rest, step], np.concatenate((beside, step.start)), best.data, step.cost_nats) for step in steps]
    more = race(starts, steps_for(best.data)) if starts else []
    return sorted([*ended, *more], key=lambda one: -one.worth)


def _share_of_the_best_stretch(before: Fit, after: Fit) -> float:
    """Return the share of a gain that comes from the stretch of a twentieth of the record where it is largest."""
    gained = np.array([part.sum() for part in np.array_split((after.each - before.each)[after.data.used], 40)])
    return float((gained[1:] + gained[:-1]).max()) / max(float(gained.sum()), 1e-9)


def _is_some_lines(before: Fit, after: Fit, term: Resonance) -> bool:
    """Return whether two lines or more, of free frequencies in its band, explain more than a resonance does.

    One wave of a form that is not in the catalogue, such as a beat, is a few lines; a resonance as narrow has a
    power of its own at each frequency, and needs as many. The lines are fitted to the residuals of the fit without
    either, one after another; there a wave is a wave still, since the filter has settled.
    """
    data = before.data
    if data.y.size > _MOST_TO_SPLIT or not before.z.any():
        return False
    theta = after.parts_of(len(after.terms) - 1)
    centre_hz, half_hz = term.frequency_hz + theta[1] / term.tau_s, max(1.5 / (np.pi * exp(theta[0])), 4 / data.span_s)
    grid_hz = np.fft.rfftfreq(4 * data.y.size, data.interval_s)
    band = (np.abs(grid_hz - centre_hz) < half_hz) & (grid_hz > 1 / data.span_s)
    if not band.any():
        return False
    cost = amplitude_cost(2, data.n) + log(max(2 * half_hz * data.span_s, 1.0))
    needed = after.log_likelihood - before.log_likelihood - term.cost_nats + _CLEARLY
    left, waves = before.z, list[NDArray[np.float64]]()
    for count in range(1, _MOST_LINES + 1):
        power = np.abs(np.fft.rfft(left, 4 * data.y.size)) ** 2
        angle = 2 * np.pi * float(grid_hz[band][np.argmax(power[band])]) * data.t_s
        waves += [np.where(data.used, np.cos(angle), 0.0), np.where(data.used, np.sin(angle), 0.0)]
        columns = np.column_stack(waves)
        left = before.z - columns @ np.linalg.lstsq(columns, before.z, rcond=None)[0]
        if count > 1 and 0.5 * float(before.z @ before.z - left @ left) - count * cost > needed:
            return True
    return False


def is_coloured(fit: Fit, term: Term) -> bool:
    """Return whether a line stands out of the residuals while the noise is another, where it should be white."""
    if not isinstance(term, ChangingNoise):
        return False
    inside = fit.data.used & (fit.data.t_s >= term.begin_s) & (fit.data.t_s < term.end_s)
    z = fit.z[inside]
    if z.size < _LEAST_TO_COLOUR:
        return False
    power = np.abs(np.fft.rfft(z - z.mean())) ** 2 / max(float(np.sum((z - z.mean()) ** 2)), 1e-300)
    return exceedance_of_peaks(float(power[1:-1].max()), z.size / 2) < _ONCE


def acts_throughout(before: Fit, after: Fit) -> bool:
    """Return whether the last term's gain comes from all of the record, where its mechanism says so.

    Over equal parts a gain D adds up from independent pieces of variance twice their mean; a resonance's swings more,
    as its power in each of its own spans 2 tau is drawn anew, with a variance of its square.
    """
    term, used = after.terms[-1], after.data.used
    gained = np.array([part.sum() for part in np.array_split((after.each - before.each)[used], _PARTS)])
    total = float(gained.sum())
    if term.cause in _LINKED:
        return float(gained.max()) < _MOST_IN_ONE * total
    if term.cause not in _EVEN or total <= 0:
        return True
    if float(gained.std()) < _HARDLY_UNEVEN * total / _PARTS:
        return True
    spread, once = 2 * total / _PARTS, _ONCE
    if isinstance(term, Resonance):
        tau_s = exp(float(after.parts_of(len(after.terms) - 1)[0]))
        spread += total**2 / _PARTS * 2 * tau_s / after.data.span_s
        once = _ONCE_UNRESOLVED if tau_s > 0.9 * term.longest_s else _ONCE
    uneven = float(np.sum((gained - total / _PARTS) ** 2)) / spread
    return float(chi2.sf(uneven, _PARTS - 1)) > once
