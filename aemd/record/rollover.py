"""Rollover: one acquisition in one file after another, through rotation, a full disk and a disk that fails.

A file is cut between two batches, where the estimator's state is known: it goes into the new file, which thus replays
alone, to the bit. The new file is open before the old one is left, and the old one is finished in a thread of its own.

    recording ──size, UTC boundary──> recording       rotation: no reading is lost
    recording ──disk full, failing──> waiting ──room again──> recording
                                      readings are counted as not written, and the new file begins by telling so

Nothing here ends an acquisition. A file that is left for want of room is finished with the blocks that it kept for its
end; one that cannot be finished stays .active, for `recover`.
"""

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from aemd.block import ESTIMATE, READING, Batch, Estimates, Event
from aemd.errors import RecordingError
from aemd.record.counts import Counts
from aemd.record.disk import free_bytes
from aemd.record.growing import UNDER_ANOTHER_NAME
from aemd.record.writer import Recorder

__all__ = ["Rollover", "Segment", "State"]

State: TypeAlias = Mapping[str, Any]
"""Of an estimator: its pieces, copied, by name."""

_RETRY_S = 5.0
_LOOK_S = 1.0  # how often the disk is asked what is left
_MARGIN_BYTES = 1 << 20  # beyond `min_free_bytes` before recording goes on, so that it does not stop at once
_AHEAD_NS = 5_000_000_000  # so long before a boundary a state comes with every batch: it may be the last one


@dataclass(frozen=True, slots=True)
class Segment:
    """What a new file is told of those before it."""

    number: int = 1
    previous: str = ""
    """Name of the file before it."""
    first_index: int = 0
    """Index that its first reading has if none was lost."""
    lost: int = 0
    """Readings that the acquisition lost before."""
    not_written: int = 0
    """Readings that were acquired before and are in no file."""
    state: State = field(default_factory=dict)
    """Of the estimator."""

    def as_text(self) -> dict[str, str]:
        """Return what `aemd.segment` holds of it."""
        told = {"number": str(self.number), "lost_before": str(self.lost), "not_written": str(self.not_written)}
        return told | ({"previous": self.previous} if self.previous else {})


