"""Courses of the noise in time that are in no catalogue, rivals of those that are."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, pi

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.hypothesis import Bounds, Data, Parameter, Parts

__all__ = ["BreathingNoise"]

Floats = NDArray[np.float64]

_TURNS_LEFT = 0.5
"""In the record, that the number of them may be off: half the stride in which they are tried, and as much again, the
95 % of sqrt(1.5/D)/pi, the deviation of a wave's turns that D = 10 nats tell."""


@dataclass(frozen=True, slots=True)
class BreathingNoise:
    """White noise whose variance swells and fades evenly, exp(a cos + b sin); no mechanism of the catalogue.

    Free numbers: a and b. How often is that of the largest wave in the residuals' squares.
    """

    turns: float
    """In the record."""
    cosine: float
    sine: float
    cost_nats: float
    cause: str = "unexplained"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([self.cosine, self.sine])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Up to some hundred times the variance."""
        return [(-5.0, 5.0), (-5.0, 5.0)]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Scale the white noise along the wave."""
        angle = 2 * pi * self.turns * data.t_s / data.span_s
        louder = np.exp(theta[0] * np.cos(angle) + theta[1] * np.sin(angle))
        parts.noise_var = parts.averaged + (parts.noise_var - parts.averaged) * louder

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the time from swell to swell, and the ratio of deviations from the loudest to the mean."""
        period_s = data.span_s / self.turns
        ends = data.span_s / (self.turns + _TURNS_LEFT), data.span_s / max(self.turns - _TURNS_LEFT, _TURNS_LEFT / 2)
        return [
            Parameter("period_s", "s", lambda _: period_s, ends=ends),
            Parameter("ratio", "", lambda v: float(np.exp(hypot(v[0], v[1]) / 2))),
        ]
