"""What a recording says of itself, before its first reading: enough to replay it with no other file."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

__all__ = ["Description", "Scalar", "read_parameters", "write_parameters"]

Scalar = float | int | bool | str


@dataclass(frozen=True, slots=True)
class Description:
    """What was measured, with what, and how it was estimated. Mappings hold text, since MCAP metadata does."""

    unit: str = "V"
    """Unit of the readings and estimates."""
    quantity: str = "voltage"
    """What the readings are of."""
    interval_s: float = 0.0
    """Nominal time between readings, s; 0 where there is none."""
    first_index: int = 0
    """Index that the first reading has if none was lost before it. A Message's sequence number has 32 bits; this is
    where the reader starts to count its turns."""
    witnesses: Mapping[str, str] = field(default_factory=dict)
    """Unit of each further quantity by its name; "" for unknown."""
    session: Mapping[str, str] = field(default_factory=dict)
    """Start, host, versions, origin."""
    instrument: Mapping[str, str] = field(default_factory=dict)
    """Identity, and every setting as read back."""
    calibration: Mapping[str, str] = field(default_factory=dict)
    """Scale factor, offset and unit, and where they come from."""
    estimator: Mapping[str, str] = field(default_factory=dict)
    """Of `write_parameters`; empty for a recording without estimates, which then has no such topic."""
    clock: Mapping[str, str] = field(default_factory=dict)
    """Epoch, offset and uncertainty as known at the start; `Recorder.close` takes them as known at the end."""
    segment: Mapping[str, str] = field(default_factory=dict)
    """Of one file of several that an acquisition left: its number, the file before it, what was lost so far."""
    state: Mapping[str, str] = field(default_factory=dict)
    """Of the estimator before the first reading, by `save_state`, where the file begins in mid-stream."""
    config_toml: str = ""
    """The config file's text; "" where there was none."""


def write_parameters(name: str, parameters: Mapping[str, Scalar]) -> dict[str, str]:
    """Return an estimator's name and parameters as text that reads back to the same bits.

    Each value is JSON: its floats are the shortest decimals that round to the same double, and its types survive.

    >>> write_parameters("aem", {"q": 0.1, "window": 15})
    {'name': 'aem', 'q': '0.1', 'window': '15'}
    """
    return {"name": name} | {key: json.dumps(value) for key, value in parameters.items()}


def read_parameters(text: Mapping[str, str]) -> tuple[str, dict[str, Scalar]]:
    """Return the name and the parameters that `write_parameters` wrote.

    Raises:
        ValueError: it did not write this.

    >>> read_parameters({"name": "aem", "q": "1e-17"})
    ('aem', {'q': 1e-17})
    """
    if "name" not in text:
        raise ValueError("name: missing")
    parameters = {}
    for key, value in text.items():
        if key != "name":
            try:
                parameters[key] = json.loads(value)
            except ValueError as error:
                raise ValueError(f"{key} = {value!r}: not a value as JSON has them") from error
    return text["name"], parameters
