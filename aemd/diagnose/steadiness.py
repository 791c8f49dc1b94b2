"""What the findings mean to who averages: Allan deviations with and without what they account for."""

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.fit import Fit
from aemd.diagnose.result import Allan

__all__ = ["allan_deviation", "compare_allan"]

Floats = NDArray[np.float64]

_AVERAGING_S = (1.0, 10.0, 100.0)
_LEAST_MEANS = 5
"""Averaging times that a record must hold for a deviation to mean anything."""


def compare_allan(base: Fit, extended: Fit) -> tuple[Allan, ...]:
    """Return the deviations of the readings, and of what is left without the extended model's deterministic part."""
    data = extended.data
    slots = np.arange(int(data.slot[-1]) + 1)
    known = (extended.mean - base.mean)[data.used]

    def even(values: Floats) -> Floats:
        return np.asarray(np.interp(slots, data.slot[data.used], values))

    before, after = even(data.y[data.used]), even(data.y[data.used] - known)
    found = []
    for wanted_s in _AVERAGING_S:
        count = max(round(wanted_s / data.interval_s), 1)
        if count * _LEAST_MEANS <= slots.size:
            deviations = (allan_deviation(values, count) * data.unit_V for values in (before, after))
            found.append(Allan(count * data.interval_s, *deviations))
    return tuple(found)


def allan_deviation(values: Floats, count: int) -> float:
    """Return the overlapping Allan deviation of means over `count` values (IEEE 1139, Riley 2008).

    >>> round(allan_deviation(np.array([0.0, 1.0, 0.0, 1.0]), 1) ** 2, 12)
    0.5
    """
    total = np.concatenate(([0.0], np.cumsum(values - values.mean())))
    means = (total[count:] - total[:-count]) / count
    return float(np.sqrt(0.5 * np.mean((means[count:] - means[:-count]) ** 2)))
