"""SCPI without an instrument: headers, the command tree, parameters. Rules: SCPI-99 volume 1, IEEE 488.2 chapter 7.

A tree is made of specifications as manuals print them: `[SENSe:]VOLTage[:DC]:NPLCycles`. Capitals are the short form,
the whole word the long form, nothing between; brackets are optional.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from math import inf
from typing import Generic, TypeVar

from sim34410.status import ScpiError

__all__ = [
    "NO_UNIT",
    "SECONDS",
    "VOLTS",
    "Tree",
    "Unit",
    "parse_boolean",
    "parse_choice",
    "parse_message",
    "parse_number",
    "short",
]

NO_UNIT: Mapping[str, int] = {"": 0}
"""Suffixes that a number may carry, each with its power of ten; so for the next two."""
SECONDS: Mapping[str, int] = {"": 0, "S": 0, "MS": -3, "US": -6, "NS": -9, "KS": 3}
VOLTS: Mapping[str, int] = {"": 0, "V": 0, "MV": -3, "UV": -6, "KV": 3}

_FOREIGN = re.compile(r"[^\t -~]")
_HEADER = re.compile(r"(\*[A-Z]+|:?[A-Z][A-Z0-9_]*(?::[A-Z][A-Z0-9_]*)*)(\??)")
_NUMBER = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+))(?:E([+-]?\d{1,9}))?\s*([A-Z]*)")
_NODE = re.compile(r"\[:?[^\]]+\]|:?[^:\[\]]+")

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Unit:
    """One program message unit: a header resolved against the path before it, and its parameters."""

    path: tuple[str, ...]
    """Upper-case mnemonics from the root."""
    query: bool
    parameters: tuple[str, ...]
    """As sent, stripped."""


def parse_message(line: str) -> Iterator[Unit]:
    """Yield the units of one program message, each when the one before it has been obeyed.

    Raises:
        ScpiError: -101, -102 or -151, at the unit that has it.
    """
    if _FOREIGN.search(line):
        raise ScpiError(-101)
    above: tuple[str, ...] = ()
    for text in _split(line, ";"):
        if not text.strip():
            continue
        header, *rest = text.split(None, 1)
        match = _HEADER.fullmatch(header.upper())
        if not match:
            raise ScpiError(-102)
        name, query = match[1], bool(match[2])
        parameters = tuple(part.strip() for part in _split(rest[0], ",")) if rest else ()
        if name.startswith("*"):  # a common command leaves the path alone
            yield Unit((name,), query, parameters)
            continue
        path = tuple(name[1:].split(":")) if name.startswith(":") else (*above, *name.split(":"))
        above = path[:-1]
        yield Unit(path, query, parameters)


def _split(text: str, separator: str) -> list[str]:
    """Split at separators outside quotation marks."""
    if '"' not in text and "'" not in text:
        return text.split(separator)
    parts, quote, begin = [], "", 0
    for position, character in enumerate(text):
        if quote:
            quote = "" if character == quote else quote
        elif character in "\"'":
            quote = character
        elif character == separator:
            parts.append(text[begin:position])
            begin = position + 1
    if quote:
        raise ScpiError(-151)
    return [*parts, text[begin:]]


def short(word: str) -> str:
    """Return the short form of a mnemonic that is written as manuals do.

    >>> short("VOLTage"), short("*IDN"), short("WINDow2")
    ('VOLT', '*IDN', 'WIND2')
    """
    return "".join(character for character in word if not character.islower())


class Tree(Generic[T]):
    """Commands by header."""

    def __init__(self, entries: Mapping[str, T]) -> None:
        """Take entries by specification, without a question mark."""
        self._entries: dict[tuple[str, ...], T] = {}
        self._short: dict[str, str] = {}
        for specification, entry in entries.items():
            nodes = _NODE.findall(specification)
            for path in product(*(self._ways(node) for node in nodes)):
                self._entries[tuple(mnemonic for mnemonic in path if mnemonic)] = entry

    def _ways(self, node: str) -> tuple[str, ...]:
        word = node.strip("[]:")
        self._short[short(word)] = self._short[word.upper()] = short(word)
        return (short(word), "") if node.startswith("[") else (short(word),)

    def find(self, path: tuple[str, ...]) -> T:
        """Return the entry at a path of short or long mnemonics; a numeric suffix 1 may be there or not.

        Raises:
            ScpiError: -113, there is none.
        """
        if path not in self._entries:
            path = self._key(path)
        if path not in self._entries:
            raise ScpiError(-113)
        return self._entries[path]

    def short(self, path: tuple[str, ...]) -> str:
        """Return a path as its short mnemonics, without SENSe and DC, which are optional wherever they are."""
        return ":".join(word for word in self._key(path) if word not in ("SENS", "DC"))

    def _key(self, path: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(self._short.get(word) or self._short.get(word.removesuffix("1"), "?") for word in path)


def parse_number(text: str, units: Mapping[str, int], named: Mapping[str, float]) -> float:
    """Return a numeric parameter in its base unit; `named` holds MIN, MAX, DEF and INF where they are allowed.

    >>> parse_number("66.7 ms", SECONDS, {}), parse_number("minimum", SECONDS, {"MINimum": 0.5})
    (0.0667, 0.5)

    Raises:
        ScpiError: -104 not a number, -131 not a unit of this quantity, -222 too large to be represented.
    """
    upper = text.upper()
    for word, value in named.items():
        if upper in (short(word), word.upper()):
            return value
    match = _NUMBER.fullmatch(upper)
    if not match:
        raise ScpiError(-104)
    if match[3] not in units:
        raise ScpiError(-131)
    value = float(f"{match[1]}e{int(match[2] or 0) + units[match[3]]}")  # one rounding: 66.7 ms is 0.0667 s
    if abs(value) == inf:
        raise ScpiError(-222)
    return value


def parse_choice(text: str, words: tuple[str, ...]) -> str:
    """Return the short form of one of `words`.

    Raises:
        ScpiError: -224, it is none of them.
    """
    for word in words:
        if text.upper() in (short(word), word.upper()):
            return short(word)
    raise ScpiError(-224)


def parse_boolean(text: str) -> bool:
    """Return ON or OFF, or a number that is rounded: 0 is off.

    Raises:
        ScpiError: -104, it is neither.
    """
    if text.upper() in ("ON", "OFF"):
        return text.upper() == "ON"
    return round(parse_number(text, NO_UNIT, {})) != 0
