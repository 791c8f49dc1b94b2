"""What a term is worth: the log probability it adds on blocks that its fit never saw.

Blocks of a minute alternate between two folds. For each fold the parameters are fitted with its blocks missing, and the
score is log p(test | train) = log-likelihood(all) - log-likelihood(test missing) at those parameters: joint over the
block, so the filter may use what surrounds it, as any user of the model would. Both folds together test every reading
once.
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.fit import Fit, climb, densities
from aemd.diagnose.hypothesis import Data, Term
from aemd.diagnose.result import Gain

__all__ = ["HeldOut", "measure_gain"]

Floats = NDArray[np.float64]

_BLOCK_S = 60.0
_LEAST_BLOCKS = 20
"""So that the spread over blocks means something where the record is short."""


class HeldOut:
    """Scores hypotheses on held-out blocks."""

    def __init__(self, data: Data) -> None:
        self._data = data
        block_s = min(_BLOCK_S, data.span_s / _LEAST_BLOCKS)
        self._block = (data.t_s // block_s).astype(np.int64)

    def score(self, terms: tuple[Term, ...], theta: Floats) -> Floats:
        """Return log p(block | the other fold) of each block, beginning the fits at `theta`, shape (blocks,)."""
        data = self._data
        scores = np.zeros(int(self._block[-1]) + 1)
        for fold in (0, 1):
            test = self._block % 2 == fold
            train = data.only(~test)
            found, _ = climb(terms, theta, train, iterations=15)
            differences = densities(terms, found, data) - densities(terms, found, train)
            scores += self._in_fold(differences, fold)
        return scores

    def _in_fold(self, differences: Floats, fold: int) -> Floats:
        """Sum over each test block and the training block behind it, whose densities it changes."""
        at = np.maximum(self._block - (self._block % 2 != fold), 0)
        return np.bincount(at, differences, int(self._block[-1]) + 1).astype(np.float64)


def measure_gain(before: Floats, after: Floats, n: int) -> Gain:
    """Return the gain from two hypotheses' block scores; its interval from their spread over blocks.

    The spread is not taken below that of a log ratio whose mean is the gain: variance 2 gain.
    """
    difference = after - before
    total = float(difference.sum())
    spread = sqrt(max(float(np.var(difference, ddof=1)) * difference.size, 2 * abs(total)))
    return Gain(total / n, total, total - 1.96 * spread, total + 1.96 * spread)


def compare(held: HeldOut, full: Fit, without: Fit) -> Gain:
    """Return what `full` gains over `without`."""
    return measure_gain(held.score(without.terms, without.theta), held.score(full.terms, full.theta), full.data.n)
