"""A model file: the options of IMM as TOML, which is also the `[estimator]` table of a config."""

import tomllib
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from aemd.errors import ConfigError
from aemd.estimate.imm import ImmOptions

__all__ = ["read_parameters", "write_parameters"]


def write_parameters(options: ImmOptions, path: Path, comment: str = "") -> None:
    """Write options as the `[estimator]` table of a config, which is also a model file of its own.

    Args:
        options: what to write; a field that is None is left out.
        path: file to write.
        comment: lines to put above.
    """
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    lines += ["[estimator]", 'name = "imm"']
    for name, value in asdict(options).items():
        if value is not None:
            lines.append(f"{name} = {_toml(value)}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_parameters(path: Path) -> ImmOptions:
    """Return the options in a model file.

    Raises:
        ConfigError: no such file, not a model file, or a value out of bounds.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))["estimator"]
        name = table.pop("name")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, AttributeError) as error:
        raise ConfigError(f"{path}: not a model file, which has a table [estimator] with a name: {error}") from error
    if name != "imm":
        raise ConfigError(f"{path}: [estimator] name = {name!r}: must be 'imm'")
    known = [field.name for field in fields(ImmOptions)]
    unknown = [key for key in table if key not in known]
    if unknown:
        raise ConfigError(f"{path}: [estimator] {unknown[0]}: no such option; there are: {', '.join(known)}")
    options: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}
    try:
        return ImmOptions(**options)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{path}: [estimator] {error}") from error


def _toml(value: Any) -> str:
    """Return a number, a word or a tuple of numbers in TOML, exact to the last bit."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return f'"{value}"' if isinstance(value, str) else repr(value)
