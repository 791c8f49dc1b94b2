"""Writes the extended model as the file that `simulate`, `acquire`, `replay` and `tune` take."""

from pathlib import Path

from aemd.config import parse_options
from aemd.diagnose.result import Diagnosis
from aemd.model import EFFECTS, TERMS, Model
from aemd.simulate import write_model

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


def write_extended(diagnosis: Diagnosis, path: Path) -> None:
    """Write the extended model as TOML.

    Raises:
        ConfigError: the file cannot be written.
    """
    write_model(model_of(diagnosis), path)
