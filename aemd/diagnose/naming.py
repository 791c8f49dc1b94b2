"""Rivals are fitted side by side; the odds say which names the data can carry.

Every candidate is refitted together with all that is already in the model. Its evidence is Laplace's: the
log-likelihood it adds less what its freedom costs, half log n for an amplitude (a prior as wide as one reading's
information allows)
and the logarithm of the number of places it could have been for a location (frequency, instant, time constant). Equal
prior odds, except where a term states others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp

from aemd.diagnose.climb import Climb, race
from aemd.diagnose.fit import Fit, begin_with, residuals, steps_for
from aemd.diagnose.hypothesis import Term

__all__ = ["Named", "name"]

_CREDIBLE = 0.95
"""The set of names holds the truth with this probability; two rivals 5.4 nats apart are told apart by it."""


@dataclass(frozen=True, slots=True)
class Named:
    """The winner of a round."""

    fit: Fit
    term: Term
    names: tuple[str, ...]
    probability: float
    log_likelihood_gain: float


def name(fit: Fit, candidates: Sequence[Term], least_nats: float) -> Named | None:
    """Return the best candidate and the names it cannot be told from; None if none is worth its freedom.

    Args:
        fit: what is explained so far.
        candidates: terms with starts.
        least_nats: log-likelihood that the winner must add.
    """
    if not candidates:
        return None
    starts = [
        Climb([*fit.terms, term], begin_with(fit, term), fit.data, term.cost_nats)
        for term in {repr(term): term for term in candidates}.values()  # checks that fail together nominate the same
    ]
    fitted: dict[str, Climb] = {}
    for one in race(starts, steps_for(fit.data)):
        fitted.setdefault(one.terms[-1].cause, one)
    ranked = list(fitted.values())
    best = ranked[0]
    gain = best.value - fit.log_likelihood
    if gain < least_nats:
        return None
    weights = [exp(max(one.worth - best.worth, -700.0)) for one in ranked]
    names, mass = list[str](), 0.0
    for weight, rival in zip(weights, ranked, strict=True):
        names.append(rival.terms[-1].cause)
        mass += weight / sum(weights)
        if mass >= _CREDIBLE:
            break
    winner = residuals(best.terms, best.theta, fit.data)
    return Named(winner, best.terms[-1], tuple(names), weights[0] / sum(weights), gain)
