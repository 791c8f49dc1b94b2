"""Effects of a known shape in the mean: steps, warm-up, patterns, a bent scale."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, log

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.hypothesis import Bounds, Data, Parameter, Parts, Seen

__all__ = ["Hump", "Nonlinearity", "ReadingPattern", "Step", "WarmUp"]

Floats = NDArray[np.float64]

_FREE: Bounds = (-1e9, 1e9)
_LEAST_SLOPE = 0.25
"""Of a bent scale. No meter's folds back; the loudest shocks alone come so far."""


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
class Hump:
    """A bell in the mean, once; no mechanism of the catalogue, so where it explains more, a name is refused.

    Free numbers: its place in widths, the logarithm of its width, its height.
    """

    centre_s: float
    width_s: float
    size: float
    cost_nats: float
    cause: str = "unexplained"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([0.0, 0.0, self.size])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Some widths aside, a factor of 5 in width."""
        return [(-3.0, 3.0), (-1.6, 1.6), _FREE]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Add the bell to the mean."""
        apart = ((data.t_s - self.centre_s) / self.width_s - theta[0]) / exp(theta[1])
        parts.mean += theta[2] * np.exp(-0.5 * apart**2)

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return when it is at its top, how wide it is, and its height."""
        return [
            Parameter("time_s", "s", lambda v: self.centre_s + v[0] * self.width_s, positive=False),
            Parameter("dwell_s", "s", lambda v: self.width_s * exp(v[1])),
            Parameter("amplitude_V", "V", lambda v: v[2] * data.unit_V, positive=False),
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
            Parameter("amplitude_V", "V", lambda v: float(np.ptp(np.append(v, -np.sum(v)))) / 2 * unit, drawn=True),
        ]


@dataclass(frozen=True, slots=True)
class Nonlinearity:
    """y = x + b x^2 about the middle of the readings; free number b in inverse units.

    Of all that a reading is, noise and shocks too, so it is undone before the filter: the density of a reading is that
    of the straight one times the slope. A bend that is met by its slope at the prediction instead leaves out the
    skewness, the drift's part and the noise's, and explains half of what there is.
    """

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

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Straighten the readings before anything else that is undone: they were bent last."""
        bend, inner = float(theta[0]), parts.undo

        def straighten(seen: Seen) -> Seen:
            y, slope = straight(seen.y, bend)
            low, high = (None if ends is None else straight(ends, bend)[0] for ends in (seen.low, seen.high))
            # What is left out has no density, and an interval has a probability; so no slope of one.
            dense = data.used if low is None or high is None else data.used & ~(high > low)
            out = Seen(y, low, high, seen.log_slope + np.where(dense, np.log(slope), 0.0))
            return out if inner is None else inner(out)

        parts.undo = straighten

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return b."""
        unit = data.unit_V
        return [Parameter("coefficient_per_V", "1/V", lambda v: v[0] / unit, positive=False)]


def straight(y: Floats, bend: float) -> tuple[Floats, Floats]:
    """Return x of y = x + b x^2, and dx/dy; from where its slope is _LEAST_SLOPE, the scale goes on evenly.

    Without that, a reading beyond the fold would come from nowhere, and the likelihood would end at the b that folds
    the first of them.

    >>> [round(float(values[0]), 3) for values in straight(np.array([0.24]), 1.0)]
    [0.2, 0.714]
    >>> straight(np.array([-np.inf, np.inf]), 1.0)[0]
    array([-inf,  inf])
    """
    if bend == 0.0:
        return y, np.ones_like(y)
    under = 1 + 4 * bend * y
    root = np.sqrt(np.maximum(under, _LEAST_SLOPE**2))
    x = 2 * np.where(under > _LEAST_SLOPE**2, y, 0.0) / (1 + np.where(np.isinf(root), 1.0, root))  # an end may be open
    edge = ((_LEAST_SLOPE - 1) / (2 * bend), (_LEAST_SLOPE**2 - 1) / (4 * bend))
    return np.where(under > _LEAST_SLOPE**2, x, edge[0] + (y - edge[1]) / _LEAST_SLOPE), 1 / root
