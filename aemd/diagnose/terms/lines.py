"""Sinusoids: at a frequency of their own, those of the mains, folded by the sampling, and one that sweeps."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, log

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.hypothesis import Bounds, Data, Parameter, Parts

__all__ = ["Sines", "WanderingLine", "amplitude_cost", "fold"]

Floats = NDArray[np.float64]


def fold(frequency_hz: float, rate_hz: float) -> float:
    """Return where a frequency shows after sampling.

    >>> fold(50.0, 15.0)
    5.0
    """
    return abs(frequency_hz - rate_hz * round(frequency_hz / rate_hz))


_REMEMBERED = 4
_SHORT = 100_000
"""Readings up to which waves are remembered: six harmonics of so many take 10 MB."""
_recent: dict[tuple[float, tuple[int, ...], int], tuple[Floats, NDArray[np.complex128]]] = {}


def _waves(frequency_hz: float, harmonics: tuple[int, ...], t_s: Floats) -> NDArray[np.complex128]:
    """Return e^(2 pi i h f t) for each harmonic, shape (harmonics, n).

    The last few are remembered: a fit asks again and again with only its other numbers changed. The instants are kept
    beside them, so that their address stays theirs.
    """
    key = frequency_hz, harmonics, id(t_s)
    if key in _recent:
        return _recent[key][1]
    waves: NDArray[np.complex128] = np.exp(np.outer(2j * np.pi * frequency_hz * np.array(harmonics), t_s))
    if t_s.size <= _SHORT:
        while len(_recent) >= _REMEMBERED:
            del _recent[next(iter(_recent))]
        _recent[key] = t_s, waves
    return waves


@dataclass(frozen=True, slots=True)
class Sines:
    """Sum over h of a_h cos(2 pi h f t) + b_h sin(2 pi h f t).

    Free numbers: (f - f0) T, then a_h and b_h of each harmonic.
    """

    cause: str
    frequency_hz: float
    """f0, where the fit begins: for the mains the true frequency, not its alias."""
    reach: float
    """Bound of (f - f0) T."""
    harmonics: tuple[int, ...]
    amplitudes: tuple[float, ...]
    """Starts, a and b of each harmonic in turn."""
    cost_nats: float
    """What the freedom of this term is worth; see naming."""

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([0.0, *self.amplitudes])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Of the frequency; amplitudes are free."""
        return [(-self.reach, self.reach)] + [(-1e9, 1e9)] * (2 * len(self.harmonics))

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Put the sum into the mean."""
        waves = _waves(float(self.frequency_hz + theta[0] / data.span_s), self.harmonics, data.t_s)
        for number in range(len(self.harmonics)):
            parts.mean += theta[1 + 2 * number] * waves[number].real + theta[2 + 2 * number] * waves[number].imag

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return frequency, alias where it is one, and peak amplitudes, as the readings show them."""
        rate, span, unit = 1 / data.interval_s, data.span_s, data.unit_V

        def frequency(v: Floats) -> float:
            return float(self.frequency_hz + v[0] / span)

        first = self.harmonics[0]
        shown = (
            [
                Parameter("mains_hz", "Hz", frequency),
                Parameter("alias_hz", "Hz", lambda v: fold(first * frequency(v), rate)),
            ]
            if self.cause == "mains_alias"
            else [Parameter("frequency_hz", "Hz", frequency)]
        )
        # Positive, but made of numbers that are even about their values: its interval is too, and not its logarithm's.
        shown.append(Parameter("amplitude_V", "V", lambda v: hypot(v[1], v[2]) * unit, positive=False))
        for number, harmonic in enumerate(self.harmonics[1:], start=1):
            shown.append(
                Parameter(
                    f"amplitude_{harmonic}_V",
                    "V",
                    lambda v, at=1 + 2 * number: hypot(v[at], v[at + 1]) * unit,  # type: ignore[misc] # binds the loop's
                    positive=False,
                )
            )
        return shown


_STILL = 1.0
"""Frequencies of the record below which what is crossed cannot be told from none."""


@dataclass(frozen=True, slots=True)
class WanderingLine:
    """a cos(phase) + b sin(phase) of a frequency that sweeps evenly; times count from the middle of the record.

    Free numbers: (f - f0) T, (chirp - chirp0) T^2, a, b.
    """

    frequency_hz: float
    """f0, in the middle of the record."""
    chirp_hz_per_s: float
    swept: float
    """chirp0 T^2: frequencies of the record that it crosses."""
    amplitudes: tuple[float, float]
    cost_nats: float
    cause: str = "wandering_line"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([0.0, 0.0, *self.amplitudes])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Of frequency and sweep, some steps of the search, without standing still; amplitudes are free."""
        still = _STILL - abs(self.swept)
        sweep = (max(-4.0, still), 4.0) if self.swept > 0 else (-4.0, min(4.0, -still))
        return [(-2.0, 2.0), sweep, (-1e9, 1e9), (-1e9, 1e9)]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Put the wave into the mean."""
        frequency, chirp = self._law(theta, data)
        t_s = data.t_s - data.span_s / 2
        angle = 2 * np.pi * (frequency + chirp * t_s / 2) * t_s
        parts.mean += theta[2] * np.cos(angle) + theta[3] * np.sin(angle)

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the frequency at the first reading, its change, and the peak amplitude."""
        unit, half_s = data.unit_V, data.span_s / 2

        def first(v: Floats) -> float:
            frequency, chirp = self._law(v, data)
            return frequency - chirp * half_s

        return [
            Parameter("frequency_hz", "Hz", first),
            Parameter("chirp_hz_per_s", "Hz/s", lambda v: self._law(v, data)[1], positive=False),
            Parameter("amplitude_V", "V", lambda v: hypot(v[2], v[3]) * unit, positive=False),
        ]

    def _law(self, theta: Floats, data: Data) -> tuple[float, float]:
        """Return the frequency in the middle, Hz, and its change, Hz/s."""
        span_s = data.span_s
        return float(self.frequency_hz + theta[0] / span_s), float(self.chirp_hz_per_s + theta[1] / span_s**2)


def amplitude_cost(count: int, n: int) -> float:
    """Return the nats of `count` free amplitudes: a prior as wide as one reading's information allows."""
    return 0.5 * count * log(max(n, 2))
