"""A resonance that broad-band vibration keeps ringing: a table, a mount, the proof mass itself."""

from dataclasses import dataclass
from math import pi, sqrt
from typing import Annotated, Literal

import numpy as np
from annotated_types import Interval
from numpy.random import Generator

from aemd.model.linear_process import LinearProcess
from aemd.model.term import Positive, Role, Times, Volts

__all__ = ["Resonance"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Resonance:
    """x'' + w/Q x' + w^2 x = white noise: a harmonic oscillator with damping."""

    term: Literal["resonance"] = "resonance"
    role: Role = "external"
    frequency_hz: Positive
    """w/2 pi, undamped, Hz."""
    quality: Annotated[float, Interval(gt=0.5, lt=1e6)]
    """Q; above 1/2, below which nothing oscillates."""
    sd_V: Positive
    """Stationary standard deviation of x, V."""

    def realise(self, rng: Generator) -> "ResonanceRealisation":
        """Return a history that begins in the stationary law."""
        return ResonanceRealisation(self, rng)


class ResonanceRealisation:
    """A linear process of the state (x, x'/w), whose two components have the same variance."""

    def __init__(self, resonance: Resonance, rng: Generator) -> None:
        w = 2 * pi * resonance.frequency_hz
        damping = w / resonance.quality
        self._process = LinearProcess(
            rng,
            dynamics=np.array([[0.0, w], [-w, -damping]]),
            drive=np.array([0.0, resonance.sd_V * sqrt(2 * damping)]),
            outputs=np.array([[1.0, 0.0]]),
        )

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return the mean over each aperture, V, shape (n,)."""
        return self._process.average(start_s, aperture_s)[:, 0]
