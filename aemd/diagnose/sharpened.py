"""A smoothing taken off: the readings before it, and what it did to their noise."""

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.hypothesis import Data, Seen

__all__ = ["quieted", "sharpened"]

Floats = NDArray[np.float64]


def sharpened(data: Data, kept: float) -> Seen:
    """Return the readings before a smoothing.

    After a gap of m readings a mean of them stands for the last, the share kept^m of the one before the gap taken off;
    the first reading of all stands for itself.
    """
    if kept == 0.0:
        return Seen(data.y, data.low, data.high, 0.0)
    share, last = _shares(data, kept)

    def sharp(values: Floats) -> Floats:
        return np.asarray((values - share * data.y[last]) / (1 - share))

    low, high = (None if values is None else sharp(values) for values in (data.low, data.high))
    # An interval has a probability, which no slope changes.
    dense = data.used if low is None or high is None else data.used & ~(high > low)
    return Seen(sharp(data.y), low, high, np.where(dense, -np.log1p(-share), 0.0))


def quieted(data: Data, kept: float) -> Floats:
    """Return the variance of white noise in what `sharpened` makes of each reading, over that of one reading.

    Of m readings of variance 1 the mean with weights kept^j, j < m, that sum to 1.
    """
    share, last = _shares(data, kept)
    return np.where(last >= 0, (1 - kept) / (1 + kept) * (1 + share) / (1 - share), 1.0)


def _shares(data: Data, kept: float) -> tuple[Floats, NDArray[np.int64]]:
    """Return how much of the last reading that is used is in each one, and which that is."""
    last = np.maximum.accumulate(np.where(data.used, np.arange(data.y.size), -1))
    last = np.concatenate(([-1], last[:-1]))
    share = np.where(last >= 0, kept ** np.maximum(data.slot - data.slot[last], 1.0), 0.0)
    return share, last
