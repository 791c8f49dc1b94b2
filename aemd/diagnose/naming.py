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

from aemd.diagnose.fit import Fit, begin_with, climb, refit
from aemd.diagnose.hypothesis import Term

__all__ = ["Named", "name"]

_SKETCH = 6
"""Steps of each candidate's fit before those that lag behind are given up."""
_LONG = 50_000
"""Readings from which half as many are enough: likelihoods of long records are steep."""
_HOPELESS = 20.0
"""Nats that a sketch may lie behind the best; two starts of one term seldom end so far apart from where they meet."""
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
    sketches = []
    for term in candidates:
        theta, value = climb(
            [*fit.terms, term], begin_with(fit, term), fit.data, _SKETCH if fit.data.n <= _LONG else _SKETCH // 2
        )
        sketches.append((value - term.cost_nats, theta, term))
    near = max(worth for worth, _, _ in sketches) - _HOPELESS
    fitted: dict[str, tuple[float, Fit, Term]] = {}
    for sketch, theta, term in sketches:
        if sketch < near:
            continue
        trial = refit([*fit.terms, term], fit.data, theta)
        worth = trial.log_likelihood - fit.log_likelihood - term.cost_nats
        if term.cause not in fitted or worth > fitted[term.cause][0]:
            fitted[term.cause] = worth, trial, term
    ranked = sorted(fitted.values(), key=lambda item: -item[0])
    top, winner, term = ranked[0]
    gain = winner.log_likelihood - fit.log_likelihood
    if gain < least_nats:
        return None
    weights = [exp(max(worth - top, -700.0)) for worth, _, _ in ranked]
    names, mass = list[str](), 0.0
    for weight, (_, _, rival) in zip(weights, ranked, strict=True):
        names.append(rival.cause)
        mass += weight / sum(weights)
        if mass >= _CREDIBLE:
            break
    return Named(winner, term, tuple(names), weights[0] / sum(weights), gain)
