"""Narrow lines in the whitened residuals, and what could have made them.

z is white if the model is right, so |sum z e^{-i w t}|^2 / n is exponential at each frequency, and its maximum over the
band has Baluev's law. The amplitude and phase of the effect follow from a regression of z on the whitened cosine and
sine: the filter's response does not have to be known in closed form.
"""

from dataclasses import dataclass, replace
from math import log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.evidence import Evidence, exceedance_of_peaks
from aemd.diagnose.fit import Fit
from aemd.diagnose.hypothesis import Data
from aemd.diagnose.terms.lines import Sines, amplitude_cost, fold

__all__ = ["Periodogram", "check_lines", "make_periodogram", "still_line"]

Floats = NDArray[np.float64]

_PADDING = 4
_MAINS_HZ = (50.0, 60.0)
_WANDER_HZ = 0.05
"""Half width within which a grid keeps its frequency; the continental grids keep to 0.05 Hz but for seconds a year."""
_HARMONICS = (1, 2, 3, 4, 5, 6, 7)
"""Sought wherever they fold to; those of a free line, too."""
_HIGHEST = 20
"""Of the mains, where the readings are fast enough to follow it unfolded."""
_MOST_AT_ONCE = 8
"""Harmonics of one comb; each brings two free numbers."""
_HARMONIC_PRIOR = {1: 0.7, 2: 0.15, 3: 0.1} | dict.fromkeys(range(4, 8), 0.01) | dict.fromkeys(range(8, 21), 0.0008)
"""Odds that a mains line, seen alone, is that harmonic: the fundamental by stray coupling, the second by rectification,
the third by saturated iron. A judgement, stated."""


@dataclass(frozen=True, slots=True)
class Periodogram:
    """Of z, zero where a reading is missing; exponential with mean 1 at each frequency if the model is right."""

    frequency_hz: Floats
    power: Floats
    cells: float
    """Band times effective span: about the number of independent frequencies."""

    def near(self, frequency_hz: float, width_hz: float) -> tuple[float, float]:
        """Return frequency and power of the highest point within a width."""
        step = self.frequency_hz[1]
        low = max(int(np.floor((frequency_hz - width_hz) / step)), 0)
        high = min(int(np.ceil((frequency_hz + width_hz) / step)) + 1, self.power.size)
        if low >= high:
            return frequency_hz, 0.0
        at = low + int(np.argmax(self.power[low:high]))
        return float(self.frequency_hz[at]), float(self.power[at])


def make_periodogram(fit: Fit) -> Periodogram:
    """Return the zero-padded periodogram of the residuals on the grid."""
    data = fit.data
    even = np.zeros(int(data.slot[-1]) + 1)
    even[data.slot[data.used]] = fit.z[data.used]
    length = 1 << int(np.ceil(np.log2(_PADDING * even.size)))
    power = np.abs(np.fft.rfft(even, length)) ** 2 / data.n
    power[0] = 0.0
    power[-1] /= 2  # real there: chi-square of one degree
    rate = 1 / data.interval_s
    return Periodogram(
        frequency_hz=np.asarray(np.fft.rfftfreq(length, data.interval_s), np.float64),
        power=power,
        cells=rate / 2 * even.size / rate * sqrt(pi / 3),
    )


def check_lines(fit: Fit, periodogram: Periodogram, line_frequency_hz: float | None) -> Evidence:
    """Look for the strongest line."""
    at = int(np.argmax(periodogram.power))
    peak, frequency = float(periodogram.power[at]), float(periodogram.frequency_hz[at])
    p_value = exceedance_of_peaks(peak, periodogram.cells)
    terms = []
    if p_value < 0.1:
        frequency = _refine(fit, frequency)
        terms = [_free_line(fit, frequency, periodogram)]
        mains = _mains(fit, frequency, line_frequency_hz)
        if mains is not None:
            terms.append(mains)
    return Evidence(
        check="strongest line in the residuals' spectrum, in units of its mean",
        p_value=p_value,
        observed=peak,
        low=log(periodogram.cells) - log(-log(0.025)),
        high=log(periodogram.cells) + 0.5 * log(log(periodogram.cells) + 4) - log(-log(0.975)),
        terms=tuple(terms),
    )


def regress(fit: Fit, shapes: list[Floats]) -> tuple[Floats, float]:
    """Return the amplitudes of shapes that best explain z, and half the sum of squares they take, nats."""
    left = np.column_stack([fit.whitened(shape) for shape in shapes])
    amplitudes, *_ = np.linalg.lstsq(left, fit.z, rcond=None)
    return np.asarray(amplitudes, np.float64), float(0.5 * np.sum((left @ amplitudes) ** 2))


def _wave(data: Data, frequency_hz: float) -> list[Floats]:
    angle = 2 * np.pi * frequency_hz * data.t_s
    return [np.cos(angle), np.sin(angle)]


