"""A model as a TOML file, and the recording that it makes.

    seed = 1

    [[terms]]
    term = "gauss_markov"
    rate_V_per_rt_s = 1e-3
    tau_s = 0.5

    [[effects]]
    effect = "quantiser"
    step_V = 1e-6

Terms add up at the input; effects change the readings, in the order of the file. `aemd.model` says which there are. An
[estimator] table, as `aemd diagnose -o` writes, is for `acquire` and `replay`, and left be here.
"""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from aemd.block import ESTIMATE, READING, WITNESS, Batch
from aemd.config import parse_options
from aemd.errors import ConfigError, UsageError, not_among
from aemd.model import EFFECTS, TERMS, Effect, Model, Readings, Term
from aemd.record.description import Description
from aemd.record.writer import Recorder

__all__ = ["SimulateSummary", "format_model", "read_model", "simulate", "write_model"]

START_NS = 10**18
"""Instant of every simulation's t = 0, UTC: 2001-09-09, so that nobody takes one for a measurement of today."""

_BLOCK_READINGS = 65_536  # in memory at a time
_LONGEST_S = 10**9  # 30 years; with START_NS its nanoseconds stay far within 64 bits


@dataclass(frozen=True, slots=True)
class SimulateSummary:
    """What a simulation made."""

    file: str
    model: str
    seed: int
    readings: int
    lost: int
    """Readings that the model lost."""
    interval_s: float
    aperture_s: float
    witnesses: tuple[str, ...]


