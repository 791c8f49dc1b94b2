"""What a term is worth: the log probability it adds on blocks that its fit never saw.

Blocks of a minute alternate between two folds. For each fold the parameters are
fitted with its blocks missing, and the score is

    log p(test | train) = log-likelihood(all) - log-likelihood(test missing)

at those parameters: joint over the blocks, so the filter may use what surrounds them, as any user of the model would.
Both folds together test every reading once.

What surrounds a block already tells of an effect that is slower than the block, whoever models it. For slow terms the
score is therefore that of a user who does not know the future: the log density of each reading of the test blocks given
all before it, at the same parameters.

Of an event all is told within a few readings: a block that holds it has nobody to learn from, and half of a handful of
shocks are too few to fit their law. There single readings are held out, in four folds, to which they are dealt by the
rank of their density, so that each has its share of the shocks. The filter follows all readings, but the numbers are
fitted to the densities, each given all before, of the other three folds, and scored by those of the fourth. At the true
numbers the residuals are independent, so what is fitted to some of them knows nothing of the others, and of an effect
in the mean each fold tells its own part. Where a step is, each fold finds anew.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.checks.shapes import step_scores
from aemd.diagnose.climb import climb_on, densities, split
from aemd.diagnose.fit import residuals
from aemd.diagnose.hypothesis import Data, Term
from aemd.diagnose.result import Gain
from aemd.diagnose.terms.shapes import Step

__all__ = ["LOCAL", "SLOW", "HeldOut", "block_of", "measure_gain"]

Floats = NDArray[np.float64]

_BLOCK_S = 60.0
SLOW = ("thermal_drift", "supply_coupling", "flicker_noise", "random_walk", "extra_gauss_markov")
"""Terms that are scored forward."""
LOCAL = ("step", "warmup_drift", "ring_down", "heavy_tails")
"""Events, of which single readings are held out; of a ring-down the loudest shock's is often most of all, and tails
stand beside shocks, of which there may be a handful, and which a base without tails has by the dozen."""
_READINGS = 0.0
"""Length of a block that stands for single readings, s."""
_FOLDS = 4
"""Of those: what a term's k numbers lose by being fitted to a part is about k/2 over one less than this, in all."""
_AS_LIKELY = 1.0
"""Nats within which a fold does not tell two instants apart."""
_LEAST_BLOCKS = 20
"""So that the spread over blocks means something where the record is short."""


class HeldOut:
    """Scores hypotheses on held-out blocks, or on held-out readings."""

    def __init__(self, data: Data, block_s: float, each: Floats) -> None:
        """Take the data, the length of a block, see `block_of`, and the log density of each reading, shape (n,)."""
        self._data = data
        self._single = block_s == _READINGS
        if self._single:
            self._block = np.argsort(np.argsort(np.where(data.used, each, np.inf), kind="stable")) % _FOLDS
        else:
            self._block = (data.t_s // block_s).astype(np.int64)

    def score(self, terms: tuple[Term, ...], theta: Floats, *, forward: bool) -> Floats:
        """Return the score of each block, shape (blocks,), or of each fold of single readings, shape (folds,).

        Args:
            terms: the hypothesis.
            theta: its free numbers fitted to all, where the fits begin.
            forward: score each test reading given those before it, instead of the blocks given the other fold; single
                readings always are.
        """
        if self._single:
            return np.array([self._score_readings(terms, theta, self._block == fold) for fold in range(_FOLDS)])
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

    def _score_readings(self, terms: tuple[Term, ...], theta: Floats, test: NDArray[np.bool_]) -> float:
        """Return the sum of the log densities of these readings, at numbers fitted to those of the others."""
        best = -np.inf, 0.0
        for there, start in ((terms, theta), *_placed_anew(terms, theta, self._data, ~test)):
            each = densities(there, climb_on(there, start, self._data, ~test), self._data)
            best = max(best, (float(each[~test].sum()), float(each[test].sum())))
        return best[1]

    def _in_fold(self, differences: Floats, fold: int) -> Floats:
        """Sum over each test block and the training block behind it, whose densities it changes."""
        at = np.maximum(self._block - (self._block % 2 != fold), 0)
        return np.bincount(at, differences, int(self._block[-1]) + 1).astype(np.float64)


def _placed_anew(
    terms: tuple[Term, ...], theta: Floats, data: Data, train: NDArray[np.bool_]
) -> list[tuple[tuple[Term, ...], Floats]]:
    """Return the hypothesis with each step where it is the largest to these readings' residuals, and where fits begin.

    None if these do not tell the places apart from those that all readings told. Where a step is so large that it was
    taken for a shock, the residuals without it do not show its place: which is likelier to these readings, fits tell.
    """
    moved, parts = list(terms), split(terms, theta)
    for number, term in enumerate(terms):
        if not isinstance(term, Step):
            continue
        rest = [at for at in range(len(terms)) if at != number]
        left = residuals([moved[at] for at in rest], np.concatenate([parts[at] for at in rest]), data)
        scores, size = step_scores(left, train & data.used)
        at, own = int(np.argmax(np.abs(scores))), int(np.searchsorted(data.t_s, term.time_s - data.interval_s / 2))
        if scores[at] ** 2 - scores[min(own, scores.size - 1)] ** 2 <= 2 * _AS_LIKELY:
            continue
        parts[number] = np.array([scores[at] / size[at]])
        moved[number] = replace(term, time_s=float(data.t_s[at]))
    return [] if moved == list(terms) else [(tuple(moved), np.concatenate(parts))]


def block_of(data: Data, terms: Sequence[Term]) -> float:
    """Return the length of a block that suits some terms, s: a minute, and where one of them is local, a reading."""
    if any(term.cause in LOCAL for term in terms):
        return _READINGS
    return max(min(_BLOCK_S, data.span_s / _LEAST_BLOCKS), 4 * data.interval_s)


def measure_gain(before: Floats, after: Floats, n: int) -> Gain:
    """Return the gain from two hypotheses' block scores; its interval from their spread over blocks.

    The spread is not taken below that of a log ratio whose mean is the gain, of variance 2 gain; with a few blocks, or
    folds of single readings, only that is known.
    """
    difference = after - before
    total = float(difference.sum())
    observed = float(np.var(difference, ddof=1)) * difference.size if difference.size >= _LEAST_BLOCKS // 2 else 0.0
    spread = sqrt(max(observed, 2 * abs(total)))
    return Gain(total / n, total, total - 1.96 * spread, total + 1.96 * spread)
