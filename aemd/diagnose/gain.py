"""What a term is worth: the log probability it adds on blocks that its fit never saw.

Blocks of a minute, or of less where an effect is local, alternate between two folds. For each fold the parameters are
fitted with its blocks missing, and the score is

    log p(test | train) = log-likelihood(all) - log-likelihood(test missing)

at those parameters: joint over the blocks, so the filter may use what surrounds them, as any user of the model would.
Both folds together test every reading once.

What surrounds a block already tells of an effect that is slower than the block, whoever models it. For slow terms the
score is therefore that of a user who does not know the future: the log density of each reading of the test blocks given
all before it, at the same parameters.
"""

from math import inf, sqrt

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.climb import climb_on, densities
from aemd.diagnose.hypothesis import Data, Term
from aemd.diagnose.result import Gain

__all__ = ["SLOW", "HeldOut", "block_of", "measure_gain"]

Floats = NDArray[np.float64]

_BLOCK_S = 60.0
SLOW = ("thermal_drift", "supply_coupling", "flicker_noise", "random_walk", "extra_gauss_markov")
"""Terms that are scored forward."""
_LEAST_BLOCKS = 20
"""So that the spread over blocks means something where the record is short."""


class HeldOut:
    """Scores hypotheses on held-out blocks."""

    def __init__(self, data: Data, block_s: float) -> None:
        """Take the data and the length of a block; see `block_of`."""
        self._data = data
        self._block = (data.t_s // block_s).astype(np.int64)

    def score(self, terms: tuple[Term, ...], theta: Floats, *, forward: bool) -> Floats:
        """Return the score of each block, beginning the fits at `theta`, shape (blocks,).

        Args:
            terms: the hypothesis.
            theta: its free numbers fitted to all.
            forward: score each test reading given those before it, instead of the blocks given the other fold.
        """
        data = self._data
        scores = np.zeros(int(self._block[-1]) + 1)
        for fold in (0, 1):
            test = self._block % 2 == fold
            train = data.only(~test)
            found = climb_on(terms, theta, train)
            given_past = densities(terms, found, data)
            if forward:
                scores += np.bincount(self._block, np.where(test, given_past, 0.0), scores.size)
            else:
                scores += self._in_fold(given_past - densities(terms, found, train), fold)
        return scores

    def _in_fold(self, differences: Floats, fold: int) -> Floats:
        """Sum over each test block and the training block behind it, whose densities it changes."""
        at = np.maximum(self._block - (self._block % 2 != fold), 0)
        return np.bincount(at, differences, int(self._block[-1]) + 1).astype(np.float64)


def block_of(data: Data, term: Term) -> float:
    """Return the length of a block that suits a term, s.

    A minute, but no more than a third of what is local, or the one block that holds it has nobody to learn from.
    """
    local_s = {
        "step": 3.0,
        "warmup_drift": getattr(term, "tau_s", inf) / 3,
        "ring_down": getattr(term, "decay_s", inf) / 3,  # the loudest shock's ring is often most of all
    }
    block_s = min(_BLOCK_S, data.span_s / _LEAST_BLOCKS, local_s.get(term.cause, inf))
    return max(block_s, 4 * data.interval_s)


def measure_gain(before: Floats, after: Floats, n: int) -> Gain:
    """Return the gain from two hypotheses' block scores; its interval from their spread over blocks.

    The spread is not taken below that of a log ratio whose mean is the gain, of variance 2 gain; with a few blocks only
    that is known.
    """
    difference = after - before
    total = float(difference.sum())
    observed = float(np.var(difference, ddof=1)) * difference.size if difference.size >= _LEAST_BLOCKS // 2 else 0.0
    spread = sqrt(max(observed, 2 * abs(total)))
    return Gain(total / n, total, total - 1.96 * spread, total + 1.96 * spread)
