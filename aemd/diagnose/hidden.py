"""What is still known of readings that a defect hides: an interval, which the filter takes, or nothing.

A clipped reading was beyond the range's end, and one that rests in a dead band was within it. To leave such readings
out would say that nothing is known of them, and what is left would look as if noise avoided those values.
"""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.evidence import Defect
from aemd.diagnose.series import Series

__all__ = ["hidden"]

Floats = NDArray[np.float64]


_COARSE = 1.5
"""Lattice step in deviations of a reading's news from which rounding is no noise: readings that stay in one cell would
have a density without bound, which mixtures of noises find."""


def hidden(
    series: Series, defects: Sequence[Defect], carried: Collection[str], *, rounded: bool
) -> tuple[NDArray[np.bool_], tuple[Floats, Floats] | None]:
    """Return which readings say nothing, shape (n,), and the intervals of the others, V, where any is one.

    Args:
        series: the readings.
        defects: what is wrong with them.
        carried: causes that the model under criticism has and its filter knows of.
        rounded: whether what was rounded is known to within the step, however fine; a fitted noise has it in it.
    """
    dropped = np.zeros(series.value_V.size, bool)
    low, high = series.value_V.copy(), series.value_V.copy()
    for defect in defects:
        if defect.cause in carried:
            continue
        held = np.zeros(dropped.size, bool) if defect.dropped is None else defect.dropped & series.used
        match defect.cause:
            case "saturation":
                upper = held & (series.value_V > np.nanmedian(series.value_V))
                high[upper], low[held & ~upper] = np.inf, -np.inf
            case "dead_band":
                level, half = defect.parameters["level_V"].value, defect.parameters["width_V"].value / 2
                low[held], high[held] = level - half, level + half
            case "quantisation" if rounded or defect.observed > _COARSE:
                half = defect.parameters["step_V"].value / 2
                low, high = low - half, high + half
            case _:
                dropped |= held
    known = (low, high) if np.any(high[series.used] > low[series.used]) else None
    return dropped, known
