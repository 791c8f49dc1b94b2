"""From the terminals to a number: the aperture's mean of the input, the meter's own noise, range and overload."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from aemd.model import GaussMarkov, Truth
from sim34410.noise import LIMITS_V, RANGES_V, noise_sd
from sim34410.settings import Settings

__all__ = ["OVERLOAD_V", "Conversions", "Converter", "Input"]

OVERLOAD_V = 9.9e37
"""What the meter answers beyond its range, with the sign of the input."""

OFFSET = GaussMarkov.from_sd(sd_V=5e-6, tau_s=3600.0)
"""Wandering of the meter's own offset, which autozero removes. Its size is a choice; the manuals give none."""


class Input(Protocol):
    """What is connected to the terminals; a ModelRealisation is one."""

    def average(self, start_s: NDArray[np.float64], aperture_s: float) -> Truth:
        """Return the means over each aperture [start, start + aperture), asked forward in time only."""


@dataclass(frozen=True, slots=True)
class Conversions:
    """Readings and what they were made of."""

    value_V: NDArray[np.float64]
    """Readings, shape (n,), V; +-OVERLOAD_V beyond the range."""
    truth: Truth
    """The input's means over the apertures."""
    range_V: float
    """Range of the last of them."""


class Converter:
    """The analogue half of a meter."""

    def __init__(self, source: Input, seed: int, *, noise: bool) -> None:
        """Take the input; without `noise` the meter adds nothing of its own."""
        noise_seed, offset_seed = np.random.SeedSequence(seed, spawn_key=(34410,)).spawn(2)
        self._source = source
        self._noise = noise
        self._noise_rng = np.random.default_rng(noise_seed)
        self._offset = OFFSET.realise(np.random.default_rng(offset_seed))
        self._zero_V: float | None = None
        nothing = np.empty(0)  # compiles the kernels now, so that the first reading does not wait for it
        self._source.average(nothing, 1.0)
        self._offset.average(nothing, 1.0)

    def take_zero(self) -> None:
        """Measure the offset with the next reading and subtract it from then on, as long as autozero is off."""
        self._zero_V = None

    def convert(
        self, begin_s: NDArray[np.float64], aperture_s: float, cycles: float, settings: Settings
    ) -> Conversions:
        """Return the readings whose apertures begin at `begin_s`, s, shape (n,), n >= 1, and last `aperture_s`.

        With autorange each reading is in the smallest range that holds it; the real meter's hysteresis and the time
        that a change of range takes are not simulated.
        """
        truth = self._source.average(begin_s, aperture_s)
        value_V = truth.total
        if settings.autorange:
            row = np.searchsorted(LIMITS_V[:-1], np.abs(value_V))
        else:
            row = np.asarray(RANGES_V.index(settings.range_V))
        if self._noise:
            sd_V = np.take(noise_sd(cycles, autozero=settings.autozero), row)
            value_V = value_V + sd_V * self._noise_rng.standard_normal(value_V.size)
            if not settings.autozero:
                value_V += self._offset_left(begin_s, aperture_s)
        beyond = np.abs(value_V) > np.take(LIMITS_V, row)
        if beyond.any():
            value_V = np.where(beyond, np.copysign(OVERLOAD_V, value_V), value_V)
        return Conversions(value_V, truth, RANGES_V[int(row.flat[-1])])

    def _offset_left(self, begin_s: NDArray[np.float64], aperture_s: float) -> NDArray[np.float64]:
        offset_V = self._offset.average(begin_s, aperture_s)
        if self._zero_V is None:
            self._zero_V = float(offset_V[0])
        return offset_V - self._zero_V