def read_model(path: Path) -> Model:
    """Read and check a model file.

    Raises:
        ConfigError: the file cannot be read, is not TOML, or says something that cannot be; one line with file, term,
            key, value and rule.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {(error.strerror or str(error)).lower()}; name a readable model file") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: byte {error.start}: not UTF-8 text; a model is a TOML file") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not TOML: {str(error)[0].lower()}{str(error)[1:]}") from error
    place = str(path)
    known = [field.name for field in fields(Model)]
    tables.pop("estimator", None)  # what reads it checks it: `acquire`, `replay`
    for key in tables:
        if key not in known:
            raise ConfigError(f"{place}: {key}: unknown key; {not_among(key, known)}")
    seed = tables.get("seed", 1)
    if type(seed) is not int or seed < 0:  # a bool is an int, but no seed
        raise ConfigError(f"{place}: seed = {seed!r}: must be a whole number, at least 0")
    terms = cast("tuple[Term, ...]", _parse_parts(tables, "terms", "term", TERMS, place))
    effects = cast("tuple[Effect, ...]", _parse_parts(tables, "effects", "effect", EFFECTS, place))
    try:
        return Model(terms, seed, effects)
    except ValueError as error:
        raise ConfigError(f"{place}: {error}") from error


def write_model(model: Model, path: Path) -> None:
    """Write a model file that `read_model` turns into the same model, to the last bit of every number.

    Raises:
        ConfigError: the file cannot be written.
    """
    try:
        path.write_text(format_model(model), encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"{path}: {(error.strerror or str(error)).lower()}; name a file that can be written"
        ) from error


def format_model(model: Model) -> str:
    """Return the text of a model's file.

    >>> from aemd.model import Level
    >>> print(format_model(Model((Level(level_V=0.1),), seed=4)), end="")
    seed = 4
    <BLANKLINE>
    [[terms]]
    term = "level"
    role = "signal"
    level_V = 0.1
    """
    text = [f"seed = {model.seed}\n"]
    for header, parts in (("terms", model.terms), ("effects", model.effects)):
        for part in parts:
            pairs = [(field.name, getattr(part, field.name)) for field in fields(part)]
            text.append(f"\n[[{header}]]\n")
            text += [f"{key} = {_format(value)}\n" for key, value in pairs if value is not None]
    return "".join(text)


def simulate(
    model_path: Path,
    *,
    seconds: float,
    seed: int | None = None,
    out: Path,
    interval_s: float = 0.06712,
    aperture_s: float = 0.02,
) -> SimulateSummary:
    """Write the recording that a model makes: the same bits for the same model, seed and times.

    The default interval is near the paper's 1/15 s but not on it: there 50, 60 and 100 Hz all fold onto 5 Hz or 0 Hz.
    The recording keeps the model's text in its session's metadata, as `model`, and the model's witnesses as topics.

    Args:
        model_path: the model file.
        seconds: length.
        seed: of the history; None for the model's own.
        out: the new recording.
        interval_s: from the beginning of one aperture to that of the next.
        aperture_s: length of the apertures.

    Raises:
        UsageError: the times do not fit together.
        ConfigError: the model file is wrong.
        RecordingError: the recording exists, or cannot be written.
    """
    if not 0 < aperture_s <= interval_s < math.inf:
        raise UsageError(f"--aperture {aperture_s}: must be above 0 and at most the interval of {interval_s} s")
    if not interval_s <= seconds <= _LONGEST_S:
        raise UsageError(f"--seconds {seconds}: must be from the interval of {interval_s} to {_LONGEST_S} s")
    if seed is not None and seed < 0:
        raise UsageError(f"--seed {seed}: must be at least 0")
    model = read_model(model_path)
    if seed is not None:
        model = replace(model, seed=seed)
    count = math.floor(seconds / interval_s * (1 + 1e-12))  # 10 s of 0.1 s are 100, whatever the division says
    description = Description(
        interval_s=interval_s,
        witnesses=model.witnesses,
        session={"origin": "simulated", "model": format_model(model), "aperture_s": repr(aperture_s)},
    )
    recorder = Recorder(out, description)
    try:
        history = model.realise()
        for first in range(0, count, _BLOCK_READINGS):
            start_s = np.arange(first, min(first + _BLOCK_READINGS, count), dtype=np.float64) * interval_s
            recorder.write(_to_batch(history.read(start_s, aperture_s)), np.empty(0, ESTIMATE))
    except BaseException:
        recorder.discard()
        raise
    recorder.close("end")
    return SimulateSummary(
        file=str(out),
        model=str(model_path),
        seed=model.seed,
        readings=recorder.counts.readings,
        lost=count - recorder.counts.readings,
        interval_s=interval_s,
        aperture_s=aperture_s,
        witnesses=tuple(model.witnesses),
    )


def _parse_parts(
    tables: Mapping[str, Any], header: str, tag: str, kinds: Mapping[str, type[Any]], place: str
) -> tuple[Any, ...]:
    """Return the terms, or the effects: each parsed alone, so that a message can tell which one is wrong."""
    listed = tables.get(header, [])
    if not isinstance(listed, list) or not all(isinstance(table, dict) for table in listed):
        raise ConfigError(f"{place}: {header}: must be a list of tables, each written [[{header}]]")
    parts = []
    for number, table in enumerate(listed, start=1):
        kind = kinds.get(str(table.get(tag)))
        if kind is None:
            said = f"{tag} = {table[tag]!r}: unknown" if tag in table else f"{tag}: missing"
            raise ConfigError(f"{place}: [{header} {number}] {said}; {not_among(str(table.get(tag, '')), kinds)}")
        parts.append(parse_options(kind, table, place, f"{header} {number}: {table[tag]}"))
    return tuple(parts)


def _format(value: Any) -> str:
    """Return a value as TOML; Python's float text is TOML's, and reads back to the same bits."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'  # a word of ours; nothing in it needs escaping
    if isinstance(value, tuple):
        return f"[{', '.join(_format(item) for item in value)}]"
    return repr(value)


def _to_batch(readings: Readings) -> Batch:
    block = np.zeros(readings.index.size, READING)
    block["index"] = readings.index
    block["t_ns"] = _to_ns(readings.stamp_s)
    block["value_V"] = readings.value_V
    witnesses = {}
    for name, witness in readings.witnesses.items():
        witnesses[name] = np.empty(witness.time_s.size, WITNESS)
        witnesses[name]["t_ns"], witnesses[name]["value"] = _to_ns(witness.time_s), witness.value
    return Batch(block, witnesses=witnesses)


def _to_ns(time_s: NDArray[np.float64]) -> NDArray[np.int64]:
    return START_NS + np.rint(time_s * 1e9).astype(np.int64)
