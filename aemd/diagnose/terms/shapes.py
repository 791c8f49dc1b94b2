"""Effects of a known shape in the mean: steps, warm-up, patterns, witnesses, a bent scale."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, log

import numpy as np
from numba import njit
from numpy.typing import NDArray

from aemd.diagnose.hypothesis import Bounds, Data, Parameter, Parts

__all__ = ["Nonlinearity", "ReadingPattern", "Step", "SupplyCoupling", "ThermalDrift", "WarmUp", "lagged"]

Floats = NDArray[np.float64]

_FREE: Bounds = (-1e9, 1e9)


@dataclass(frozen=True, slots=True)
class Step:
    """A level that is another one from an instant on; free number its size. The instant is that of a reading."""

    time_s: float
    size: float
    cost_nats: float
    cause: str = "step"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([self.size])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Free."""
        return [_FREE]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Add the step to the mean."""
        parts.mean += theta[0] * (data.t_s >= self.time_s - 1e-9)

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the instant, between two readings, and the size."""
        unit, half = data.unit_V, data.interval_s / 2
        return [
            Parameter("time_s", "s", lambda _: self.time_s - half),
            Parameter("step_V", "V", lambda v: v[0] * unit, positive=False),
        ]


@dataclass(frozen=True, slots=True)
class WarmUp:
    """A exp(-t/tau) from the beginning of the record; free numbers log tau_s, A."""

    tau_s: float
    size: float
    cost_nats: float
    cause: str = "warmup_drift"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([log(self.tau_s), self.size])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """A factor of 10 about the time constant that the score found."""
        return [(log(self.tau_s / 10), log(self.tau_s * 10)), _FREE]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Add the decay to the mean."""
        parts.mean += theta[1] * np.exp(-data.t_s / exp(theta[0]))

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the time constant and the amplitude at the first reading."""
        unit = data.unit_V
        return [
            Parameter("tau_s", "s", lambda v: exp(v[0])),
            Parameter("amplitude_V", "V", lambda v: v[1] * unit, positive=False),
        ]


@dataclass(frozen=True, slots=True)
class ReadingPattern:
    """Offsets that repeat with the number of the reading.

    Free numbers: all but the last, which balances them.
    """

    period: int
    offsets: tuple[float, ...]
    """Starts, of the first period - 1."""
    cost_nats: float
    cause: str = "reading_pattern"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array(self.offsets)

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Free."""
        return [_FREE] * (self.period - 1)

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Add the offsets to the mean."""
        parts.mean += np.append(theta, -theta.sum())[data.slot % self.period]

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the period and half the distance from the lowest to the highest offset."""
        unit = data.unit_V
        return [
            Parameter("period_readings", "", lambda _: float(self.period)),
            Parameter("amplitude_V", "V", lambda v: float(np.ptp(np.append(v, -np.sum(v)))) / 2 * unit),
        ]


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
    """A coefficient times a witness, after a first-order lag; free numbers the coefficient and a lag's logarithm."""

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
        unit, fixed = data.unit_V, self.lag_s == 0
        return [
            Parameter("coefficient_V_per_C", "V/C", lambda v: v[0] * unit, positive=False),
            Parameter("lag_s", "s", lambda v: 0.0 if fixed else exp(v[1])),
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
        parts.noise_var = parts.noise_var * gain**2

    def parameters(self, data: Data) -> Sequence[Parameter]:  # noqa: ARG002 - a Term's
        """Return the coefficient."""
        return [Parameter("coefficient_per_V", "1/V", lambda v: float(v[0]), positive=False)]


@dataclass(frozen=True, slots=True)
class Nonlinearity:
    """y = x + b x^2 about the level; free number b in inverse units."""

    coefficient: float
    cost_nats: float
    cause: str = "nonlinearity"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([self.coefficient])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Such that the scale stays one within some deviations."""
        return [(-1.0, 1.0)]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:  # noqa: ARG002 - a Term's
        """Bend the prediction."""
        parts.extras[1] = theta[0]

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return b."""
        unit = data.unit_V
        return [Parameter("coefficient_per_V", "1/V", lambda v: v[0] / unit, positive=False)]
