"""What a recording holds, in a few figures."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from aemd.record.reader import Recording

__all__ = ["Info", "inspect"]


@dataclass(frozen=True, slots=True)
class Info:
    """A recording in a few figures."""

    file: str
    readings: int
    lost: int
    not_written: int
    """In no file of this acquisition, though acquired, up to the end of this one: the disk was full or failed. Those
    directly before this file's first reading are among its lost ones, too."""
    gaps: int
    t0: float | None
    """Instant of the first reading, s since 1970 (UTC); None where there is none."""
    t1: float | None
    """Instant of the last reading, s since 1970 (UTC)."""
    topics: Mapping[str, int]
    """Messages of each topic."""
    instrument: str
    estimator: str
    unit: str
    finalised: bool
    """Whether the file was closed in order; if not, what was flushed is counted."""
    closed: str
    """Why: stop, end, rotate, disk-full, failed, recovered; empty where it does not say."""
    segment: int
    """Number of this file among those of its acquisition, from 1."""


def inspect(path: Path) -> Info:
    """Count what a recording holds; of one that was not finished, what was flushed.

    Raises:
        RecordingError: it cannot be read, or is damaged.
    """
    with Recording(path, allow_unfinished=True) as recording:
        found = recording.statistics()
        told = recording.description
        close = recording.metadata.get("aemd.close", {})
        return Info(
            file=str(path),
            readings=found.readings,
            lost=found.lost,
            not_written=_number(close.get("not_written", told.segment.get("not_written", "")), 0),
            gaps=found.gaps,
            t0=found.t0_ns * 1e-9 if found.readings else None,
            t1=found.t1_ns * 1e-9 if found.readings else None,
            topics=found.topics,
            instrument=" ".join(told.instrument.get(key, "") for key in ("manufacturer", "model", "serial")).strip(),
            estimator=told.estimator.get("name", ""),
            unit=told.unit,
            finalised=recording.is_finished,
            closed=close.get("reason", ""),
            segment=_number(told.segment.get("number", ""), 1),
        )


def _number(text: str, otherwise: int) -> int:
    return int(text) if text.isdecimal() else otherwise
