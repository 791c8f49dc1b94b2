"""A recording through the same pipeline again: to the same bits, or with another estimator."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console

from aemd.block import ESTIMATE, READING, Batch, Estimates
from aemd.config import EstimatorChoice, load_estimator, name_estimator, recorded_estimator
from aemd.display import advancing
from aemd.errors import RecordingError, UsageError
from aemd.estimate.protocol import Estimator
from aemd.estimate.registry import make_estimator
from aemd.estimate.state import load_state
from aemd.pipeline import Tally, run
from aemd.record.description import Description
from aemd.record.source import Readings, Selection, open_readings, readings_told
from aemd.record.writer import Recorder

__all__ = ["ReplaySummary", "begin_with", "choose", "recorded_or_none", "recording_to", "replay"]


@dataclass(frozen=True, slots=True)
class ReplaySummary:
    """What a replay found."""

    file: str
    out: str | None
    """The new recording; None where none was asked for."""
    readings: int
    estimator: str
    readings_per_s: float
    """From file to sinks: reading, estimating and writing included."""
    identical: bool | None
    """Whether the recorded estimates came out again, bit for bit; None where that was not checked."""
    raw_variance_V2: float | None
    estimate_variance_V2: float | None
    difference: str | None = None
    """Where and how the first estimate differs; None where none does."""


def replay(
    path: Path,
    *,
    estimator: str | None = None,
    model: Path | None = None,
    out: Path | None = None,
    check: bool = False,
    selection: Selection | None = None,
    console: Console | None = None,
) -> ReplaySummary:
    """Run a recording through an estimator: the recorded one with its recorded options, unless another is named.

    Args:
        path: the recording.
        estimator: by name; None for the model's or the recorded one, or AEM where neither is.
        model: a file with an estimator and its options, in the place of the recorded one.
        out: the new recording; None for none.
        check: compare with the recorded estimates.
        selection: which number of the file is the reading, where it is not a recording of ours.
        console: where progress is shown; None for nowhere.

    Raises:
        RecordingError: the recording cannot be read, or the new one not written.
        ConfigError: the model file is wrong.
        UsageError: no such estimator, topic or field; or `check` of a recording without estimates or with another
            estimator.
    """
    with open_readings(path, selection) as recording:
        description = recording.description
        if check:
            recording.verify()
        if not description.interval_s > 0:
            raise RecordingError(
                f"{path}: has no interval between readings, which an estimator needs; is it one reading?"
            )
        is_replaced = not check and (model is not None or estimator is not None)
        recorded = recorded_or_none(description, str(path), is_replaced=is_replaced)
        choice = choose(recorded if model is None else load_estimator(model), estimator)
        comparison = _Comparison(recorded, choice, path) if check else None
        tally = Tally(description.first_index)
        made = make_estimator(choice.name, choice.options, description.interval_s)
        made.push(np.empty(0, READING))  # compiles the kernel, which is no part of the speed
        if description.state and choice == recorded:
            begin_with(made, description, str(path))
        else:
            description = replace(description, state={})  # what is estimated anew begins at its first reading
        start_ns = time.monotonic_ns()
        with recording_to(out, description, choice) as recorder, advancing(readings_told(recording), console) as bar:
            run(
                _heard(recording, comparison, bar),
                made,
                [sink for sink in (tally, recorder, comparison) if sink is not None],
            )
        elapsed_s = (time.monotonic_ns() - start_ns) * 1e-9
    difference = comparison.verdict(_spare(recording, made)) if comparison else None
    return ReplaySummary(
        file=str(path),
        out=None if out is None else str(out),
        readings=tally.counts.readings,
        estimator=choice.name,
        readings_per_s=tally.counts.readings / max(elapsed_s, 1e-9),
        identical=difference is None if check else None,
        raw_variance_V2=tally.raw.variance,
        estimate_variance_V2=tally.estimate.variance,
        difference=difference,
    )


def choose(known: EstimatorChoice | None, named: str | None) -> EstimatorChoice:
    """Return the known estimator unless another is named; AEM where nothing says which.

    Raises:
        UsageError: no such estimator.
    """
    return known if known and named is None else name_estimator(named or "aem", known)


def recorded_or_none(description: Description, place: str, *, is_replaced: bool) -> EstimatorChoice | None:
    """Return the recorded estimator; None where there is none, or one that this version lacks and another replaces.

    Raises:
        RecordingError: it is damaged, or this version has no such estimator or option, and nothing replaces it.
    """
    try:
        return recorded_estimator(description, place)
    except RecordingError:
        if not is_replaced:
            raise
        return None


def begin_with(estimator: Estimator, description: Description, place: str) -> None:
    """Put an estimator into the state that it had where this file begins, in the middle of an acquisition.

    Args:
        estimator: just made, with the recorded options.
        description: of the file.
        place: where the file is; it begins the message.

    Raises:
        RecordingError: the state is damaged, or of another version of the estimator.
    """
    try:
        load_state(estimator, description.state)
    except ValueError as error:
        raise RecordingError(
            f"{place}: metadata aemd.state: {error}; name an estimator by --estimator to begin afresh"
        ) from error


@contextmanager
def recording_to(
    out: Path | None, description: Description, choice: EstimatorChoice, reason: str = "end"
) -> Iterator[Recorder | None]:
    """Give a recorder that is closed at the end for that reason, or removed with what it wrote if the replay fails."""
    if out is None:
        yield None
        return
    recorder = Recorder(out, replace(description, estimator=choice.as_text()), compression="zstd-fast")
    try:
        yield recorder
    except BaseException:
        recorder.discard()
        raise
    try:
        recorder.close(reason)
    finally:
        recorder.release()


class _Comparison:
    """A sink that holds the new estimates against the recorded ones, which come by `expect`; both in order."""

    def __init__(self, recorded: EstimatorChoice | None, choice: EstimatorChoice, path: Path) -> None:
        if recorded is None:
            raise UsageError(f"{path}: holds no estimates to check; replay it without --check")
        if recorded != choice:
            raise UsageError(f"{path}: was estimated by {recorded.name!r}; --check compares with that one only")
        self._recorded: deque[Estimates] = deque()
        self._made: deque[Estimates] = deque()
        self._difference: str | None = None

    def expect(self, estimates: Estimates) -> None:
        """Take the next recorded estimates."""
        self._recorded.append(estimates)

    def write(self, batch: Batch, estimates: Estimates) -> None:  # noqa: ARG002 - a sink
        """Take the next new estimates, and compare as far as both are there."""
        self._made.append(estimates)
        while self._recorded and self._made and self._difference is None:
            recorded, made = self._recorded.popleft(), self._made.popleft()
            count = min(len(recorded), len(made))
            self._difference = _first_difference(recorded[:count], made[:count])
            for queue, rest in ((self._recorded, recorded[count:]), (self._made, made[count:])):
                if len(rest):
                    queue.appendleft(rest)

    def verdict(self, spare: int = 0) -> str | None:
        """Return where and how the first difference is; None where there is none.

        Args:
            spare: new estimates at the end that need no counterpart.
        """
        if self._difference is None:
            recorded, made = (sum(map(len, queue)) for queue in (self._recorded, self._made))
            if recorded or made > spare:
                return f"{recorded} recorded and {made} new estimates at the end have no counterpart"
        return self._difference


def _spare(recording: Readings, estimator: Estimator) -> int:
    """Return how many of the last estimates a recording may lack: the next file has them, or a crash took them."""
    reason = recording.metadata.get("aemd.close", {}).get("reason")
    return 0 if reason in {"stop", "end", "failed"} else estimator.lag + 1


def _first_difference(recorded: Estimates, made: Estimates) -> str | None:
    if recorded.tobytes() == made.tobytes():
        return None
    rows = zip(recorded, made, strict=True)
    before, after = next((a, b) for a, b in rows if a.tobytes() != b.tobytes())
    names = ESTIMATE.names or ()
    name = next(name for name in names if before[name].tobytes() != after[name].tobytes())
    return f"reading {before['index']}: {name} was {before[name]!r}, is {after[name]!r}"


def _heard(recording: Readings, comparison: _Comparison | None, bar: Callable[[int], None]) -> Iterator[Batch]:
    """Pass the batches on; tell the comparison of their recorded estimates, and the progress bar how far we are."""
    if comparison is None:  # the recorded estimates are most of a recording: unread, they cost nothing
        for batch in recording.batches():
            bar(len(batch.readings))
            yield batch
        return
    for batch, estimates in recording.batches_with_estimates():
        comparison.expect(estimates)
        bar(len(batch.readings))
        yield batch
