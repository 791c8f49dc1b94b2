"""What a second instrument saw: what couples to it, as it is, late or through a lag, and what it scales."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, log

import numpy as np
from numba import njit
from numpy.typing import NDArray

from aemd.diagnose.hypothesis import Bounds, Data, Parameter, Parts, Term

__all__ = ["Latency", "SupplyCoupling", "ThermalDrift", "called", "delayed", "lagged", "odds_against", "unit_of"]

Floats = NDArray[np.float64]

_FREE: Bounds = (-1e9, 1e9)
_UNITS = {
    "temp": "C",
    "supply": "V",
    "volt": "V",
    "humid": "PERCENT",
    "pressure": "PA",
    "baro": "PA",
    "current": "A",
}
"""Unit of a witness by what its name holds, as recordings and logs of them are named."""
_SELDOM = log(4.0)
"""What it costs a coupling to be of the other kind than its witness's unit says. Where the level does not move, gain
and offset are the same readings, and only this tells them apart: four to one, so that the other stays in the set."""


def unit_of(witness: str) -> str:
    """Return the unit of a witness, by its name, for the names of parameters; UNIT where the name tells none.

    >>> unit_of("room_temperature"), unit_of("humidity"), unit_of("pressure_hPa"), unit_of("fan")
    ('C', 'PERCENT', 'HPA', 'UNIT')
    """
    words = witness.lower().split("_")
    for suffix, unit in (("c", "C"), ("degc", "C"), ("k", "K"), ("v", "V"), ("hpa", "HPA"), ("pa", "PA"), ("a", "A")):
        if len(words) > 1 and words[-1] == suffix:
            return unit
    return next((unit for word, unit in _UNITS.items() if word in witness.lower()), "UNIT")


def odds_against(cause: str, witness: str) -> float:
    """Return what the unit of a witness says against a coupling, nats: a voltage scales, a temperature shifts.

    >>> odds_against("thermal_drift", "supply_V") == odds_against("supply_coupling", "room_temperature") > 0
    True
    >>> odds_against("thermal_drift", "humidity"), odds_against("supply_coupling", "supply_V")
    (0.0, 0.0)
    """
    unusual = {"thermal_drift": ("V",), "supply_coupling": ("C", "K")}
    return _SELDOM if unit_of(witness) in unusual.get(cause, ()) else 0.0


def called(term: Term) -> str:
    """Return the name of a term for a user: its cause, but of a voltage that adds, what one that scales has."""
    adds = isinstance(term, ThermalDrift) and unit_of(term.witness) == "V"
    return "supply_coupling" if adds else term.cause


def delayed(values: Floats, t_s: Floats, lag_s: float) -> Floats:
    """Return a series as it was a while before, held at its ends, shape (n,)."""
    return np.asarray(np.interp(t_s - lag_s, t_s, values))


@njit(cache=True)
def lagged(values: Floats, step_s: Floats, lag_s: float) -> Floats:
    """Return what a first-order lag makes of a series, beginning settled, shape (n,)."""
    out = np.empty(values.size)
    level = values[0]
    for k in range(values.size):
        level += (values[k] - level) * (1.0 - np.exp(-step_s[k] / lag_s) if lag_s > 0 else 1.0)
        out[k] = level
    return out


@dataclass(frozen=True, slots=True)
class ThermalDrift:
    """A coefficient times a witness, after a first-order lag; free numbers the coefficient and a lag's logarithm.

    Of a voltage too, whose gain is its rival and so of another cause; see `called`.
    """

    witness: str
    lag_s: float
    """Where the fit begins, s; 0 for none."""
    coefficient: float
    """Units of the readings per unit of the witness."""
    cost_nats: float
    cause: str = "thermal_drift"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([self.coefficient, log(self.lag_s)] if self.lag_s else [self.coefficient])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """The coefficient is free, the lag within a factor of 5."""
        return [_FREE] + ([(log(self.lag_s / 5), log(self.lag_s * 5))] if self.lag_s else [])

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Add the lagged witness to the mean."""
        witness = data.witnesses[self.witness]
        lag_s = exp(theta[1]) if self.lag_s else 0.0
        parts.mean += theta[0] * lagged(witness - witness.mean(), data.step_s, lag_s)

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return coefficient and lag."""
        unit, fixed, per = data.unit_V, self.lag_s == 0, unit_of(self.witness)
        return [
            Parameter(f"coefficient_V_per_{per}", f"V/{per}", lambda v: v[0] * unit, positive=False),
            Parameter("lag_s", "s", lambda v: 0.0 if fixed else exp(v[1])),
        ]


@dataclass(frozen=True, slots=True)
class Latency:
    """A coefficient times a witness as it was a while before; free numbers the coefficient and (lag - lag0)/lag0.

    Where the model under criticism has the witness already, what is late is only moved: the witness of now is taken
    off again.
    """

    witness: str
    lag_s: float
    """lag0, s; readings stamped late are positive, witnesses late negative."""
    coefficient: float
    known: bool
    """Whether the witness is in the model already, as it is now."""
    cost_nats: float
    cause: str = "latency"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([self.coefficient, 0.0])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """The coefficient is free, the lag from a fifth to twice."""
        return [_FREE, (-0.8, 1.0)]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Add the late witness to the mean."""
        values = data.witnesses[self.witness]
        late = delayed(values, data.t_s, self.lag_s * (1 + float(theta[1])))
        parts.mean += theta[0] * (late - (values if self.known else values.mean()))

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return lag and coefficient."""
        unit, per = data.unit_V, unit_of(self.witness)
        return [
            Parameter("lag_s", "s", lambda v: self.lag_s * (1 + v[1]), positive=False),
            Parameter(f"coefficient_V_per_{per}", f"V/{per}", lambda v: v[0] * unit, positive=False),
        ]


@dataclass(frozen=True, slots=True)
class SupplyCoupling:
    """A gain that follows a witness, 1 + c (witness - its mean); free number c, per unit of the witness."""

    witness: str
    coefficient: float
    cost_nats: float
    cause: str = "supply_coupling"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([self.coefficient])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Free."""
        return [_FREE]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Scale the states, the noise, and the mean counted from 0 V."""
        witness = data.witnesses[self.witness]
        gain = 1 + theta[0] * (witness - witness.mean())
        zero = data.origin_V / data.unit_V
        parts.mean = (parts.mean + zero) * gain - zero
        parts.scale = parts.scale * gain
        parts.noise_var, parts.averaged = parts.noise_var * gain**2, parts.averaged * gain**2

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the coefficient, and what it comes to at the mean level: of a still one nothing says which it is."""
        per, level_V = unit_of(self.witness), data.origin_V + float(np.mean(data.y[data.used])) * data.unit_V
        return [
            Parameter(f"coefficient_per_{per}", f"1/{per}", lambda v: float(v[0]), positive=False),
            Parameter(f"coefficient_V_per_{per}", f"V/{per}", lambda v: float(v[0]) * level_V, positive=False),
        ]
