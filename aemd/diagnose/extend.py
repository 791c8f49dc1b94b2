"""Writes the extended model as the file that `simulate`, `acquire`, `replay` and `tune` take."""

from pathlib import Path

from aemd.config import parse_options
from aemd.diagnose.estimator import estimator_for
from aemd.diagnose.report import format_promise
from aemd.diagnose.result import Diagnosis
from aemd.errors import ConfigError
from aemd.model import EFFECTS, TERMS, Model
from aemd.report import as_toml
from aemd.simulate import format_model

__all__ = ["model_of", "write_extended"]


def model_of(diagnosis: Diagnosis, *, extended: bool = True) -> Model:
    """Return the extended model of a diagnosis, or its base, as the catalogue has it."""
    tables = diagnosis.extended_model if extended else diagnosis.base_model
    return Model(
        terms=tuple(parse_options(TERMS[part["term"]], part, "diagnosis", part["term"]) for part in tables["terms"]),
        seed=int(tables["seed"]),
        effects=tuple(
            parse_options(EFFECTS[part["effect"]], part, "diagnosis", part["effect"]) for part in tables["effects"]
        ),
    )


def write_extended(diagnosis: Diagnosis, path: Path, *, extended: bool = True) -> None:
    """Write the extended model, or the base it began with, and the estimator that goes with it, as TOML.

    `simulate` takes its terms and effects, `acquire` and `replay` its [estimator]; each leaves the other's be.

    Raises:
        ConfigError: the file cannot be written.
    """
    tables = diagnosis.extended_model if extended else diagnosis.base_model
    made = model_of(diagnosis, extended=extended)
    interval_s = 1 / diagnosis.rate_hz
    taken = not extended or diagnosis.promise is None or diagnosis.promise.taken
    choice, notes = estimator_for(
        made if taken else model_of(diagnosis, extended=False),
        interval_s=interval_s,
        aperture_s=tables["aperture_s"],
        span_s=diagnosis.n * interval_s,
    )
    text = [f"# Found in {Path(diagnosis.path).name} by `aemd diagnose`: {diagnosis.verdict.replace('_', ' ')}.\n"]
    text += [f"# In the readings, but without a term here: {cause}.\n" for cause in tables["without_term"]]
    text.append(format_model(made))
    text.append("\n# What the estimator takes from the terms above.\n")
    if extended and diagnosis.promise is not None:
        text.append(f"# {format_promise(diagnosis.promise)}\n")
    text += [f"# {note[0].upper()}{note[1:]}.\n" for note in notes]
    if choice is not None:
        text.append(as_toml(choice.as_table()) + "\n")
    try:
        path.write_text("".join(text), encoding="utf-8")
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise ConfigError(f"{path}: {reason}; name a file that can be written") from error
