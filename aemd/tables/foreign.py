"""A number in another program's MCAP file becomes a recording of ours: readings, no estimates."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from aemd.block import ESTIMATE, Batch
from aemd.display import advancing
from aemd.errors import RecordingError, UsageError
from aemd.record.foreign import ForeignRecording, Selection
from aemd.record.source import readings_told
from aemd.record.writer import Recorder
from aemd.tables.read import PER_VOLT, ImportSummary

__all__ = ["import_mcap"]


def import_mcap(
    path: Path,
    out: Path,
    *,
    selection: Selection | None = None,
    unit: str | None = None,
    scale: float = 1.0,
    console: Console | None = None,
) -> ImportSummary:
    """Make a recording of a number in an MCAP file; see `import_csv` for units, scale and what is no value.

    Args:
        path: the file, whatever wrote it.
        out: the new recording.
        selection: which number.
        unit: of value times scale; None for what the file says, or volts where it says nothing.
        scale: factor of every value.
        console: where progress is shown; None for nowhere.

    Raises:
        UsageError: no such topic or field, or several could be meant; or the scale is not a number other than 0.
        RecordingError: the file cannot be read, or the recording not be written.
    """
    if not math.isfinite(scale) or scale == 0:
        raise UsageError(f"--scale {scale}: must be a finite number other than 0")
    with ForeignRecording(path, selection or Selection()) as source:
        told = source.description
        unit = unit or told.unit
        description = replace(
            told,
            unit="V" if unit in PER_VOLT else unit,
            quantity="voltage" if unit in PER_VOLT else told.quantity if unit == told.unit else "reading",
            session={**told.session, "value_scale": repr(scale), "value_unit": unit},
        )
        recorder = Recorder(out, description)
        invalid = 0
        try:
            with advancing(readings_told(source), console) as bar:
                for batch in source.batches():
                    with np.errstate(over="ignore"):
                        values = batch.readings["value_V"] * scale / PER_VOLT.get(unit, 1.0)
                    batch.readings["value_V"] = values
                    invalid += int(np.count_nonzero(batch.readings["status"]))
                    recorder.write(Batch(batch.readings), np.empty(0, ESTIMATE))
                    bar(len(values))
        except BaseException:
            recorder.discard()
            raise
        if not recorder.counts.readings:
            recorder.discard()
            raise RecordingError(f"{path}: holds no message of that topic; there is nothing to import")
        recorder.close("end")
    return ImportSummary(
        file=str(path),
        out=str(out),
        readings=recorder.counts.readings,
        invalid=invalid,
        unit=description.unit,
        interval_s=description.interval_s,
        witnesses=(),
    )