class Rollover:
    """A sink for `Background`. `write` never raises for the disk's sake; `tell` gets a line when something changes."""

    def __init__(
        self,
        open_file: Callable[[Segment], Recorder],
        *,
        rotate_bytes: int = 0,
        rotate_s: float = 0.0,
        min_free_bytes: int = 0,
        tell: Callable[[str], None] = lambda _line: None,
        clock: Callable[[], int] = time.monotonic_ns,
        free: Callable[[Path], int] = free_bytes,
    ) -> None:
        """Open the first file.

        Args:
            open_file: makes the recorder of a segment, under a name of its own.
            rotate_bytes: begin another file at this size; 0 for never.
            rotate_s: begin another file where the readings' UTC passes a multiple of this; 0 for never.
            min_free_bytes: leave that much of the disk to others.
            tell: takes one line, key=value, when recording stops, goes on or changes the file.
            clock: host monotonic time, ns.
            free: what is left on the disk of a folder, bytes.

        Raises:
            RecordingError: there is no room, or the file cannot be created.
        """
        self._open_file = open_file
        self._rotate_bytes, self._rotate_ns = rotate_bytes, round(rotate_s * 1e9)
        self._min_free_bytes = min_free_bytes
        self._tell, self._clock, self._free = tell, clock, free
        self.clock_facts: Callable[[], Mapping[str, str]] | None = None
        """What is known of the instrument's clock, for the end of each file."""
        self._segment = Segment()
        self._taken = Counts(0)
        self._state: State | None = None
        """Of the estimator after all that was taken; None where it is not known."""
        self._period = -1
        self._is_due = False
        self._look_ns = self._retry_ns = 0
        self._missed = 0
        """Readings that came while nothing was written."""
        self._left_over: list[int] = []
        """Readings that a file was given, and could not be written into it; a list, since another thread adds to it."""
        self._missing_from: tuple[int, int] | None = None
        """Index and instant of the first of the missed."""
        self._trouble = ""
        self._stopped: Recorder | None = None
        """The file that was left for want of room."""
        self._finisher: threading.Thread | None = None
        self._is_closed = False

        recorder = open_file(self._segment)
        self._recorder: Recorder | None = recorder
        self._path = recorder.path
        self._active = recorder.active
        if (left := self._left()) < min_free_bytes:
            recorder.discard()
            raise RecordingError(
                f"{self._path.parent}: has {left / 1e6:.0f} MB left, fewer than [recording] min_free_bytes = "
                f"{min_free_bytes / 1e6:.0f} MB: make room, or lower it"
            )

    @property
    def active(self) -> Path:
        """The file that grows, or grew last."""
        return self._active

    @property
    def is_recording(self) -> bool:
        """Whether what comes now is written."""
        return self._recorder is not None

    @property
    def trouble(self) -> str:
        """Why what comes now is not written; empty while it is. Any thread may ask."""
        return self._trouble

    @property
    def not_written(self) -> int:
        """Readings that were taken and will be in no file."""
        return self._missed + sum(self._left_over)

    @property
    def due_in_s(self) -> float:
        """How long what waits for the disk may go on waiting, s; infinite where nothing does."""
        recorder = self._recorder
        return math.inf if recorder is None else recorder.due_in_s

    @property
    def wants_state(self) -> bool:
        """Whether the estimator's state after the next batch is wanted, by `take_state`; any thread may ask."""
        return self._is_due

    def take_state(self, state: State) -> None:
        """Take the estimator's state after all that was written: here another file may begin."""
        self._state = state

    def write(self, batch: Batch, estimates: Estimates) -> None:
        """Take one batch and the estimates that became ready with it; an empty batch only looks at the clock."""
        self._cut_where_due(batch)
        self._taken.add(batch, estimates)
        if len(batch.readings) or len(estimates):
            self._state = None
        if self._recorder is None:
            self._miss(batch)
            return
        try:
            self._recorder.write(batch, estimates)
        except RecordingError as error:
            self._stop_recording(str(error))
            return
        self._look(batch)

    def close(
        self, reason: str = "stop", *, facts: Mapping[str, str] | None = None, clock: Mapping[str, str] | None = None
    ) -> Path:
        """Finish the last file. Twice is fine.

        Returns:
            The last recording.

        Raises:
            RecordingError: it cannot be finished; the .active file is kept and readable.
        """
        self._join()
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            error = self._finish(recorder, reason, dict(facts or {}), clock)
            if error is not None:
                raise error
        return self._path

    def discard(self) -> None:
        """Remove the unfinished file; finished ones stay. Twice is fine."""
        self._join()
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            recorder.discard()

    # Rotation.

    def _look(self, batch: Batch) -> None:
        """See whether another file is due, and whether the disk still has room."""
        recorder = self._recorder
        if recorder is None:
            return
        if self._rotate_ns and len(batch.readings):
            t_ns = int(batch.readings["t_ns"][-1])
            if self._period < 0:
                self._period = int(batch.readings["t_ns"][0]) // self._rotate_ns
            self._is_due = (t_ns + _AHEAD_NS) // self._rotate_ns > self._period
        if self._rotate_bytes and recorder.size_bytes >= self._rotate_bytes:
            self._is_due = True
        if self._clock() >= self._look_ns:
            self._look_ns = self._clock() + round(_LOOK_S * 1e9)
            if not recorder.active.exists():  # the system would go on taking what no one will ever read
                self._stop_recording(f"somebody has removed {recorder.active}")
            elif (left := self._left()) < self._min_free_bytes:
                self._stop_recording(f"{left / 1e6:.0f} MB left on the disk, fewer than min_free_bytes")

    def _cut_where_due(self, batch: Batch) -> None:
        """Begin another file before this batch if one is due and the estimator's state is known."""
        if self._state is None or not self._is_due or not len(batch.readings) or self._clock() < self._retry_ns:
            return
        if self._recorder is None:
            self._go_on(self._state)
        elif self._is_due_before(batch, self._recorder):
            self._rotate(self._state, self._recorder)

    def _is_due_before(self, batch: Batch, recorder: Recorder) -> bool:
        by_size = self._rotate_bytes and recorder.size_bytes >= self._rotate_bytes
        return bool(by_size) or (
            self._rotate_ns > 0 and int(batch.readings["t_ns"][0]) // self._rotate_ns > self._period >= 0
        )

    def _rotate(self, state: State, old: Recorder) -> None:
        if self._finisher is not None and self._finisher.is_alive():
            return  # the disk is so slow that the file before is not finished yet
        segment = self._next_segment(old, self._taken.next_index, state)
        try:
            self._open(segment)
        except RecordingError as error:
            self._retry_ns = self._clock() + round(_RETRY_S * 1e9)
            self._tell(f"recording=not-rotated why={str(error)!r}")
            return
        self._tell(f"recording=rotated file={self._path} before={old.path}")
        self._finish_behind(old, "rotate")

    def _open(self, segment: Segment) -> None:
        recorder = self._open_file(segment)
        self._segment, self._recorder, self._trouble = segment, recorder, ""
        self._path, self._active = recorder.path, recorder.active
        self._period, self._is_due = -1, False

    def _next_segment(self, old: Recorder | None, first_index: int, state: State) -> Segment:
        previous = self._path if old is None else old.path
        lost = self._taken.lost
        return Segment(self._segment.number + 1, previous.name, first_index, lost, self.not_written, state)

    # A disk that is full, or fails.

    def _stop_recording(self, why_it_stops: str) -> None:
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            return
        self._is_due = False
        self._trouble = why = why_it_stops.removesuffix(UNDER_ANOTHER_NAME)  # that is done here
        self._retry_ns = self._clock() + round(_RETRY_S * 1e9)
        self._stopped = recorder
        self._tell(f"recording=stopped file={recorder.path} why={why!r} then='goes on by itself when it can'")
        if self._finisher is not None:
            self._finisher.join()
        self._finish_behind(recorder, "disk-full")

    def _miss(self, batch: Batch) -> None:
        """Count readings that are not written, and see whether it is time to try again."""
        if len(batch.readings):
            self._missed += len(batch.readings)
            if self._missing_from is None:
                self._missing_from = int(batch.readings["index"][0]), int(batch.readings["t_ns"][0])
        is_finished = self._finisher is None or not self._finisher.is_alive()
        if not self._is_due and is_finished and self._clock() >= self._retry_ns:
            if self._left() >= self._min_free_bytes + _MARGIN_BYTES:
                self._is_due = True
            else:
                self._retry_ns = self._clock() + round(_RETRY_S * 1e9)

    def _go_on(self, state: State) -> None:
        """Begin a file that tells first of what is missing."""
        left_from = None if self._stopped is None else self._stopped.unwritten_from
        missing_from = left_from or self._missing_from or (self._taken.next_index, self._taken.t1_ns)
        segment = self._next_segment(None, missing_from[0], state)
        try:
            self._open(segment)
        except RecordingError:  # it was told of when it stopped
            self._is_due = False
            self._retry_ns = self._clock() + round(_RETRY_S * 1e9)
            return
        self._missing_from = self._stopped = None
        first, last = missing_from[0], self._taken.next_index - 1
        if last >= first and self._recorder is not None:
            message = f"{last - first + 1} readings not written: the disk was full or failed"
            event = Event(missing_from[1], "gap", message, first, last)
            self._recorder.write(Batch(np.empty(0, READING), (event,)), np.empty(0, ESTIMATE))
        self._tell(f"recording=resumed file={self._path} not_written={self.not_written}")

    def _left(self) -> int:
        try:
            return self._free(self._path.parent)
        except OSError:  # the folder is gone; that recording has stopped was told
            return -1

    # The end of a file.

    def _finish_behind(self, recorder: Recorder, reason: str) -> None:
        """Finish a file in a thread of its own: its last chunk and its summary wait for the disk."""
        clock = self.clock_facts() if self.clock_facts is not None else None

        def work() -> None:
            error = self._finish(recorder, reason, {}, clock)
            if error is not None:
                self._tell(f"recording=unfinished file={recorder.active} why={str(error)!r}")

        self._finisher = threading.Thread(target=work, name="aemd-finish", daemon=True)
        self._finisher.start()

    def _finish(
        self, recorder: Recorder, reason: str, facts: Mapping[str, str], clock: Mapping[str, str] | None
    ) -> RecordingError | None:
        """Close a file; if the disk refuses its last chunk, close it without. Return why that did not work."""
        error: RecordingError | None = None
        for attempt in (reason, "disk-full"):
            unwritten = recorder.counts.readings - recorder.written.readings if recorder.has_failed else 0
            told = {"not_written": str(self.not_written + unwritten)}
            try:
                recorder.close(attempt, facts=told | dict(facts), clock=clock)
            except RecordingError as refused:
                error = refused
                if recorder.is_released:
                    break
                continue
            error = None
            break
        if error is not None:
            recorder.release()
        is_there = error is None or recorder.active.exists()
        self._left_over.append(recorder.counts.readings - (recorder.written.readings if is_there else 0))
        return error

    def _join(self) -> None:
        if self._finisher is not None:
            self._finisher.join()
