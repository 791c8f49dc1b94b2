"""Effects that come and go: pulses at even times, a level that jumps between two levels, and what follows a shock."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, hypot, log, pi

import numpy as np
from numba import njit
from numpy.typing import NDArray

from aemd.diagnose.hypothesis import Bounds, Data, Parameter, Parts

__all__ = ["PeriodicGlitch", "Popcorn", "RingDown", "ShockLaw", "rung"]

Floats = NDArray[np.float64]

_FREE: Bounds = (-1e9, 1e9)


@dataclass(frozen=True, slots=True)
class PeriodicGlitch:
    """A rectangular pulse at begin + m period; free number its size.

    The instants are those that the folding found, and their intervals are a scan's: the likelihood is flat between
    those at which a pulse's edge passes a reading.
    """

    period_s: float
    begin_s: float
    width_s: float
    size: float
    cost_nats: float
    cause: str = "periodic_glitch"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([self.size])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Free."""
        return [_FREE]

    def shape(self, data: Data) -> Floats:
        """Return where the pulses are, shape (n,)."""
        return np.asarray((data.t_s - self.begin_s) % self.period_s < self.width_s, np.float64)

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Put the pulses into the mean."""
        parts.mean += theta[0] * self.shape(data)

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return period, first pulse, length and height."""
        unit = data.unit_V
        return [
            Parameter("period_s", "s", lambda _: self.period_s),
            Parameter("period_readings", "", lambda _: self.period_s / data.interval_s),
            Parameter("time_s", "s", lambda _: self.begin_s % self.period_s),
            Parameter("dwell_s", "s", lambda _: self.width_s),
            Parameter("amplitude_V", "V", lambda v: v[0] * unit, positive=False),
        ]


@dataclass(frozen=True, slots=True)
class Popcorn:
    """A level that jumps between 0 and a step at random; free numbers log step, log of the mean stay at each, s.

    In the base it replaces the shocks, which would imitate its jumps one by one.
    """

    step: float
    low_s: float
    high_s: float
    cost_nats: float
    beside: tuple[float, ...] = ()
    """Free numbers of all other terms where the check found most: those without the level have its jumps as shocks."""
    cause: str = "popcorn_noise"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([log(self.step), log(self.low_s), log(self.high_s)])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """A factor of 30 about where the check found most."""
        return [(log(value / 30), log(value * 30)) for value in (self.step, self.low_s, self.high_s)]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:  # noqa: ARG002 - a Term's
        """Let the filter follow the two levels."""
        parts.telegraph = np.exp(theta)

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the step, the mean stay, and the part of the time at the upper level."""
        unit = data.unit_V
        return [
            Parameter("step_V", "V", lambda v: exp(v[0]) * unit),
            Parameter("dwell_s", "s", lambda v: (exp(v[1]) + exp(v[2])) / 2),
            Parameter("fraction", "", lambda v: exp(v[2]) / (exp(v[1]) + exp(v[2])), limits=(0.0, 1.0)),
        ]


@njit(cache=True)
def rung(marks: Floats, step_s: Floats, frequency_hz: float, decay_s: float) -> NDArray[np.complex128]:
    """Return the sum of the damped complex waves that marks set off, from the reading after each on, shape (n,)."""
    out = np.empty(marks.size, np.complex128)
    level, turn, last_step = 0j, 1 + 0j, 0.0
    for k in range(marks.size):
        if step_s[k] != last_step:
            last_step = step_s[k]
            turn = np.exp(complex(-1 / decay_s, 2 * pi * frequency_hz) * last_step)
        level *= turn
        out[k] = level
        level += marks[k]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class RingDown:
    """A damped wave after each shock, in proportion to it; free numbers log decay_s, (f - f0) decay0, a, b.

    A shock's size is known from its own reading, so what follows is predicted and not fitted to itself.
    """

    marks: Floats
    """Size of the shock at each reading, 0 where there is none, shape (n,)."""
    frequency_hz: float
    decay_s: float
    amplitudes: tuple[float, float]
    """Of the cosine and the sine, in sizes of the shock."""
    cost_nats: float
    cause: str = "ring_down"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([log(self.decay_s), 0.0, *self.amplitudes])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """A factor of 5 of the decay, a width in frequency, and at most what would ring louder than it was struck."""
        return [(log(self.decay_s / 5), log(self.decay_s * 5)), (-1.0, 1.0), (-2.0, 2.0), (-2.0, 2.0)]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Put the waves into the mean."""
        wave = rung(self.marks[: data.y.size], data.step_s, self._frequency(theta), exp(theta[0]))
        parts.mean += theta[2] * wave.real + theta[3] * wave.imag

    def parameters(self, data: Data) -> Sequence[Parameter]:  # noqa: ARG002 - a Term's
        """Return frequency, decay, and the wave's first amplitude over the shock's."""
        return [
            Parameter("frequency_hz", "Hz", self._frequency),
            Parameter("decay_s", "s", lambda v: exp(v[0])),
            Parameter("ratio", "", lambda v: hypot(v[2], v[3])),
        ]

    def _frequency(self, theta: Floats) -> float:
        return float(self.frequency_hz + theta[1] / self.decay_s)


@dataclass(frozen=True, slots=True)
class ShockLaw:
    """Shocks that prefer one sign; free number the part of the positive ones less that of the negative ones."""

    bias: float
    cost_nats: float
    cause: str = "shock_law"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([self.bias])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """All negative to all positive."""
        return [(-0.9999, 0.9999)]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:  # noqa: ARG002 - a Term's
        """Make a jump of one sign more likely than one of the other."""
        parts.extras[5] = theta[0]

    def parameters(self, data: Data) -> Sequence[Parameter]:  # noqa: ARG002 - a Term's
        """Return the part of the shocks that is positive."""
        return [Parameter("fraction", "", lambda v: 0.5 + v[0] / 2, positive=False, limits=(0.0, 1.0))]