def _refine(fit: Fit, frequency_hz: float) -> float:
    """Return the top of the parabola through three points of the periodogram a quarter of a cell apart."""
    apart = 0.25 / fit.data.span_s
    turn = np.exp(-2j * np.pi * frequency_hz * fit.data.t_s) * fit.z
    spin = np.exp(-2j * np.pi * apart * fit.data.t_s)
    low, middle, high = (float(abs(np.sum(turn * spin**k)) ** 2) for k in (-1, 0, 1))
    bend = low - 2 * middle + high
    shift = 0.5 * (low - high) / bend if bend < 0 else 0.0
    # Nearer to the ends of the band one of the two amplitudes shows nothing, and what the other does is a pattern.
    end = 1 / fit.data.span_s
    return float(np.clip(frequency_hz + np.clip(shift, -1, 1) * apart, end, 0.5 / fit.data.interval_s - end))


def still_line(fit: Fit, near_hz: float, width_hz: float) -> Sines:
    """Return the strongest line near a frequency."""
    periodogram = make_periodogram(fit)
    return _free_line(fit, _refine(fit, periodogram.near(near_hz, width_hz)[0]), periodogram)


def _free_line(fit: Fit, frequency_hz: float, periodogram: Periodogram) -> Sines:
    data = fit.data
    harmonics = [1]
    for harmonic in _HARMONICS[1:]:
        if harmonic * frequency_hz < 0.5 / data.interval_s:
            _, power = periodogram.near(harmonic * frequency_hz, 0.5 * harmonic / data.span_s)
            if power > _joins(data, harmonic):
                harmonics.append(harmonic)
    from_end = min(frequency_hz, 0.5 / data.interval_s - frequency_hz) * data.span_s
    reach = min(1.5, from_end - 0.5)
    return _sines(fit, "periodic_interference", frequency_hz, reach, harmonics, log(periodogram.cells))


def _joins(data: Data, times: float) -> float:
    """Return the power, in nats, from which a harmonic is worth the two amplitudes that it brings.

    Args:
        data: the readings.
        times: its frequency over that of the line that is known: as many places it may be at.
    """
    return amplitude_cost(2, data.n) + log(max(times, 1.0))


def _mains(fit: Fit, frequency_hz: float, line_frequency_hz: float | None) -> Sines | None:
    """Return the mains whose folded harmonics explain the line best, if one can."""
    data, rate = fit.data, 1 / fit.data.interval_s
    best: tuple[float, Sines] | None = None
    grids = _MAINS_HZ if line_frequency_hz is None else (line_frequency_hz,)
    for grid in grids:
        harmonics = range(1, min(max(int(0.5 * rate / grid), _HARMONICS[-1]), _HIGHEST) + 1)
        for harmonic in harmonics:
            side = grid * harmonic - rate * round(grid * harmonic / rate)
            width = _WANDER_HZ * harmonic + 1 / data.span_s
            if abs(abs(side) - frequency_hz) > width:
                continue
            # The frequency that folds exactly there, and its other harmonics that stand out as well.
            true = (rate * round(grid * harmonic / rate) + np.copysign(frequency_hz, side)) / harmonic
            present = {harmonic: np.inf}
            beside = _without(fit, harmonic * true)
            for other in harmonics:
                near, times = fold(other * true, rate), other / harmonic
                if other == harmonic or near < 2 / data.span_s:
                    continue
                if any(abs(near - fold(h * true, rate)) < 2 / data.span_s for h in present):
                    continue
                _, power = beside.near(near, 0.5 * max(times, 1.0) / data.span_s)
                if power > _joins(data, times):
                    present[other] = power
            loudest = sorted(present, key=lambda h: -present[h])[:_MOST_AT_ONCE]
            worth = sum(present[h] - _joins(data, h / harmonic) for h in loudest[1:])
            cells = 2 * _WANDER_HZ * data.span_s + 1
            cost = log(cells) + log(len(grids)) - log(_HARMONIC_PRIOR[harmonic])
            if best is None or worth - cost > best[0]:
                order = [harmonic, *sorted(loudest[1:])]
                best = worth - cost, _sines(fit, "mains_alias", true, 1.5 / harmonic, order, cost)
    return None if best is None else best[1]


def _without(fit: Fit, frequency_hz: float) -> Periodogram:
    """Return the periodogram beside a line: the sides of a strong one pass for harmonics that fold next to it."""
    waves = np.column_stack([fit.whitened(wave) for wave in _wave(fit.data, frequency_hz)])
    left = fit.z - waves @ np.linalg.lstsq(waves, fit.z, rcond=None)[0]
    return make_periodogram(replace(fit, z=left))


def _sines(
    fit: Fit, cause: str, frequency_hz: float, reach: float, harmonics: list[int], frequency_cost: float
) -> Sines:
    shapes = [shape for harmonic in harmonics for shape in _wave(fit.data, harmonic * frequency_hz)]
    amplitudes, _ = regress(fit, shapes)
    return Sines(
        cause=cause,
        frequency_hz=frequency_hz,
        reach=reach,
        harmonics=tuple(harmonics),
        amplitudes=tuple(float(a) for a in amplitudes),
        cost_nats=frequency_cost + amplitude_cost(2 * len(harmonics), fit.data.n),
    )
