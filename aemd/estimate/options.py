"""What every estimator of this package can be told: the state model, its noise, and what to do where readings lack.

An options class is a frozen dataclass whose bounds stand beside the fields, so that a config reader, a help text and
the check below read the same ones. Options carry no sampling interval: that is the meter's.
"""

import math
import operator
import typing
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Lt

from aemd.errors import ConfigError

__all__ = ["Count", "Positive", "StateOptions", "check_bounds", "discrete_phi"]

Positive = Annotated[float, Ge(1e-30), Le(1e30)]
"""A number above zero whose square, too, is one that a computer can hold."""

Count = Annotated[int, Ge(1), Le(1_000_000)]
"""A number of readings or passes. The upper bound only keeps a slip of the pen from filling the memory."""

_RULES = (
    (Gt, "gt", operator.gt, "above"),
    (Ge, "ge", operator.ge, "at least"),
    (Lt, "lt", operator.lt, "below"),
    (Le, "le", operator.le, "at most"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class StateOptions:
    """The state model of the paper, x' = phi x + v, z = x + u + w (eq. 2 and 3), and the treatment of holes."""

    tau_s: Annotated[float, Gt(0)] = math.inf
    """Time constant of the input's Markov process (eq. 2), s; infinite is a random walk. The paper gives no number, and
    any finite one pulls a constant input, which is what a bias is, towards 0 V."""
    sigma_Q_V: Positive = 0.93e-3
    """Standard deviation of the process noise, per reading, V (the paper, section 4.1, in mV)."""
    sigma_R_V: Positive = 0.99e-3
    """Standard deviation of the reading's white noise, V (the paper, section 4.1, in mV)."""
    prior_sigma_V: Positive = 1000.0
    """Standard deviation of the input about 0 V before the first reading, V: the meter's largest range. Until a reading
    with a value has come, this and 0 V are the answer."""
    gate: Positive = 1e6
    """A reading further than this from its prediction, in standard deviations, is treated as one without a value. No
    shock comes near it; a number such as 1e30 does, and would be remembered for as long as the filter remembers."""
    restart_after: Annotated[int, Ge(0), Le(1_000_000)] = 15
    """After more readings in a row than this without a value (lost or flagged), the estimator starts afresh."""

    def __post_init__(self) -> None:
        """Refuse what is out of bounds.

        Raises:
            ValueError: a value breaks a rule.
        """
        check_bounds(self)


def check_bounds(options: Any) -> None:
    """Hold the fields of a dataclass against the bounds and choices in their annotations.

    Raises:
        ValueError: `key = value: rule`, of the first field that breaks one.
    """
    hints = typing.get_type_hints(type(options), include_extras=True)
    for field in fields(options):
        value, hint = getattr(options, field.name), hints[field.name]
        if typing.get_origin(hint) is Literal and value not in typing.get_args(hint):
            raise ValueError(f"{field.name} = {value!r}: must be one of {', '.join(map(repr, typing.get_args(hint)))}")
        rules = getattr(hint, "__metadata__", ())
        if rules:
            whole = typing.get_args(hint)[0] is int
            if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
                raise ValueError(f"{field.name} = {value!r}: must be a {'whole ' if whole else ''}number")
        for rule in rules:
            for kind, attribute, holds, words in _RULES:
                if isinstance(rule, kind) and not holds(value, bound := getattr(rule, attribute)):
                    raise ValueError(f"{field.name} = {value!r}: must be {words} {bound}")


def discrete_phi(tau_s: float, interval_s: float) -> float:
    """Return the Markov coefficient from one reading to the next, exp(-T / tau).

    The paper's Phi = -1/tau (after eq. 3) is the coefficient of the differential equation, not of eq. 2.

    Raises:
        ConfigError: the interval is not a finite number above zero.

    >>> discrete_phi(float("inf"), 1 / 15)
    1.0
    """
    if not 0 < interval_s < math.inf:
        raise ConfigError(f"interval_s = {interval_s!r}: must be a finite number of seconds above 0")
    return math.exp(-interval_s / tau_s)
