"""Extremes and means of a stream in bins of time, at several widths at once: seconds and days cost the same.

Level l has bins of 2^(20 + 2 l) ns, aligned to 1970, in a ring of fixed length. A chart takes the finest level whose
bins over the shown span are few enough for its width, so what it costs depends on the screen and not on the rate; and
no extreme is lost, whatever the level.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["BINS", "LEVELS", "Pyramid", "bin_ns"]

FINEST_BITS = 20  # 2^20 ns: a millisecond, ten readings of the fastest meter
STEP_BITS = 2  # a factor of 4 between levels: a chart gets a quarter to all of the columns that it can show
LEVELS = 9  # 1 ms, 4 ms, 17 ms, 67 ms, 0.27 s, 1.1 s, 4.3 s, 17 s, 69 s
FEW = 6  # readings that are entered one by one: at slow rates a batch has one or two
BINS = 1 << 13  # 9 s of the finest, 39 hours of the 17 s ones; 90 bytes each, 6 MB in all

Bins = NDArray[np.int64]
Values = NDArray[np.float64]

_ALL = np.arange(LEVELS)
_SHIFTS = STEP_BITS * _ALL


def bin_ns(level: int) -> int:
    """Return the width of a level's bins, ns."""
    return 1 << (FINEST_BITS + STEP_BITS * level)


class Pyramid:
    """Bins of one stream. Not thread-safe.

    Args:
        least: names of quantities of which a bin keeps the least value.
        greatest: names of those of which it keeps the greatest.
        total: names of those of which it keeps the sum.
    """

    def __init__(self, least: Sequence[str], greatest: Sequence[str], total: Sequence[str]) -> None:
        self._least, self._greatest, self._total = tuple(least), tuple(greatest), tuple(total)
        # A least value is kept as the greatest of the negated ones, so that one call serves them all.
        self._extremes = np.full((LEVELS, len(self._least) + len(self._greatest), BINS), np.nan)
        self._sums = np.zeros((LEVELS, len(self._total), BINS))
        self._bins = np.full((LEVELS, BINS), -1, np.int64)
        self._newest = -1

    def add(self, t_ns: NDArray[np.int64], values: Mapping[str, Values]) -> None:
        """Take more of the stream; a NaN is no extreme, and must not be in what is summed.

        Args:
            t_ns: instants, shape (n,). One before its predecessor (a clock's fit may step back) counts as that instant.
            values: each quantity, shape (n,).
        """
        if not t_ns.size:
            return
        bins = np.maximum(np.maximum.accumulate(t_ns >> FINEST_BITS), self._newest)
        self._newest = int(bins[-1])
        extremes = np.stack(
            [*(-values[name] for name in self._least), *(values[name] for name in self._greatest)],
        )
        sums = np.array([values[name] for name in self._total]).reshape(len(self._total), t_ns.size)
        if t_ns.size <= FEW:
            for at, number in enumerate(bins.tolist()):
                self._enter_one(number, extremes[:, at], sums[:, at])
            return
        for level in range(LEVELS):
            if level:
                bins = bins >> STEP_BITS
            starts = np.concatenate(([0], np.flatnonzero(bins[1:] != bins[:-1]) + 1))
            if starts.size < bins.size:
                bins = bins[starts]
                extremes = np.fmax.reduceat(extremes, starts, axis=1)
                sums = np.add.reduceat(sums, starts, axis=1)
            self._enter(level, bins, extremes, sums)

    def _enter_one(self, number: int, extremes: Values, sums: Values) -> None:
        """Put one reading into every level at once.

        Args:
            number: of its finest bin.
            extremes: shape (extremes,).
            sums: shape (sums,).
        """
        bins = number >> _SHIFTS
        slots = bins & (BINS - 1)
        same = self._bins[_ALL, slots] == bins
        self._extremes[_ALL, :, slots] = np.fmax(
            np.where(same[:, None], self._extremes[_ALL, :, slots], np.nan), extremes
        )
        self._sums[_ALL, :, slots] = np.where(same[:, None], self._sums[_ALL, :, slots], 0.0) + sums
        self._bins[_ALL, slots] = bins

    def _enter(self, level: int, bins: Bins, extremes: Values, sums: Values) -> None:
        """Put cells into a level's ring; only the first can be of a bin that is there already."""
        slots = bins[-BINS:] & (BINS - 1)
        extremes, sums, kept = extremes[:, -BINS:], sums[:, -BINS:], self._bins[level]
        first = slots[0]
        if kept[first] == bins[-BINS:][0]:
            extremes, sums = extremes.copy(), sums.copy()
            extremes[:, 0] = np.fmax(extremes[:, 0], self._extremes[level, :, first])
            sums[:, 0] += self._sums[level, :, first]
        self._extremes[level][:, slots] = extremes
        self._sums[level][:, slots] = sums
        kept[slots] = bins[-BINS:]

    @property
    def newest_ns(self) -> int:
        """End of the newest of the finest bins, ns; 0 while there is none."""
        return (self._newest + 1) << FINEST_BITS

    def cells(self, level: int, first: int, last: int | None = None) -> tuple[Bins, dict[str, Values]]:
        """Return the bins of a level that hold something, from number `first` to `last` inclusive, oldest first.

        Returns:
            Their numbers (a bin's number times its width is where it begins, ns since 1970), shape (n,), and each
            quantity, shape (n,); an extreme of nothing but NaN is NaN.
        """
        newest = self._newest >> (STEP_BITS * level)
        last = newest if last is None else min(last, newest)
        wanted = np.arange(max(first, newest - BINS + 1, 0), last + 1)
        slots = wanted & (BINS - 1)
        there = self._bins[level][slots] == wanted
        slots = slots[there]
        extremes, sums = self._extremes[level][:, slots], self._sums[level][:, slots]
        found = {name: -extremes[row] for row, name in enumerate(self._least)}
        found |= {name: extremes[len(self._least) + row] for row, name in enumerate(self._greatest)}
        return wanted[there], found | {name: sums[row] for row, name in enumerate(self._total)}

    @staticmethod
    def choose_level(span_ns: int, most: int, age_ns: int = 0) -> int:
        """Return the finest level that shows a span in at most so many bins, and that reaches back to its beginning.

        Args:
            span_ns: what is to be shown, ns.
            most: bins that it may take.
            age_ns: how long ago the span begins; 0 for just now.

        >>> [Pyramid.choose_level(seconds * 10**9, 800) for seconds in (1, 60, 3600, 86400)]
        [1, 4, 7, 8]
        """
        for level in range(LEVELS - 1):
            if span_ns <= most * bin_ns(level) and max(age_ns, span_ns) <= (BINS - 1) * bin_ns(level):
                return level
        return LEVELS - 1
