"""A line whose frequency sweeps: the residuals, unwound by each of some sweeps, show it as a line that stands still."""

from math import log

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft, next_fast_len

from aemd.diagnose.checks.spectrum import regress, still_line
from aemd.diagnose.evidence import Evidence, exceedance_of_peaks
from aemd.diagnose.fit import Fit
from aemd.diagnose.terms.lines import Sines, WanderingLine, amplitude_cost

__all__ = ["check_wandering_line"]

Floats = NDArray[np.float64]

_DENSE = 63.0
_SWEEPS = np.concatenate((np.arange(3.0, _DENSE, 2.0), np.arange(_DENSE + 2, 193.0, 4.0)))
"""Frequencies of the record that the line crosses. Half a step off, what is unwound keeps 95 % of its power where the
steps are 2 and 80 % where they are 4 (Fresnel's integral); less than the first is a line to the search for lines."""
_BETWEEN = np.arange(-2.0, 3.0)
"""About the best of those that are 4 apart, to climb from where the power is."""


def check_wandering_line(fit: Fit) -> Evidence:
    """Look for the strongest line that sweeps up or down.

    Unwinding multiplies independent numbers by phases, so the power at each frequency stays exponential; the sweeps
    are counted as so many independent searches (Baluev's law for each), which is on the safe side.
    """
    data = fit.data
    even = np.zeros(int(data.slot[-1]) + 1)
    even[data.slot[data.used]] = fit.z[data.used]
    t_s = (np.arange(even.size) - (even.size - 1) / 2) * data.interval_s
    span_s = even.size * data.interval_s
    length = next_fast_len(2 * even.size)
    frequency = np.fft.fftfreq(length, data.interval_s)

    def best_of(sweeps: Floats) -> tuple[float, float, float, float]:
        """Return the highest power with its frequency, chirp and sweep; up at positive frequencies, down at others."""
        best = 0.0, 0.0, 0.0, 0.0
        for sweep in sweeps:
            chirp = float(sweep) / span_s**2
            power = np.abs(fft(even * np.exp(-1j * np.pi * chirp * t_s**2), length)) ** 2 / data.n
            crossed = chirp * span_s / 2 + 3 / span_s
            power[(np.abs(frequency) < crossed) | (np.abs(frequency) > 0.5 / data.interval_s - crossed)] = 0.0
            at = int(np.argmax(power))
            if power[at] > best[0]:
                hz = float(frequency[at])
                best = float(power[at]), abs(hz), float(np.copysign(chirp, hz)), float(sweep)
        return best

    power_at, at_hz, chirp_at, sweep_at = best_of(_SWEEPS)
    cells = even.size / 2
    searches = 2 * _SWEEPS.size * cells
    p_value = exceedance_of_peaks(power_at, searches)
    terms: tuple[Sines | WanderingLine, ...] = ()
    if p_value < 0.05:
        if sweep_at > _DENSE:
            _, at_hz, chirp_at, _ = best_of(sweep_at + _BETWEEN)
        middle_s = data.t_s - data.span_s / 2
        angle = 2 * np.pi * (at_hz + chirp_at * middle_s / 2) * middle_s
        (a, b), _ = regress(fit, [np.cos(angle), np.sin(angle)])
        cost = amplitude_cost(2, data.n) + log(searches)
        wandering = WanderingLine(at_hz, chirp_at, chirp_at * data.span_s**2, (float(a), float(b)), cost)
        # A strong line that stands still shows here, too, and need not be the one that the search for lines names.
        terms = (wandering, still_line(fit, at_hz, 2 / data.span_s))
    return Evidence(
        check="strongest sweeping line in the residuals, in units of the spectrum's mean",
        p_value=p_value,
        observed=power_at,
        low=log(searches) - log(-log(0.025)) - 2,
        high=log(searches) + 0.5 * log(log(searches) + 4) - log(-log(0.975)),
        terms=terms,
    )
