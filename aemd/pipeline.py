"""The one loop: batches of readings through an estimator into sinks. A live acquisition and a replay both run it.

There is no `stop` argument: a source ends when it has been told to, so that what the instrument still holds comes
through the same loop before it returns.
"""

from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from aemd.block import NOT_A_VALUE, READING, Batch, Estimates
from aemd.errors import InstrumentError
from aemd.estimate.protocol import Estimator
from aemd.record.counts import Counts

__all__ = ["Sink", "Spread", "Tally", "run"]


class Sink(Protocol):
    """Whatever takes what the pipeline made: a recorder, a display, a tally."""

    def write(self, batch: Batch, estimates: Estimates) -> None:
        """Take one batch and the estimates that became ready with it.

        With a lagging estimator these belong to earlier readings than the batch's; pair them by index.
        """


def run(source: Iterable[Batch], estimator: Estimator, sinks: Sequence[Sink]) -> None:
    """Pass every batch of the source through the estimator into each sink, in order, until the source ends.

    Raises:
        InstrumentError: the source's instrument failed; everything that came before has reached the sinks.
    """
    try:
        for batch in source:
            _deliver(batch, estimator.push(batch.readings), sinks)
    except InstrumentError:
        _deliver(Batch(np.empty(0, READING)), estimator.flush(), sinks)
        raise
    _deliver(Batch(np.empty(0, READING)), estimator.flush(), sinks)


def _deliver(batch: Batch, estimates: Estimates, sinks: Sequence[Sink]) -> None:
    for sink in sinks:
        sink.write(batch, estimates)


class Spread:
    """Count, mean and variance of a stream, merged block by block (Chan, Golub, LeVeque 1979, eq. 2.1)."""

    def __init__(self) -> None:
        self.count = 0
        self.mean = 0.0
        self._squares = 0.0

    def add(self, values: NDArray[np.float64]) -> None:
        """Take finite values, shape (n,)."""
        if not values.size:
            return
        with np.errstate(over="ignore", invalid="ignore"):  # of 1e308 V: the variance is infinite, and says so
            self._merge(values)

    def _merge(self, values: NDArray[np.float64]) -> None:
        mean = float(values.mean())
        total = self.count + values.size
        shift = mean - self.mean
        self._squares += float(np.square(values - mean).sum()) + shift * shift * self.count * values.size / total
        self.mean += shift * values.size / total
        self.count = total

    @property
    def variance(self) -> float | None:
        """Mean squared deviation from the mean; None of an empty stream.

        >>> spread = Spread()
        >>> spread.add(np.array([1.0])), spread.add(np.array([2.0, 3.0]))
        (None, None)
        >>> spread.variance == float(np.var([1.0, 2.0, 3.0]))
        True
        """
        return self._squares / self.count if self.count else None


class Tally:
    """A sink that keeps the figures of a summary: counts, losses, first and last instant, variances."""

    def __init__(self, first_index: int = 0) -> None:
        self.counts = Counts(first_index)
        self.raw = Spread()
        self.estimate = Spread()

    def write(self, batch: Batch, estimates: Estimates) -> None:
        """Count one batch and its estimates."""
        self.counts.add(batch, estimates)
        self.estimate.add(estimates["value_V"])
        usable = (batch.readings["status"] & NOT_A_VALUE) == 0
        self.raw.add(batch.readings["value_V"][usable])

    @property
    def duration_s(self) -> float:
        """From the first reading's instant to the last one's, s."""
        return (self.counts.t1_ns - self.counts.t0_ns) * 1e-9

    @property
    def rate_hz(self) -> float:
        """Readings per second over the duration, lost ones not counted; 0 of fewer than two readings."""
        return (self.counts.readings - 1) / self.duration_s if self.duration_s > 0 else 0.0
