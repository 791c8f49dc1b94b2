"""Shocks: a compound Poisson process in continuous time, each a jump that decays exponentially."""

from dataclasses import dataclass
from math import exp, expm1
from typing import Literal

import numpy as np
from numba import njit
from numpy.random import Generator
from numpy.typing import NDArray

from aemd.model.term import NonNegative, Positive, Role, Times, Volts

__all__ = ["Shocks"]

_BLOCK = 64
"""Shocks drawn at a time. A fixed number, so that the draws do not depend on how the stream is asked for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shocks:
    """Jumps at random instants with Gaussian amplitudes, each decaying as exp(-t/decay); none before t = 0."""

    term: Literal["shocks"] = "shocks"
    role: Role = "external"
    rate_per_s: Positive
    """Mean number per second, 1/s."""
    sd_V: Positive
    """Standard deviation of the amplitude, V."""
    decay_s: NonNegative = 0.0
    """Time constant of the decay, s. At 0 a shock has no shape: it adds its amplitude to the mean of the one aperture
    that it falls in, and nothing where it falls between two."""

    def realise(self, rng: Generator) -> "ShocksRealisation":
        """Return a history that begins at t = 0 without a shock."""
        return ShocksRealisation(self, rng)


class ShocksRealisation:
    """Carries the decaying sum of past shocks from aperture to aperture, and those drawn but not yet due."""

    def __init__(self, shocks: Shocks, rng: Generator) -> None:
        self._shocks = shocks
        self._rng = rng
        self._level_V, self._at_s = 0.0, 0.0
        self._time_s, self._amplitude_V = np.empty(0), np.empty(0)
        self._drawn_to_s = 0.0

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return the mean over each aperture, V, shape (n,)."""
        means = np.empty(start_s.size)
        if start_s.size:
            self._draw_past(float(start_s[-1]) + aperture_s)
        self._level_V, self._at_s, due = _step(
            self._level_V,
            self._at_s,
            self._time_s,
            self._amplitude_V,
            np.ascontiguousarray(start_s, dtype=np.float64),
            aperture_s,
            self._shocks.decay_s,
            means,
        )
        self._time_s, self._amplitude_V = self._time_s[due:], self._amplitude_V[due:]
        return means

    def _draw_past(self, end_s: float) -> None:
        times, amplitudes = [self._time_s], [self._amplitude_V]
        while self._drawn_to_s <= end_s:
            times.append(self._drawn_to_s + np.cumsum(self._rng.exponential(1 / self._shocks.rate_per_s, _BLOCK)))
            amplitudes.append(self._rng.normal(0.0, self._shocks.sd_V, _BLOCK))
            self._drawn_to_s = float(times[-1][-1])
        if len(times) > 1:
            self._time_s, self._amplitude_V = np.concatenate(times), np.concatenate(amplitudes)


@njit(cache=True)
def _step(
    level: float,
    at: float,
    time: NDArray[np.float64],
    amplitude: NDArray[np.float64],
    start: NDArray[np.float64],
    aperture: float,
    decay: float,
    means: NDArray[np.float64],
) -> tuple[float, float, int]:
    """Fill `means`; return the decaying level, the instant it belongs to, and how many shocks are in it.

    A pulse of amplitude A at T contributes A decay (1 - exp(-(end - T)/decay)) to the integral of the aperture that it
    falls in; what went before contributes level decay (1 - exp(-aperture/decay)).
    """
    due = 0
    for k in range(start.size):
        begin, end = start[k], start[k] + aperture
        while time[due] < begin:
            if decay > 0.0:
                level = level * exp(-(time[due] - at) / decay) + amplitude[due]
                at = time[due]
            due += 1
        integral = 0.0
        if decay > 0.0:
            level *= exp(-(begin - at) / decay)
            at = begin
            integral = -level * decay * expm1(-aperture / decay)
        inside = due
        while time[inside] < end:
            if decay > 0.0:
                integral -= amplitude[inside] * decay * expm1(-(end - time[inside]) / decay)
            else:
                integral += amplitude[inside] * aperture
            inside += 1
        means[k] = integral / aperture
    return level, at, due
