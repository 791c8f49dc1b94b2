"""The parameters of the `imm` estimator from a stretch of a recording, into a file that `acquire` and `replay` take."""

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from aemd.block import READING
from aemd.config import EstimatorChoice, load_estimator
from aemd.errors import ConfigError, RecordingError, UsageError
from aemd.estimate.imm import ImmOptions, imm_model
from aemd.estimate.refine import refine
from aemd.estimate.tune import tune
from aemd.model import Model
from aemd.record.reader import Recording
from aemd.report import as_toml
from aemd.simulate import format_model, read_model

__all__ = ["Start", "TuneSummary", "read_start", "tune_recording"]

Slow = Literal["disturbance", "input"]

_LEAST_NOISE_V, _MOST_NOISE_V = 1e-12, 1000.0  # a tenth of what any meter resolves; the largest range of one
_LEAST_PERIOD = 4  # readings: a signal that has to be faster still has no band left


@dataclass(frozen=True, slots=True)
class TuneSummary:
    """What a tuning found."""

    file: str
    out: str
    readings: int
    """Readings with a value that the parameters were found in."""
    kind: str
    """The kind of model that explains them best for its number of parameters, or that of the model given."""
    log_likelihood: float
    """Per reading, one step ahead: natural logarithm of a density in 1/V."""
    log_likelihood_given: float | None
    """The same of the model given, before its numbers were refined; None without one."""
    estimator: str


@dataclass(frozen=True, slots=True)
class Start:
    """What a search begins with, and the rest of the file that it stands in."""

    path: Path
    options: ImmOptions
    model: Model | None
    """Terms and effects for `simulate`; None where the file has none."""


def read_start(
    path: Path, *, slow: Slow | None = None, slowest_signal_s: float | None = None, resonances: int = 0
) -> Start:
    """Read and check the model that a search shall begin with, and that nothing is asked for which it says itself.

    Raises:
        UsageError: an option says of which parts the model shall be.
        ConfigError: the file cannot be read, is not TOML, has no [estimator] of `imm`, or says what cannot be.
    """
    beside = {"--slow": slow, "--slowest-signal": slowest_signal_s, "--resonances": resonances or None}
    for name, value in beside.items():
        if value is not None:
            raise UsageError(
                f"{name} {value}: not with --model, whose parts are kept as they are; leave out one of them"
            )
    choice = load_estimator(path)
    if not isinstance(choice.options, ImmOptions):
        raise ConfigError(f"{path}: [estimator] name = {choice.name!r}: must be 'imm', the one that can be tuned")
    tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    whole = not tables.keys().isdisjoint({"terms", "effects"})  # else a file of `tune`, or a config
    return Start(path, choice.options, read_model(path) if whole else None)


