"""The shapes that commands have: an action, a question, a number with its limits, a switch, a choice, a mask."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, TypeAlias

from sim34410.meter import Meter
from sim34410.reply import format_integer, format_number
from sim34410.scpi import NO_UNIT, parse_boolean, parse_choice, parse_number, short
from sim34410.status import ScpiError

__all__ = ["ONE", "UP_TO_ONE", "UP_TO_TWO", "Command", "Result", "Wait", "ask", "choice", "do", "limits"]
__all__ += ["mask", "number", "switch"]


@dataclass(frozen=True, slots=True)
class Wait:
    """An answer that is not there yet."""

    until_ns: int | None
    """Host instant at which to ask again; None when only another client's command can end the wait."""
    resume: "Callable[[], Result]"
    """What to ask again."""


Result: TypeAlias = bytes | str | Wait | None
"""What comes of a command: an answer, none, or one that has to be waited for."""

Action: TypeAlias = Callable[[Meter, tuple[str, ...]], Result]
"""Takes the parameters as sent."""

NONE, ONE, UP_TO_ONE, UP_TO_TWO = range(1), range(1, 2), range(2), range(3)
"""How many parameters a command takes."""


@dataclass(frozen=True, slots=True)
class Command:
    """One header; a form of it without an action is an undefined header."""

    set: Action | None = None
    get: Action | None = None
    parameters: range = NONE
    """Of the set form."""
    query_parameters: range = NONE
    """Of the query form."""


def do(action: Callable[[Meter], Result]) -> Command:
    """Return a command without parameters or query."""
    return Command(set=lambda meter, _: action(meter))


def ask(answer: Callable[[Meter], Result]) -> Command:
    """Return a command that is only a query."""
    return Command(get=lambda meter, _: answer(meter))


def limits(least: float, most: float, default: float) -> Mapping[str, float]:
    """Return the values that have names."""
    return {"MINimum": least, "MAXimum": most, "DEFault": default}


def number(
    *,
    get: Callable[[Meter], float],
    set: Callable[[Meter, float], None],  # noqa: A002 - the pair of get
    limits: Callable[[Meter], Mapping[str, float]],
    units: Mapping[str, int] = NO_UNIT,
    show: Callable[[float], str] = format_number,
    infinity: bool = False,
    least: float | None = None,
) -> Command:
    """Return a number that is set, and asked for with or without the name of a limit.

    Args:
        get: the present value.
        set: what a new one does.
        limits: the values of MIN, MAX and perhaps DEF; beyond MIN or MAX is -222.
        units: suffixes that it may carry.
        show: how it is written.
        infinity: INF is taken as well.
        least: the bound that is enforced, where it is not MIN.
    """

    def write(meter: Meter, parameters: tuple[str, ...]) -> None:
        named = limits(meter)
        value = parse_number(parameters[0], units, {**named, "INFinity": inf} if infinity else named)
        lowest = named["MINimum"] if least is None else least
        if not lowest <= value <= named["MAXimum"] and value != inf:
            raise ScpiError(-222)
        set(meter, value)

    def read(meter: Meter, parameters: tuple[str, ...]) -> str:
        if not parameters:
            return show(get(meter))
        named = limits(meter)
        return show({short(name): value for name, value in named.items()}[parse_choice(parameters[0], tuple(named))])

    return Command(set=write, get=read, parameters=ONE, query_parameters=UP_TO_ONE)


def switch(field: str) -> Command:
    """Return an ON/OFF setting of the meter."""
    return Command(
        set=lambda meter, parameters: meter.change(**{field: parse_boolean(parameters[0])}),
        get=lambda meter, _: str(int(getattr(meter.settings, field))),
        parameters=ONE,
    )


def choice(field: str, words: tuple[str, ...]) -> Command:
    """Return a setting that is one of a few words, written as manuals do."""
    return Command(
        set=lambda meter, parameters: meter.change(**{field: parse_choice(parameters[0], words)}),
        get=lambda meter, _: str(getattr(meter.settings, field)),
        parameters=ONE,
    )


def mask(owner: Callable[[Meter], Any], field: str, most: int) -> Command:
    """Return an enable register: an integer from 0."""
    return number(
        get=lambda meter: getattr(owner(meter), field),
        set=lambda meter, value: setattr(owner(meter), field, round(value)),
        limits=lambda _: {"MINimum": 0, "MAXimum": most},
        show=format_integer,
    )
