"""Whether the extended model fits, whatever it is called: what a name asks beside being the best of the catalogue.

If it does, its residuals z are independent and standard normal at every time. Held against that are free forms of what
a name may leave: the variance of z, and the products of z with what came before it, over memories from one reading to
some dozen, each with a course in time that is a free sum of cosines. A shape of its own in the mean shows in the
products, a noise of its own in the variance, a spectrum of its own that comes and goes in both. Their constant parts
are the fit's and left out.

A failure is no finding: it says that a name which stands is only the nearest.
"""

from collections.abc import Sequence
from math import exp

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import chi2

from aemd.diagnose.evidence import Evidence, exceedance_of_peaks
from aemd.diagnose.fit import Fit
from aemd.diagnose.hypothesis import Term
from aemd.diagnose.terms.events import PeriodicGlitch
from aemd.diagnose.terms.lines import Sines
from aemd.diagnose.terms.noise import Resonance

__all__ = ["FITS", "check_steadiness", "course", "leaves_a_line", "leaves_a_wave", "share_a_period", "why_unfit"]

Floats = NDArray[np.float64]

FITS = 0.01
"""p of either test of the whole fit, counted over its parts, below which a name is not sure. A right name is doubted
in at most two of a hundred records, and in fewer, since the parts are alike."""
_MEMORIES = (1, 4, 16, 64)
"""Readings; the weight of what came before falls by e over so many."""
_COSINES = (3, 12)
"""How many make up a course in time: what swells over the whole record, and what lasts a twelfth of it."""
_LEAST = 20
"""Readings for each of them."""
_HARMONICS = 6
_BAND = 1.5
"""Half widths of a resonance at half its power that are its band."""


def why_unfit(fit: Fit, evidence: Sequence[Evidence]) -> str:
    """Return what speaks against a fit, the checks' best or the steadiness of its residuals; empty where neither does.

    Args:
        fit: base and terms.
        evidence: of every check on its residuals.
    """
    best = min(evidence, key=lambda item: item.p_value, default=None)
    if best is not None and best.p_value * len(evidence) <= FITS:
        return f"{best.check.split(':')[0].split(', in ')[0]} is still {_say_p(best.p_value * len(evidence))}"
    p_value = check_steadiness(fit).p_value
    if p_value <= FITS:
        return f"what the model leaves is not the same all along the record, {_say_p(p_value)}"
    return ""


def _say_p(p_value: float) -> str:
    return f"p = {max(p_value, 1e-300):.1g}"


def check_steadiness(fit: Fit) -> Evidence:
    """Test that variance and correlation of the residuals stay the same along the record.

    With weights that the readings before decide, sums of z m are normal with the sum of m^2 for a variance, whatever m
    is; so shocks, which make m large for a while, do no harm.
    """
    used = fit.data.used
    z = np.where(used, fit.z, 0.0)
    counted = np.ones(fit.data.n)
    series = [((z[used] ** 2 - 1) / np.sqrt(2), counted)]
    for memory in _MEMORIES:
        kept = 1 - 1 / memory
        past = np.concatenate(([0.0], lfilter([1.0], [1.0, -kept], z)[:-1]))[used]
        series.append((z[used] * past, past**2))
    tries = [
        (course(values, weights, count), count)
        for values, weights in series
        for count in _COSINES
        if count * _LEAST <= fit.data.n
    ]
    if not tries:
        return Evidence("steadiness of the residuals, chi-square per degree", 1.0, 1.0, 0.0, 3.0)
    (statistic, p_value), count = min(tries, key=lambda item: item[0][1])
    return Evidence(
        check="steadiness of the residuals of the extended model, chi-square per degree",
        p_value=min(1.0, p_value * len(tries)),
        observed=statistic / count,
        low=0.0,
        high=float(chi2.isf(0.05 / len(tries), count)) / count,
    )


def course(values: Floats, weights: Floats, count: int) -> tuple[float, float]:
    """Return chi-square of `count` cosines in time, of values with these variances, and its p; their mean is free."""
    turn = np.pi * (np.arange(values.size) + 0.5) / values.size
    waves = np.cos(np.outer(np.arange(1, count + 1), turn))
    waves -= (waves @ weights / max(float(weights.sum()), 1e-300))[:, None]
    sums = waves @ values
    statistic = float(sums @ np.linalg.pinv((waves * weights) @ waves.T, hermitian=True) @ sums)
    return statistic, float(chi2.sf(statistic, count))


def share_a_period(fit: Fit, number: int) -> bool:
    """Return whether a term comes again with another one of the fit, as parts of one wave of some other form do.

    Pulses and a line on their period or a part of it, to what the record can tell. Two trains of one period are the
    edges of pulses that last longer than those that are sought.
    """
    mine = _rate_hz(fit, number)
    if mine is None:
        return False
    for other in range(1, len(fit.terms)):
        theirs = _rate_hz(fit, other)
        kinds = isinstance(fit.terms[number], PeriodicGlitch), isinstance(fit.terms[other], PeriodicGlitch)
        if other == number or theirs is None or kinds[0] == kinds[1]:
            continue
        slow, fast = min(mine, theirs), max(mine, theirs)
        times = round(fast / slow)
        if times <= _HARMONICS and abs(fast - times * slow) < 1 / fit.data.span_s:
            return True
    return False


def leaves_a_wave(fit: Fit, number: int) -> bool:
    """Return whether a train of pulses leaves a wave of its own period, of any form: its first harmonics are free.

    The residuals' power at frequencies that were not sought is exponential, their sum chi-square of two degrees each.
    """
    term = fit.terms[number]
    if not isinstance(term, PeriodicGlitch):
        return False
    used = fit.data.used
    turns = np.outer(np.arange(1, _HARMONICS + 1), fit.data.t_s[used] / term.period_s)
    power = np.abs(np.exp(2j * np.pi * turns) @ fit.z[used]) ** 2 / fit.data.n
    return float(chi2.sf(2 * float(power.sum()), 2 * _HARMONICS)) < FITS


def leaves_a_line(fit: Fit, number: int) -> bool:
    """Return whether a line stands in a resonance's band still: some lines beside each other pass for a resonance.

    It follows them as they beat, and gains by that, but it whitens the band as a whole; the lines stay in it.
    """
    term = fit.terms[number]
    if not isinstance(term, Resonance):
        return False
    theta, data = fit.parts_of(number), fit.data
    tau_s, span_s = exp(float(theta[0])), data.span_s
    centre_hz, half_hz = term.frequency_hz + theta[1] / term.tau_s, max(_BAND / (np.pi * tau_s), 4 / span_s)
    band = np.abs(np.fft.rfftfreq(data.y.size, data.interval_s) - centre_hz) < half_hz
    power = np.abs(np.fft.rfft(np.where(data.used, fit.z, 0.0))) ** 2 / data.n
    return bool(band.any()) and exceedance_of_peaks(float(power[band].max()), 2 * half_hz * span_s) < FITS


def _rate_hz(fit: Fit, number: int) -> float | None:
    """Return how often a term comes again, where it does."""
    term: Term = fit.terms[number]
    if isinstance(term, PeriodicGlitch):
        return 1 / term.period_s
    if isinstance(term, Sines):
        return float(term.harmonics[0] * (term.frequency_hz + fit.parts_of(number)[0] / fit.data.span_s))
    return None