def tune_recording(
    path: Path,
    out: Path,
    *,
    model: Path | None = None,
    from_s: float = 0.0,
    to_s: float = np.inf,
    lag: int | None = None,
    noise_V: float | None = None,
    slowest_signal_s: float | None = None,
    slow: Slow | None = None,
    resonances: int = 0,
) -> TuneSummary:
    """Find the options of greatest likelihood in a stretch of a recording, and write them as a model file.

    Args:
        path: the recording.
        out: the model file, an [estimator] table; it must not exist.
        model: a model file whose [estimator] the search begins with; its numbers are refined, and its parts kept, in
            the place of looking for the best kind. Its terms and effects are written again as they are.
        from_s: begin of the stretch, s after the first reading.
        to_s: its end, likewise.
        lag: readings by which the estimator shall trail. None: as the model has it, or 0.
        noise_V: standard deviation of the white noise where it is known, V.
        slowest_signal_s: longest period of the input, s; what is slower is drift. None: 150 readings. Not with `model`.
        slow: whether the slow part is the sensor's own drift, or part of the input. None: its drift. Not with `model`.
        resonances: most of them that an input which vibrates may have; 0: none are sought. Not with `model`.

    Raises:
        RecordingError: the recording cannot be read, or the model file exists or cannot be written.
        UsageError: the stretch holds too little to tune by, or an option cannot be, or not with `model`.
        ConfigError: the model given is wrong, or none for a recording with this interval.
    """
    start = None
    if model is not None:
        start = read_start(model, slow=slow, slowest_signal_s=slowest_signal_s, resonances=resonances)
    if noise_V is not None and not _LEAST_NOISE_V <= noise_V <= _MOST_NOISE_V:
        raise UsageError(f"--noise {noise_V:g}: must be from {_LEAST_NOISE_V:g} to {_MOST_NOISE_V:g} V")
    if out.exists():  # told now, not after minutes
        raise _exists(out)
    with Recording(path) as recording:
        parts = [batch.readings for batch in recording.batches()]
        interval_s = recording.description.interval_s
    if slowest_signal_s is not None and slowest_signal_s < _LEAST_PERIOD * interval_s:
        least = f"{_LEAST_PERIOD} intervals of {path}, {_LEAST_PERIOD * interval_s:g} s"
        raise UsageError(f"--slowest-signal {slowest_signal_s:g}: must be at least {least}")
    readings = np.concatenate([np.empty(0, READING), *parts])
    since_s = (readings["t_ns"] - readings["t_ns"][:1]) * 1e-9
    stretch = readings[(since_s >= from_s) & (since_s < to_s)]
    if start is not None:
        try:
            imm_model(start.options, interval_s)
        except ConfigError as error:
            raise ConfigError(
                f"{start.path}: [estimator] {error} of {path}; choose the model of such a meter"
            ) from error
    given = None
    try:
        if start is not None:
            refined = refine([stretch], interval_s, start.options, noise_V=noise_V)
            options, kind, given = refined.options, _name(refined.options), refined.given
            count, likelihood = refined.readings, refined.log_likelihood
        else:
            found = tune(
                [stretch],
                interval_s,
                noise_V=noise_V,
                slow=slow or "disturbance",
                slowest_signal_s=slowest_signal_s,
                resonances=resonances,
            )
            options, kind, count, likelihood = found.options, str(found.kind), found.readings, found.log_likelihood
    except ConfigError as error:
        raise UsageError(f"{path}: {error}; choose another stretch by --from and --to") from error
    choice = EstimatorChoice("imm", options if lag is None else replace(options, lag=lag))
    _write(_text(choice, kind, path, start), out)
    return TuneSummary(str(path), str(out), count, kind, likelihood, given, choice.name)


def _name(options: ImmOptions) -> str:
    """Return what a model consists of, named as `tune` names its kinds."""
    parts = ["swing" if hz > 0 else "markov" for hz in options.signal_hz]
    whose = options.signal_is or ("input",) * len(parts)
    named = [part if kind == "input" else f"{kind} {part}" for part, kind in zip(parts, whose, strict=True)]
    return " + ".join([*named, "slow"])


def _text(choice: EstimatorChoice, kind: str, source: Path, start: Start | None) -> str:
    """Return a model file: what `simulate` takes, where the model given had it, then what the estimator takes."""
    text = [f"# Found in {source.name} by its likelihood; kind of model: {kind}.\n"]
    if start is not None:
        text = [f"# {start.path.name}, its [estimator] refined in {source.name} by its likelihood; kind: {kind}.\n"]
        if start.model is not None:
            text += ["# Terms and effects are as they were given.\n", format_model(start.model), "\n"]
    return "".join([*text, as_toml(choice.as_table()), "\n"])


def _write(text: str, out: Path) -> None:
    try:
        with out.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise _exists(out) from error
    except OSError as error:
        raise RecordingError(f"{out}: cannot be written: {(error.strerror or str(error)).lower()}") from error


def _exists(out: Path) -> RecordingError:
    return RecordingError(f"{out}: exists: a model file is never overwritten; choose another name")
