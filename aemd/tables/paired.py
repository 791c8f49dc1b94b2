"""Readings beside their estimates, which may stand far behind them in the file: an estimator may lag."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from aemd.block import ESTIMATE, READING, Block, Estimates
from aemd.record.rows import concatenate
from aemd.record.schema import FILTERED
from aemd.record.source import Readings

__all__ = ["paired"]

_BLOCK_READINGS = 65_536  # in memory at a time, and in a row group of a Parquet file
_MOST_LAG = 1 << 20  # readings that wait for their estimate; beyond it there will be none


def paired(recording: Readings) -> Iterator[tuple[Block, NDArray[np.intp], Estimates]]:
    """Yield blocks of readings with their estimates, and where in the block each of these belongs."""
    readings, estimates = np.empty(0, READING), np.empty(0, ESTIMATE)
    lag = _MOST_LAG if FILTERED in recording.channels else 0
    for batch, made in recording.batches_with_estimates(_BLOCK_READINGS):
        readings, estimates = concatenate([readings, batch.readings]), concatenate([estimates, made])
        known = int(np.searchsorted(readings["index"], estimates["index"][-1], "right")) if len(estimates) else 0
        ready = max(known, len(readings) - lag)
        if ready:
            yield _pair(readings[:ready], estimates)
            readings, estimates = readings[ready:], np.empty(0, ESTIMATE)
    if len(readings):
        yield _pair(readings, estimates)


def _pair(block: Block, estimates: Estimates) -> tuple[Block, NDArray[np.intp], Estimates]:
    place = np.searchsorted(block["index"], estimates["index"])
    # One whose reading is not here belongs to the recording before this one.
    here = block["index"][np.minimum(place, len(block) - 1)] == estimates["index"]
    return block, place[here], estimates[here]
