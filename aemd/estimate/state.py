"""An estimator's state as text, and back: what a recording that begins in mid-stream needs to be replayed to the bit.

An estimator carries its state in numpy arrays and whole numbers. They are found where it keeps them, so that a new
estimator needs no code for this; what it was made of (options, constants of its model) is left out, since whoever puts
a state back has made the same estimator before.
"""

import base64
import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from aemd.estimate.protocol import Estimator

__all__ = ["copy_state", "count_numbers", "load_state", "save_state", "write_state"]

_MADE_OF = {"options", "interval_s", "_few", "_model", "_rule", "_pairs"}
"""Attributes that come from the options; they never change."""

_Put = Callable[[Any], None]


def copy_state(estimator: Estimator) -> dict[str, Any]:
    """Return the state by its place in the estimator, copied: arrays, whole numbers and None."""
    return {
        place: value.copy() if isinstance(value, np.ndarray) else value for place, value, _ in _places(estimator, "")
    }


def count_numbers(estimator: Estimator) -> int:
    """Return how many numbers an estimator carries from reading to reading."""
    return sum(value.size if isinstance(value, np.ndarray) else 1 for _, value, _ in _places(estimator, ""))


def write_state(state: Mapping[str, Any]) -> dict[str, str]:
    """Return a copied state with each value as JSON."""
    return {place: _as_text(value) for place, value in state.items()}


def save_state(estimator: Estimator) -> dict[str, str]:
    """Return the state as text.

    The same readings give the same text, whatever blocks they came in.
    """
    return write_state(copy_state(estimator))


def load_state(estimator: Estimator, text: Mapping[str, str]) -> None:
    """Put the state into an estimator just made with the same options.

    Raises:
        ValueError: it is none of this estimator with these options, or of another version of it.
    """
    places = {place: (value, put) for place, value, put in _places(estimator, "")}
    if places.keys() != text.keys():
        odd = sorted(places.keys() ^ text.keys())
        raise ValueError(f"{odd[0]}: in one of estimator and state only")
    for place, (value, put) in places.items():
        put(_from_text(place, text[place], value))


def _places(owner: Any, path: str) -> Iterator[tuple[str, Any, _Put]]:
    """Yield each piece of state: its place, its value, and what puts another one there."""
    if isinstance(owner, tuple):
        fields = [(name, getattr(owner, name), None) for name in getattr(owner, "_fields", ())]
    elif not type(owner).__module__.startswith("aemd."):  # filterpy's filter; the rest of it follows from these
        fields = [(name, value, owner) for name, value in vars(owner).items() if name in {"x", "P"}]
    else:
        fields = [(name, value, owner) for name, value in vars(owner).items() if name not in _MADE_OF]
    for name, value, holder in fields:
        place = f"{path}.{name}" if path else name
        if isinstance(value, np.ndarray) and value.dtype != object:
            yield place, value, _into(value) if holder is None else _onto(holder, name)
        elif isinstance(value, int | None):
            yield place, value, _onto(holder, name)
        elif hasattr(value, "_fields") or (hasattr(value, "__dict__") and not callable(value)):
            yield from _places(value, place)


def _into(array: Any) -> _Put:
    def put(value: Any) -> None:
        array[...] = value

    return put


def _onto(holder: Any, name: str) -> _Put:
    return lambda value: setattr(holder, name, value)


def _as_text(value: Any) -> str:
    if not isinstance(value, np.ndarray):
        return json.dumps(value)
    octets = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
    return json.dumps({"type": _name_of(value.dtype), "shape": value.shape, "base64": octets})


def _from_text(place: str, text: str, value: Any) -> Any:
    try:
        told = json.loads(text)
    except ValueError as error:
        raise ValueError(f"{place}: not a value as JSON has them") from error
    if not isinstance(value, np.ndarray):
        return told
    if not isinstance(told, dict) or (told.get("type"), told.get("shape")) != (_name_of(value.dtype), [*value.shape]):
        raise ValueError(f"{place}: of another type or shape")
    octets = base64.b64decode(told.get("base64", ""), validate=True)
    if len(octets) != value.nbytes:
        raise ValueError(f"{place}: has {len(octets)} bytes instead of {value.nbytes}")
    return np.frombuffer(octets, value.dtype).reshape(value.shape).copy()


def _name_of(kind: np.dtype[Any]) -> str:
    return json.dumps(kind.descr)
