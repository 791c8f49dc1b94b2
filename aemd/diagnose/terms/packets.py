"""A wave that comes once and goes; no mechanism of the catalogue, so where it explains more, a name is refused."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, hypot, pi

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.hypothesis import Bounds, Data, Parameter, Parts

__all__ = ["Packet", "waves"]

Floats = NDArray[np.float64]

_FREE: Bounds = (-1e9, 1e9)


@dataclass(frozen=True, slots=True)
class Packet:
    """A wave under a bell, or one that begins at an instant of its own and fades.

    Free numbers: the logarithm of the width over that to begin with, the frequency's distance from that to begin with
    in turns per width, the amplitudes of cosine and sine; under a bell, its place in widths as well. Where it begins at
    an instant, that is a reading's, and not fitted: the likelihood jumps from one to the next.
    """

    at_s: float
    """Of the bell's top, or the beginning."""
    width_s: float
    """The bell's standard deviation, or the time in which it fades by e."""
    frequency_hz: float
    amplitudes: tuple[float, float]
    begins: bool
    cost_nats: float
    cause: str = "unexplained"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([0.0, 0.0, *self.amplitudes] + ([] if self.begins else [0.0]))

    @property
    def bounds(self) -> Sequence[Bounds]:
        """A factor of 5 in width, a width in frequency, three widths aside."""
        return [(-1.6, 1.6), (-1.0, 1.0), _FREE, _FREE] + ([] if self.begins else [(-3.0, 3.0)])

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Add the wave to the mean."""
        top_s = 0.0 if self.begins else self.width_s * theta[4]
        hz, width_s = self.frequency_hz + theta[1] / self.width_s, self.width_s * exp(theta[0])
        cosine, sine = waves(data.t_s - self.at_s, hz, width_s, begins=self.begins, top_s=top_s)
        parts.mean += theta[2] * cosine + theta[3] * sine

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return when it is, how long it lasts, its frequency and its amplitude."""
        return [
            Parameter(
                "time_s", "s", lambda v: self.at_s + (0.0 if self.begins else self.width_s * v[4]), positive=False
            ),
            Parameter("dwell_s", "s", lambda v: self.width_s * exp(v[0])),
            Parameter("frequency_hz", "Hz", lambda v: self.frequency_hz + v[1] / self.width_s),
            Parameter("amplitude_V", "V", lambda v: hypot(v[2], v[3]) * data.unit_V),
        ]


def waves(
    since_s: Floats, frequency_hz: float, width_s: float, *, begins: bool, top_s: float = 0.0
) -> tuple[Floats, Floats]:
    """Return cosine and sine that come once, each shape (n,).

    Args:
        since_s: times, from the instant at which the cosine has its top, shape (n,).
        frequency_hz: of the wave.
        width_s: the bell's standard deviation, or the time in which what begins fades by e.
        begins: whether it begins at 0 and fades, instead of lying under a bell.
        top_s: when the bell has its top.
    """
    if begins:
        envelope = np.where(since_s > -1e-9, np.exp(-np.maximum(since_s, 0.0) / width_s), 0.0)
    else:
        envelope = np.exp(-0.5 * ((since_s - top_s) / width_s) ** 2)
    angle = 2 * pi * frequency_hz * since_s
    return envelope * np.cos(angle), envelope * np.sin(angle)
