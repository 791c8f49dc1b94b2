"""What one more term adds to the likelihood: where a score, the slope at nothing, sees too little of an effect."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from aemd.diagnose.climb import Climb
from aemd.diagnose.fit import Fit
from aemd.diagnose.hypothesis import Term

__all__ = ["LONG", "MOST_OF_ONE", "gain_of", "tail_of_one"]

Floats = NDArray[np.float64]

LONG = 100_000
"""Readings from which scores do alone: what there is to see is smaller and nearer to its slope, and a climb costs."""
MOST_OF_ONE = float(chi2.isf(0.05, 1)) / 2
"""Nats, 1.92: of one number too many 19 records of 20 gain no more."""
_FIRST_STEPS, _LAST_STEPS = 2, 10
"""Of each climb, and of the one that goes on at most."""
_PROMISING = 6.0
"""Nats that a climb must have hope of after its first steps."""


def gain_of(fit: Fit, starts: Sequence[tuple[Term, Floats]]) -> tuple[float, Floats]:
    """Return the log-likelihood that one more term adds, all else fitted again, and the free numbers there.

    The climb that has most hope after its first steps goes on, for as long as it has some. That it began lowest is no
    sign against it: what the base has imitated must give way first. What is given up has gained too little, so the
    gain is never more than the likelihood's.

    Args:
        fit: what is explained so far.
        starts: the term, with free numbers of all terms to begin with.
    """
    begun = [Climb([*fit.terms, term], start, fit.data) for term, start in starts]
    for one in begun:
        for _ in range(_FIRST_STEPS):
            if not one.done:
                one.step()
    best = max(begun, key=lambda one: one.hope)
    for _ in range(_LAST_STEPS - _FIRST_STEPS):
        if best.done or best.hope < fit.log_likelihood + _PROMISING:
            break
        best.step()
    best = max(begun, key=lambda one: one.value)
    return best.value - fit.log_likelihood, best.theta


def tail_of_one(gain: float) -> float:
    """Return the probability that one number too many adds so much, nats (Wilks).

    >>> round(tail_of_one(1.921), 3)
    0.05
    """
    return float(chi2.sf(2 * max(gain, 0.0), 1))
