"""The grid of whole intervals on which stamps lie: how long the interval is, and where the stamps leave the grid.

A meter paces itself; what reads its clock for it comes late by a little each time, and that does not add up. So one
step between two stamps tells the interval badly, and many steps together tell it well.
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

__all__ = ["ON_GRID", "digit_of", "first_interval_of", "interval_of", "jumps_for_good", "scatter", "steps_for_good"]

Floats = NDArray[np.float64]

ON_GRID = 0.2
"""Intervals from a whole multiple that a step may be stamped off, and still be that multiple."""
_NEIGHBOURS = 9
"""Stamps on each side of a gap whose median says where they are: jitter of a quarter interval moves that by a tenth."""
_SURE = 3.5
"""Of the stamps' scatter: six times what the two medians' difference scatters by, 1.25 sqrt(2 / 9)."""
_PARTS = 8
"""Of a run of readings: stamps one part apart are compared, so that a clock set once moves an eighth of the pairs."""
_CUT = 0.05
"""Intervals by which the stamps jump where those before are not compared with those behind."""
_OUTLIERS = 5.0
_TO_SD = 1.4826


def scatter(steps: Floats) -> float:
    """Return the standard deviation of the stamps whose differences these are, most of which are normal."""
    return _TO_SD / sqrt(2) * float(np.median(np.abs(steps - np.median(steps))))


def steps_for_good(steps: Floats) -> NDArray[np.int64]:
    """Return the whole steps of readings without numbers; a stamp that came late is none that lacks its neighbour.

    The readings after a gap stay behind the grid of those before it, by their median; those after a late stamp are
    on it again.

    Args:
        steps: between stamps, in intervals, shape (n - 1,).
    """
    at = np.flatnonzero(np.rint(steps) > 1)
    for_good = at[_moved(np.concatenate(([0.0], np.cumsum(steps - 1))), at) > 0.5]
    whole = np.ones(steps.size, dtype=np.int64)
    whole[for_good] = np.rint(steps[for_good])
    return whole


def jumps_for_good(left: Floats, digit: float, least: float = ON_GRID) -> NDArray[np.bool_]:
    """Return at which steps the stamps leave the grid and stay off it: at a pause of no whole length, a clock set.

    Args:
        left: stamps less their places on the grid, in intervals, shape (n,).
        digit: of the stamps, in intervals; rounding alone moves them by less.
        least: jump that counts, intervals.
    """
    steps = np.diff(left)
    at = np.flatnonzero(np.abs(steps) > least)
    jumped = np.zeros(steps.size, dtype=bool)
    jumped[at] = np.abs(_moved(left, at)) > max(least, digit, _SURE * scatter(steps))
    return jumped


def digit_of(time_s: Floats) -> float:
    """Return the digit to which stamps were rounded, s: what all steps are multiples of, at least 1 ns."""
    return float(np.gcd.reduce(np.rint(np.diff(time_s) * 1e9).astype(np.int64))) * 1e-9


def _moved(left: Floats, at: NDArray[np.intp]) -> Floats:
    """Return by how much the stamps behind these steps are off those before them, by their medians."""
    before = left[np.maximum(at[:, None] - np.arange(_NEIGHBOURS), 0)]
    after = left[np.minimum(at[:, None] + 1 + np.arange(_NEIGHBOURS), left.size - 1)]
    return np.asarray(np.median(after, axis=1) - np.median(before, axis=1))


def first_interval_of(time_s: Floats, counted: NDArray[np.int64] | int = 1) -> float:
    """Return the mean of the steps that are one interval long: good to a fraction of the stamps' scatter over sqrt(n).

    A log's stamps are rounded, so that the median of its steps is; their mean is not.

    Args:
        time_s: stamps, rising, shape (n,), at least 2.
        counted: readings from each to the next, by their numbers.
    """
    steps = np.diff(time_s) / counted
    at = (steps.size - 1) // 2
    middle = np.partition(steps, at)[at]  # one of them, where two lengths are equally many
    return float(np.mean(steps[np.abs(steps - middle) < 0.5 * middle + digit_of(time_s)]))


def interval_of(time_s: Floats, whole: NDArray[np.int64], first_s: float) -> float:
    """Return the interval of the grid, by stamps an eighth of the record apart.

    Their mean, of which the few that are far out are left, errs by 4.6 sd / n^1.5; a straight line's slope by 3.5, but
    one burst of late stamps would tilt it. Stamps on two sides of a jump are not compared, nor are those of a gap so
    long that its whole steps are not sure.

    Args:
        time_s: stamps, rising, shape (n,), at least 2.
        whole: steps on the grid, shape (n - 1,).
        first_s: the interval roughly, as `first_interval_of` finds it.
    """
    slot = np.concatenate(([0], np.cumsum(whole)))
    left = time_s / first_s - slot
    off = np.diff(left)
    error = float(np.sqrt(np.mean(np.minimum(np.abs(off), 0.5) ** 2) / slot.size))
    digit = digit_of(time_s) / first_s
    jumped = jumps_for_good(left, digit, _CUT)
    run = np.concatenate(([0], np.cumsum(jumped | ((whole - 1) * error > ON_GRID / 2))))
    lengths = np.bincount(run)
    pairs = np.arange(slot.size)
    to = pairs + np.maximum(lengths // _PARTS, 1)[run]
    pairs = pairs[to < np.cumsum(lengths)[run]]
    if not pairs.size:
        return first_s
    to = to[pairs]
    apart, late = (slot[to] - slot[pairs]).astype(np.float64), left[to] - left[pairs]
    each = late / apart
    order = np.argsort(each)
    weight = np.cumsum(apart[order])
    out = np.abs(late - each[order[np.searchsorted(weight, weight[-1] / 2)]] * apart)
    kept = out <= max(ON_GRID + digit, _OUTLIERS * _TO_SD * float(np.median(out)))
    return first_s * (1 + float(late[kept] @ apart[kept]) / float(apart[kept] @ apart[kept]))
