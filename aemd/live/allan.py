"""The Allan deviation of a stream, kept up to date in constant memory.

    sigma^2(m tau_0) = < (y_{k+1} - y_k)^2 > / 2,   y_k the mean of m readings       (IEEE Std 1139, eq. 1)

at every averaging time m = 1, 2, 4, ..., over the non-overlapping pairs since the start. Means of 2 m readings come
from two means of m, so a reading costs two additions, whatever the length of the record.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["RunningAllan"]

FEW = 6  # readings that are taken one by one: at slow rates a batch has one or two
OCTAVES = 40  # 2^40 readings are 3 years at 10,000 /s
MOST_MISSING = 1 << 16  # missing readings that a block may be lacking; a longer hole starts the blocks anew

Values = NDArray[np.float64]


@dataclass(slots=True)
class _Octave:
    """Blocks of 2^k readings."""

    squares: float = 0.0
    """Sum of squared differences of neighbouring means, V^2."""
    pairs: int = 0
    mean: float = np.nan
    """Of the newest block, which the next is compared with; NaN for none."""
    waiting: tuple[float, float] | None = None
    """Mean and readings of a block that is the first half of one of the next octave."""


class RunningAllan:
    """Squared differences of means, octave by octave. Not thread-safe."""

    def __init__(self) -> None:
        self._octaves = [_Octave() for _ in range(OCTAVES)]
        self._next_index = -1

    def add(self, index: NDArray[np.int64], values: Values) -> None:
        """Take readings, shape (n,), and their numbers, which rise; a hole in these, or a NaN, is a missing reading.

        A block counts if at least half of its readings are there.
        """
        if not index.size:
            return
        expected = self._next_index if self._next_index >= 0 else int(index[0])
        self._next_index = int(index[-1]) + 1
        missing = int(index[0]) - expected, int(index[-1]) - int(index[0]) + 1 - index.size
        if max(missing) > MOST_MISSING or min(missing) < 0:
            for octave in self._octaves:
                octave.mean, octave.waiting = np.nan, None
            if missing[1]:  # nowhere to begin but behind the hole
                hole = int(np.argmax(np.diff(index))) + 1
                index, values = index[hole:], values[hole:]
            expected = int(index[0])
        line = np.full(self._next_index - expected, np.nan)
        line[index - expected] = values
        present = np.isfinite(line)
        if line.size <= FEW:
            for mean, weight in zip(np.where(present, line, 0.0).tolist(), present.tolist(), strict=True):
                self._cascade_one(mean, float(weight))
            return
        self._cascade(np.where(present, line, 0.0), present.astype(np.float64))

    def _cascade_one(self, mean: float, weight: float) -> None:
        """Take one block of one reading, as `_cascade` takes many."""
        size = 1
        for octave in self._octaves:
            newest = mean if 2 * weight >= size else math.nan
            step = newest - octave.mean
            if not math.isnan(step):
                octave.squares += step * step
                octave.pairs += 1
            octave.mean = newest
            if octave.waiting is None:
                octave.waiting = mean, weight
                return
            before, share = octave.waiting
            octave.waiting = None
            both = share + weight
            mean, weight = (before * share + mean * weight) / max(both, 1.0), both
            size *= 2

    def _cascade(self, means: Values, weights: Values) -> None:
        """Take blocks of one reading, then pair them to blocks of two, and so on.

        Args:
            means: mean of each block, shape (n,), V.
            weights: readings that each has, shape (n,).
        """
        size = 1
        for octave in self._octaves:
            if not means.size:
                return
            chain = np.concatenate(([octave.mean], np.where(2 * weights >= size, means, np.nan)))
            steps = np.diff(chain)
            steps = steps[np.isfinite(steps)]
            octave.squares += float(steps @ steps)
            octave.pairs += steps.size
            octave.mean = float(chain[-1])
            if octave.waiting is not None:
                means = np.concatenate(([octave.waiting[0]], means))
                weights = np.concatenate(([octave.waiting[1]], weights))
            octave.waiting = (float(means[-1]), float(weights[-1])) if means.size % 2 else None
            even = means.size - means.size % 2
            both = weights[0:even:2] + weights[1:even:2]
            # Of nothing, 0: its weight says that it is no value.
            means = (means[0:even:2] * weights[0:even:2] + means[1:even:2] * weights[1:even:2]) / np.maximum(both, 1.0)
            weights = both
            size *= 2

    def deviations(self) -> tuple[list[int], list[float], list[int]]:
        """Return averaging lengths in readings, the deviation at each in V, and the pairs that it is made of."""
        found = [(1 << k, octave) for k, octave in enumerate(self._octaves) if octave.pairs]
        return (
            [length for length, _ in found],
            [float(np.sqrt(octave.squares / (2 * octave.pairs))) for _, octave in found],
            [octave.pairs for _, octave in found],
        )
