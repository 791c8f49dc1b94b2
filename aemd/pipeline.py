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
        self._newest = (-1, 0)  # index and instant of the last reading
        self._steps = self._steps_ns = 0  # from a reading to the very next one: how many, and how long in all

    def write(self, batch: Batch, estimates: Estimates) -> None:
        """Count one batch and its estimates."""
        self.counts.add(batch, estimates)
        self.estimate.add(estimates["value_V"])
        values_V = batch.readings["value_V"]
        unusable = (batch.readings["status"] & NOT_A_VALUE) != 0
        self.raw.add(values_V[~unusable] if unusable.any() else values_V)
        if batch.readings.size:
            self._add_steps(batch.readings["index"], batch.readings["t_ns"])

    def _add_steps(self, index: NDArray[np.int64], t_ns: NDArray[np.int64]) -> None:
        """Take one batch's numbers and instants, shape (n,), n > 0."""
        before, before_ns = self._newest
        self._newest = int(index[-1]), int(t_ns[-1])
        if before >= 0 and index[0] == before + 1:
            self._steps += 1
            self._steps_ns += int(t_ns[0]) - before_ns
        if index[-1] - index[0] == index.size - 1:
            self._steps += index.size - 1
            self._steps_ns += int(t_ns[-1] - t_ns[0])
            return
        is_next = np.diff(index) == 1
        self._steps += int(np.count_nonzero(is_next))
        self._steps_ns += int(np.diff(t_ns)[is_next].sum())

    @property
    def duration_s(self) -> float:
        """From the first reading's instant to the last one's, s."""
        return (self.counts.t1_ns - self.counts.t0_ns) * 1e-9

    @property
    def rate_hz(self) -> float:
        """Readings per second while they came: over the duration without its gaps; 0 of fewer than two readings."""
        return self._steps / (self._steps_ns * 1e-9) if self._steps_ns > 0 else 0.0
