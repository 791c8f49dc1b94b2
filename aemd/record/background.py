"""Background: another sink's work in a thread of its own, so that compression and the disk never delay the filter."""

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from queue import Empty, Full, Queue
from typing import Any, Protocol

import numpy as np

from aemd.block import ESTIMATE, READING, Batch, Estimates

__all__ = ["Background"]

_QUEUE_BATCHES = 256  # at 1000 batches/s a quarter of a second; a slower disk shows in `in_flight`, and then blocks
_TICK_S = 0.25  # how often the sink may look at its clock while nothing comes: a fraction of its flush interval
_LOOK_S = 0.1  # how often a caller that waits for a full queue looks whether the sink is still alive


class _ClosableSink(Protocol):
    @property
    def due_in_s(self) -> float:
        """How soon it wants to look at its clock, s, by an empty batch if nothing comes."""

    def write(self, batch: Batch, estimates: Estimates) -> None:
        """Take one batch."""

    def close(
        self, reason: str = ..., *, facts: Mapping[str, str] | None = ..., clock: Mapping[str, str] | None = ...
    ) -> Path:
        """Finish what was written."""

    def discard(self) -> None:
        """Remove what was written."""


class _Cutter(Protocol):
    @property
    def wants_state(self) -> bool:
        """Whether the estimator's state behind the next batch is wanted."""

    def take_state(self, state: Mapping[str, Any]) -> None:
        """Take the state behind the last batch written."""


class Background:
    """Runs `write` of a sink in a named thread, behind a bounded queue that blocks when it is full and never drops.

    What the sink raises ends its thread, and is raised here by every later `write`, or by `close`. While nothing comes
    the sink gets an empty batch from time to time, and when it is due, so that it can look at its clock.
    """

    def __init__(
        self,
        sink: _ClosableSink,
        *,
        queue_batches: int = _QUEUE_BATCHES,
        tick_s: float = _TICK_S,
        cutter: _Cutter | None = None,
        copy_state: Callable[[], Mapping[str, Any]] = dict,
    ) -> None:
        """Start the thread.

        Args:
            sink: written to from that thread only, until `close`.
            queue_batches: batches that may wait.
            tick_s: longest time between two calls of the sink's `write`.
            cutter: the sink, if it wants to know the estimator's state from time to time.
            copy_state: returns it; called by `write`, in whose thread the estimator runs.
        """
        self._sink = sink
        self._tick_s = tick_s
        self._cutter = cutter
        self._copy_state = copy_state
        self._queue: Queue[tuple[Batch, Estimates, Mapping[str, Any] | None] | None] = Queue(queue_batches)
        self._error: BaseException | None = None
        self._error_is_told = False
        self._taken = 0
        self._passed_on = 0
        self._turns = 0
        self._thread = threading.Thread(target=self._run, name=f"aemd-{type(sink).__name__.lower()}", daemon=True)
        self._thread.start()

    @property
    def in_flight(self) -> int:
        """Readings that were taken and are not yet with the sink."""
        return self._taken - self._passed_on

    @property
    def turns(self) -> int:
        """Calls of the sink's `write` that came back; while this grows the thread is alive."""
        return self._turns

    def write(self, batch: Batch, estimates: Estimates) -> None:
        """Hand over one batch; waits while the queue is full.

        Raises:
            RecordingError: or whatever else the sink raised.
        """
        self._taken += len(batch.readings)
        state = self._copy_state() if self._cutter is not None and self._cutter.wants_state else None
        while self._error is None:
            try:
                self._queue.put((batch, estimates, state), timeout=_LOOK_S)
            except Full:
                continue
            return
        self._taken -= len(batch.readings)
        self._error_is_told = True
        raise self._error

    def close(
        self, reason: str = "stop", *, facts: Mapping[str, str] | None = None, clock: Mapping[str, str] | None = None
    ) -> Path:
        """Let the sink take what waits, end the thread, and close the sink with these arguments. Twice is fine.

        Raises:
            RecordingError: or whatever else the sink raised, unless a `write` has told of it; the sink is closed all
                the same.
        """
        self._end()
        path = self._sink.close(reason, facts=facts, clock=clock)
        if self._error is not None and not self._error_is_told:
            self._error_is_told = True
            raise self._error
        return path

    def discard(self) -> None:
        """End the thread and let the sink remove what it wrote."""
        self._end()
        self._sink.discard()

    def _end(self) -> None:
        while self._thread.is_alive():
            try:
                self._queue.put(None, timeout=_LOOK_S)
            except Full:
                continue
            break
        self._thread.join()

    def _run(self) -> None:
        try:
            while (item := self._next()) is not None:
                self._sink.write(*item[:2])
                if self._cutter is not None and item[2] is not None:
                    self._cutter.take_state(item[2])
                self._passed_on += len(item[0].readings)
                self._turns += 1
        except BaseException as error:  # noqa: BLE001 - it is raised again where someone listens
            self._error = error

    def _next(self) -> tuple[Batch, Estimates, Mapping[str, Any] | None] | None:
        try:
            return self._queue.get(timeout=min(self._tick_s, self._sink.due_in_s))
        except Empty:
            return Batch(np.empty(0, READING)), np.empty(0, ESTIMATE), None
