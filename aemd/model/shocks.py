"""Shocks: a compound Poisson process in continuous time, each a jump that decays exponentially, and may ring."""

from dataclasses import dataclass
from math import cos, exp, expm1, pi, sin
from typing import Annotated, Literal

import numpy as np
from annotated_types import Interval
from numba import njit
from numpy.random import Generator
from numpy.typing import NDArray

from aemd.model.term import NonNegative, Positive, Role, Times, Volts

__all__ = ["Shocks"]

_BLOCK = 64
"""Shocks drawn at a time. A fixed number, so that the draws do not depend on how the stream is asked for."""

Share = Annotated[float, Interval(ge=0, le=1)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Shocks:
    """Jumps at random instants with Gaussian amplitudes, each decaying as exp(-t/decay); none before t = 0.

    Its shape may have two more parts: a second decay, and a ring-down A ring_fraction exp(-t/ring_decay) sin(2 pi f t).
    Its law may prefer one sign, and may let after-shocks of the same amplitudes follow each shock.
    """

    term: Literal["shocks"] = "shocks"
    role: Role = "external"
    rate_per_s: Positive
    """Mean number per second, without after-shocks, 1/s."""
    sd_V: Positive
    """Standard deviation of the amplitude, V."""
    decay_s: NonNegative = 0.0
    """Time constant of the decay, s. At 0 a shock has no shape: it adds its amplitude to the mean of the one aperture
    that it falls in, and nothing where it falls between two."""
    second_fraction: Share = 0.0
    """Of the amplitude, what decays with the second time constant."""
    second_decay_s: Positive = 1.0
    """s."""
    ring_fraction: NonNegative = 0.0
    """Amplitude of the ring-down, in amplitudes of the shock."""
    ring_hz: Positive = 1.0
    """Hz."""
    ring_decay_s: Positive = 1.0
    """s."""
    positive_fraction: Share = 0.5
    """Of the shocks, those that are positive."""
    after_shocks: NonNegative = 0.0
    """Mean number of after-shocks of a shock; they have none of their own."""
    after_s: Positive = 1.0
    """Mean time of an after-shock after its shock, s."""

    def realise(self, rng: Generator) -> "ShocksRealisation":
        """Return a history that begins at t = 0 without a shock."""
        return ShocksRealisation(self, rng)


class ShocksRealisation:
    """Carries the decaying sums of past shocks from aperture to aperture, and those drawn but not yet due."""

    def __init__(self, shocks: Shocks, rng: Generator) -> None:
        self._shocks = shocks
        self._rng = rng
        self._tails = [_Tail(1 - shocks.second_fraction, shocks.decay_s)]
        if shocks.second_fraction > 0:
            self._tails.append(_Tail(shocks.second_fraction, shocks.second_decay_s))
        self._ring = _Ring(shocks) if shocks.ring_fraction > 0 else None
        self._time_s, self._amplitude_V = np.empty(0), np.empty(0)
        self._drawn_to_s = 0.0

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return the mean over each aperture, V, shape (n,)."""
        means = np.zeros(start_s.size)
        if not start_s.size:
            return means
        start_s = np.ascontiguousarray(start_s, dtype=np.float64)
        self._draw_past(float(start_s[-1]) + aperture_s)
        for tail in self._tails:
            means += tail.average(self._time_s, self._amplitude_V, start_s, aperture_s)
        if self._ring is not None:
            means += self._ring.average(self._time_s, self._amplitude_V, start_s, aperture_s)
        due = np.searchsorted(self._time_s, start_s[-1])
        self._time_s, self._amplitude_V = self._time_s[due:], self._amplitude_V[due:]
        return means

    def _draw_past(self, end_s: float) -> None:
        """Draw until no shock before `end_s` is unknown: an after-shock is never before its shock."""
        while self._drawn_to_s <= end_s:
            times = self._drawn_to_s + np.cumsum(self._rng.exponential(1 / self._shocks.rate_per_s, _BLOCK))
            self._drawn_to_s = float(times[-1])
            if self._shocks.after_shocks > 0:
                after = np.repeat(times, self._rng.poisson(self._shocks.after_shocks, _BLOCK))
                times = np.concatenate((times, after + self._rng.exponential(self._shocks.after_s, after.size)))
            amplitudes = self._rng.normal(0.0, self._shocks.sd_V, times.size)
            if self._shocks.positive_fraction != 0.5:  # at which the normal law has the signs already
                positive = self._rng.random(times.size) < self._shocks.positive_fraction
                amplitudes = np.where(positive, np.abs(amplitudes), -np.abs(amplitudes))
            times = np.concatenate((self._time_s, times))
            order = np.argsort(times, kind="stable")
            self._time_s = times[order]
            self._amplitude_V = np.concatenate((self._amplitude_V, amplitudes))[order]


class _Tail:
    """A share of each shock that decays exponentially."""

    def __init__(self, share: float, decay_s: float) -> None:
        self._share, self._decay_s = share, decay_s
        self._level_V, self._at_s = 0.0, 0.0

    def average(self, time_s: Times, amplitude_V: Volts, start_s: Times, aperture_s: float) -> Volts:
        means = np.empty(start_s.size)
        self._level_V, self._at_s = _step(
            self._level_V, self._at_s, time_s, amplitude_V, start_s, aperture_s, self._decay_s, means
        )
        return np.asarray(self._share * means)


class _Ring:
    """The ring-down of all shocks: the imaginary part of a sum of complex exponentials."""

    def __init__(self, shocks: Shocks) -> None:
        self._fraction = shocks.ring_fraction
        self._rate = complex(-1 / shocks.ring_decay_s, 2 * pi * shocks.ring_hz)
        self._level, self._at_s = 0j, 0.0

    def average(self, time_s: Times, amplitude_V: Volts, start_s: Times, aperture_s: float) -> Volts:
        means = np.empty(start_s.size)
        self._level, self._at_s = _ring(
            self._level, self._at_s, time_s, amplitude_V, start_s, aperture_s, self._rate, means
        )
        return np.asarray(self._fraction * means)


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
) -> tuple[float, float]:
    """Fill `means`; return the decaying level, and the instant it belongs to.

    A pulse of amplitude A at T contributes A decay (1 - exp(-(end - T)/decay)) to the integral of the aperture that it
    falls in; what went before contributes level decay (1 - exp(-aperture/decay)).
    """
    due = 0
    for k in range(start.size):
        begin, end = start[k], start[k] + aperture
        while due < time.size and time[due] < begin:
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
        while inside < time.size and time[inside] < end:
            if decay > 0.0:
                integral -= amplitude[inside] * decay * expm1(-(end - time[inside]) / decay)
            else:
                integral += amplitude[inside] * aperture
            inside += 1
        means[k] = integral / aperture
    return level, at


@njit(cache=True)
def _turned(rate: complex, time: float) -> complex:
    """Return the integral of e^(rate t) from 0 to `time`, (e^(rate time) - 1)/rate, without cancellation."""
    a, b = rate.real * time, rate.imag * time
    return complex(expm1(a) * cos(b) - 2 * sin(b / 2) ** 2, exp(a) * sin(b)) / rate


@njit(cache=True)
def _ring(
    level: complex,
    at: float,
    time: NDArray[np.float64],
    amplitude: NDArray[np.float64],
    start: NDArray[np.float64],
    aperture: float,
    rate: complex,
    means: NDArray[np.float64],
) -> tuple[complex, float]:
    """Fill `means` as `_step` does, with a complex rate in place of -1/decay."""
    due = 0
    for k in range(start.size):
        begin, end = start[k], start[k] + aperture
        while due < time.size and time[due] < begin:
            level = level * np.exp(rate * (time[due] - at)) + amplitude[due]
            at = time[due]
            due += 1
        level *= np.exp(rate * (begin - at))
        at = begin
        integral = level * _turned(rate, aperture)
        inside = due
        while inside < time.size and time[inside] < end:
            integral += amplitude[inside] * _turned(rate, end - time[inside])
            inside += 1
        means[k] = integral.imag / aperture
    return level, at
