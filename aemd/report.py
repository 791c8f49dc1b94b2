"""What is left when the readings have passed: a result as a table, as JSON or as TOML."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, is_dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from aemd.display import format_quantity

__all__ = ["as_json", "as_table", "as_toml"]


def as_json(result: Any) -> str:
    """Return a result as JSON: a dataclass's fields in their order, numbers that are not finite as null."""

    def plain(value: Any) -> Any:
        if is_dataclass(value) and not isinstance(value, type):
            return plain(asdict(value))
        if isinstance(value, Mapping):
            return {str(key): plain(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        if isinstance(value, float) and not math.isfinite(value):
            return None
        return str(value) if isinstance(value, Path) else value

    return json.dumps(plain(result), indent=2)


def as_table(result: Any, title: str) -> Table:
    """Return a result, a dataclass, as a two-column table with its units taken out of the names."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")  # a file's name cut short is no name
    for key, value in asdict(result).items():
        table.add_row(*map(Text, _say(key, value)))
    return table


def _say(key: str, value: Any) -> tuple[str, str]:
    """Return a field's name and value as a person writes them."""
    if value is None:
        return key.removesuffix("_V2").replace("_", " "), "-"
    if key.endswith("_variance_V2"):
        spread = format_quantity(math.sqrt(value), "V", 4).lstrip("+")
        return key.removesuffix("_V2").replace("_", " "), f"{value:.4g} V²  (standard deviation {spread})"
    if key.endswith("_hz"):
        return key.removesuffix("_hz").replace("_", " "), f"{value:.4f} /s"
    if key == "readings_per_s":
        return "speed", f"{value:,.0f} readings/s"
    if key.endswith("_s"):
        return key.removesuffix("_s").replace("_", " "), f"{value:.3f} s"
    if key in {"t0", "t1"}:
        return key, datetime.fromtimestamp(value, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    if isinstance(value, Mapping):
        return key.replace("_", " "), "\n".join(f"{name}: {_say(name, item)[1]}" for name, item in value.items())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return key.replace("_", " "), "\n".join(map(str, value)) or "-"
    if isinstance(value, bool):
        return key.replace("_", " "), "yes" if value else "no"
    return key.replace("_", " "), f"{value:,}" if isinstance(value, int) else str(value)


def as_toml(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Return tables of plain values as TOML, so that what was checked can be kept and used.

    >>> print(as_toml({"scale": {"factor": 2.0, "unit": "g"}}))
    [scale]
    factor = 2.0
    unit = "g"
    """
    blocks = []
    for name, table in tables.items():
        plain = {key: value for key, value in table.items() if not isinstance(value, Mapping) and value is not None}
        blocks.append("\n".join([f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in plain.items())]))
        nested = {f"{name}.{key}": value for key, value in table.items() if isinstance(value, Mapping)}
        if nested:
            blocks.append(as_toml(nested))
    return "\n\n".join(blocks)


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items() if item is not None) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return json.dumps(value, ensure_ascii=False, default=str)
