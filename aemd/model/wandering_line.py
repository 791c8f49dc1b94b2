"""A line whose frequency sweeps and wanders: a motor, or the mains seen for hours."""

from dataclasses import dataclass
from math import pi
from typing import Literal

import numpy as np
from numpy.random import Generator

from aemd.model.term import Finite, NonNegative, Positive, Role, Times, Volts

__all__ = ["WanderingLine"]

_STEP_S = 0.1
"""Between changes of the wandering frequency. Shorter costs and shows nothing: a line that wanders so fast that its
phase turns within a tenth of a second is a broad band, not a line."""
_BLOCK = 1024  # changes drawn at a time; fixed, so that the draws do not depend on how the stream is asked for


@dataclass(frozen=True, slots=True, kw_only=True)
class WanderingLine:
    """A sin(phase) of the frequency f + chirp t + wander W(t), with a Wiener process W that is held over 0.1 s."""

    term: Literal["wandering_line"] = "wandering_line"
    role: Role = "external"
    amplitude_V: NonNegative
    """Peak, V."""
    frequency_hz: Positive
    """At t = 0, Hz."""
    chirp_hz_per_s: Finite = 0.0
    """Hz/s."""
    wander_hz_per_rt_s: NonNegative = 0.0
    """Rms change of the frequency over a second, Hz/sqrt(s)."""
    phase_rad: Finite = 0.0
    """At t = 0, rad."""

    def realise(self, rng: Generator) -> "WanderingLineRealisation":
        """Return a history that draws from `rng`."""
        return WanderingLineRealisation(self, rng)


class WanderingLineRealisation:
    """Knows the phase at the changes of frequency, from the last that it was asked about on."""

    def __init__(self, line: WanderingLine, rng: Generator) -> None:
        self._line = line
        self._rng = rng
        self._at_s = np.zeros(1)
        self._wandered_rad = np.zeros(1)  # phase due to the wander alone
        self._offset_hz = 0.0  # of the frequency after the last change

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return A sin(phase at the middle) sinc(f T): exact but for a change of frequency within the aperture T."""
        if not start_s.size:
            return np.empty(0)
        line, middle_s = self._line, start_s + aperture_s / 2
        self._draw_past(float(middle_s[-1]))
        wandered_rad = np.interp(middle_s, self._at_s, self._wandered_rad)
        frequency_hz = line.frequency_hz + line.chirp_hz_per_s * middle_s
        phase_rad = 2 * pi * (line.frequency_hz + line.chirp_hz_per_s * middle_s / 2) * middle_s
        self._forget_before(float(middle_s[-1]))
        means = np.sinc(frequency_hz * aperture_s) * np.sin(phase_rad + wandered_rad + line.phase_rad)
        return np.asarray(line.amplitude_V * means)

    def _draw_past(self, end_s: float) -> None:
        while self._at_s[-1] <= end_s:
            changes_hz = self._line.wander_hz_per_rt_s * _STEP_S**0.5 * self._rng.standard_normal(_BLOCK)
            offsets_hz = np.cumsum(np.concatenate(([self._offset_hz], changes_hz)))
            turned_rad = np.cumsum(np.concatenate((self._wandered_rad[-1:], 2 * pi * _STEP_S * offsets_hz[:-1])))
            number = round(self._at_s[-1] / _STEP_S) + np.arange(1, _BLOCK + 1)
            self._at_s = np.concatenate((self._at_s, number * _STEP_S))
            self._wandered_rad = np.concatenate((self._wandered_rad, turned_rad[1:]))
            self._offset_hz = float(offsets_hz[-1])

    def _forget_before(self, time_s: float) -> None:
        first = max(int(np.searchsorted(self._at_s, time_s, side="right")) - 1, 0)
        self._at_s, self._wandered_rad = self._at_s[first:], self._wandered_rad[first:]
