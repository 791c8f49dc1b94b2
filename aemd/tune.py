"""The parameters of the `imm` estimator from a stretch of a recording, into a file that `acquire` and `replay` take."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from aemd.block import READING
from aemd.config import EstimatorChoice
from aemd.errors import ConfigError, RecordingError, UsageError
from aemd.estimate.tune import tune
from aemd.record.reader import Recording
from aemd.report import as_toml

__all__ = ["TuneSummary", "tune_recording"]


@dataclass(frozen=True, slots=True)
class TuneSummary:
    """What a tuning found."""

    file: str
    out: str
    readings: int
    """Readings with a value that the parameters were found in."""
    kind: str
    """The kind of model that explains them best for its number of parameters."""
    log_likelihood: float
    """Per reading, one step ahead: natural logarithm of a density in 1/V."""
    estimator: str


def tune_recording(
    path: Path,
    out: Path,
    *,
    from_s: float = 0.0,
    to_s: float = np.inf,
    lag: int = 0,
    noise_V: float | None = None,
    slowest_signal_s: float | None = None,
    slow: Literal["disturbance", "input"] = "disturbance",
    resonances: int = 0,
) -> TuneSummary:
    """Find the options of greatest likelihood in a stretch of a recording, and write them as a model file.

    Args:
        path: the recording.
        out: the model file, an [estimator] table; it must not exist.
        from_s: begin of the stretch, s after the first reading.
        to_s: its end, likewise.
        lag: readings by which the estimator shall trail.
        noise_V: standard deviation of the white noise where it is known, V.
        slowest_signal_s: longest period of the input, s; what is slower is drift. None: 150 readings.
        slow: whether the slow part is the sensor's own drift, or part of the input.
        resonances: most of them that an input which vibrates may have; 0: none are sought.

    Raises:
        RecordingError: the recording cannot be read, or the model file exists or cannot be written.
        UsageError: the stretch holds too little to tune by.
    """
    with Recording(path) as recording:
        parts = [batch.readings for batch in recording.batches()]
        interval_s = recording.description.interval_s
    readings = np.concatenate([np.empty(0, READING), *parts])
    since_s = (readings["t_ns"] - readings["t_ns"][:1]) * 1e-9
    stretch = readings[(since_s >= from_s) & (since_s < to_s)]
    try:
        found = tune(
            [stretch],
            interval_s,
            noise_V=noise_V,
            slow=slow,
            slowest_signal_s=slowest_signal_s,
            resonances=resonances,
        )
    except ConfigError as error:
        raise UsageError(f"{path}: {error}; choose another stretch by --from and --to") from error
    choice = EstimatorChoice("imm", replace(found.options, lag=lag))
    _write(choice, found.kind, path, out)
    return TuneSummary(str(path), str(out), found.readings, str(found.kind), found.log_likelihood, choice.name)


def _write(choice: EstimatorChoice, kind: object, source: Path, out: Path) -> None:
    text = f"# Found in {source.name} by its likelihood; kind of model: {kind}.\n" + as_toml(choice.as_table()) + "\n"
    try:
        with out.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise RecordingError(f"{out}: exists: a model file is never overwritten; choose another name") from error
    except OSError as error:
        raise RecordingError(f"{out}: cannot be written: {(error.strerror or str(error)).lower()}") from error
