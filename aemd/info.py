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


def inspect(path: Path) -> Info:
    """Count what a recording holds; of one that was not finished, what was flushed.

    Raises:
        RecordingError: it cannot be read, or is damaged.
    """
    with Recording(path, allow_unfinished=True) as recording:
        found = recording.statistics()
        told = recording.description
        return Info(
            file=str(path),
            readings=found.readings,
            lost=found.lost,
            gaps=found.gaps,
            t0=found.t0_ns * 1e-9 if found.readings else None,
            t1=found.t1_ns * 1e-9 if found.readings else None,
            topics=found.topics,
            instrument=" ".join(told.instrument.get(key, "") for key in ("manufacturer", "model", "serial")).strip(),
            estimator=told.estimator.get("name", ""),
            unit=told.unit,
            finalised=recording.is_finished,
        )
