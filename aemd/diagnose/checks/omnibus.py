"""What a model should have left nothing of, whatever made it: a hump, an echo of any delay, noise of another size.

None of these asks for a mechanism, and where one explains what is seen, its own check says so louder and its term
takes it away. What stays is outside the catalogue, and here it is said where it is and what it looks like.
"""

from math import exp, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve
from scipy.stats import chi2, norm

from aemd.diagnose.checks.shapes import settled_response
from aemd.diagnose.evidence import Evidence, bonferroni, two_sided
from aemd.diagnose.fit import Fit
from aemd.diagnose.goodness import course
from aemd.diagnose.terms.courses import BreathingNoise
from aemd.diagnose.terms.lines import amplitude_cost
from aemd.diagnose.terms.shapes import Hump

__all__ = ["check_course", "check_echo", "check_hump"]

Floats = NDArray[np.float64]

_NARROWEST, _WIDEST, _WIDER = 12.0, 400.0, 1.5
"""Readings of a hump's width, and the ratio of widths that are tried. Narrower ones are shocks of the base."""
_SETTLES = 4_000
"""Readings over which the filter's answer to a hump is followed."""
_DECAYS = (2.0, 5.0, 12.0, 30.0)
"""Readings; a single shock is of the base, but as one alone is not fitted, a hump must be more than one."""
_WORTH_A_LOOK = 0.01
"""p from which look-alikes are taken off and terms are prepared; far above the level of any finding."""
_LAGS = 200
_COSINES = 12
_LIMIT = 9.0
"""Of a squared residual: beyond, it is a matter of tails."""
_MOST_TURNS = 10.0


def check_hump(fit: Fit) -> Evidence:
    """Look for a bell in the mean, at every reading and over widths.

    Scores along the record are a smooth normal process, which crosses a level u upwards sqrt(m) e^{-u^2/2} / 2 pi times
    a reading, where m is the mean square of its slope (Rice 1944). Of what is left when a single shock at the same
    place has taken its part, the least is judged.
    """
    n = fit.data.y.size
    step = settled_response(fit, min(n, _SETTLES))
    best, crossings, alone, width = (0.0, 0, _NARROWEST), list[float](), 0, _NARROWEST
    while width < _WIDEST and 12 * width < n:
        bell = _answer(step, np.exp(-0.5 * (np.arange(-4 * width, 4 * width + 1) / width) ** 2))
        energy = np.cumsum(bell**2)
        scores = fftconvolve(fit.z, bell[::-1])[bell.size - 1 :][:n]
        seen = energy[np.minimum(n - 1 - np.arange(n), bell.size - 1)]
        scores = np.where(seen > 0.5 * energy[-1], scores / np.sqrt(np.maximum(seen, 1e-300)), 0.0)
        at = int(np.argmax(np.abs(scores)))
        best = max(best, (float(abs(scores[at])), at, width))
        crossings.append(n * sqrt(float(np.sum(np.diff(bell, prepend=0.0) ** 2)) / float(energy[-1])) / pi)
        alone, width = alone + 1, width * _WIDER
    score, at, width = best
    p_value = _rice(score, sum(crossings), alone) if alone else 1.0
    terms: tuple[Hump, ...] = ()
    centre = min(at + round(4 * width), n - 1)
    if p_value < _WORTH_A_LOOK:
        score, size = _beyond_a_shock(fit, step, at, width)
        p_value = _rice(score, sum(crossings), alone) if alone else 1.0
        cost = amplitude_cost(1, fit.data.n) + log(n / width) + log(alone)
        terms = (Hump(float(fit.data.t_s[centre]), width * fit.data.interval_s, size, cost),)
    return Evidence(
        check="strongest hump in the residuals: score in deviations",
        p_value=p_value,
        observed=score,
        low=0.0,
        high=sqrt(2 * log(max(sum(crossings), 1.0) / 0.025)),
        terms=terms,
        looks=f"a hump about {float(fit.data.t_s[centre]):.4g} s that is {2 * width * fit.data.interval_s:.3g} s wide "
        "and comes once, most like a step that goes back",
    )


def check_echo(fit: Fit) -> Evidence:
    """Correlate the residuals with those up to 200 readings before, each sum in units of its own squares' root."""
    z = np.zeros(int(fit.data.slot[-1]) + 1)
    z[fit.data.slot[fit.data.used]] = fit.z[fit.data.used]
    lags = np.arange(2, max(min(_LAGS, z.size // 8), 2) + 1)
    length = 1 << int(np.ceil(np.log2(z.size + lags[-1])))
    sums, squares = (np.fft.irfft(np.abs(np.fft.rfft(values, length)) ** 2, length)[lags] for values in (z, z**2))
    scores = sums / np.sqrt(np.maximum(squares, 1e-9))
    at = int(np.argmax(np.abs(scores)))
    late_s = int(lags[at]) * fit.data.interval_s
    return Evidence(
        check="strongest echo in the residuals: score in deviations",
        p_value=bonferroni(two_sided(float(scores[at])), lags.size),
        observed=float(abs(scores[at])),
        low=float(norm.isf(0.5 * (1 - 0.025 ** (1 / lags.size)))),
        high=float(norm.isf(0.0125 / lags.size)),
        looks=f"an echo all along the record: {float(scores[at]) / sqrt(fit.data.n):+.2g} of what was new in a reading "
        f"comes again {late_s:.3g} s later, most like smoothing",
    )


def check_course(fit: Fit) -> Evidence:
    """Test the residuals' squares for any slow course in time, a free sum of cosines.

    What swells and fades some times has no walk that leads far from the even one, so other checks of it miss it.
    """
    used = fit.data.used
    squares = np.minimum(fit.z[used] ** 2, _LIMIT)
    spread = float(squares.std())
    if squares.size < _COSINES * 20 or spread == 0:
        return Evidence("course of the residuals' variance, chi-square per degree", 1.0, 1.0, 0.0, 2.0)
    even = (squares - squares.mean()) / spread
    statistic, p_value = course(even, np.ones(even.size), _COSINES)
    terms: tuple[BreathingNoise, ...] = ()
    looks = ""
    if p_value < _WORTH_A_LOOK:
        t_s = fit.data.t_s[used]
        turns = np.arange(0.5, _MOST_TURNS + 0.25, 0.5)
        waves = np.exp(2j * pi * np.outer(turns, t_s / fit.data.span_s)) @ (squares - squares.mean()) / squares.size
        best = int(np.argmax(np.abs(waves)))
        share = float(np.median(fit.variance[used])) / fit.white**2
        swell = complex(waves[best]) / float(squares.mean()) * share
        swell *= min(1.0, 1.0 / max(abs(swell), 1e-300))
        cost = amplitude_cost(2, fit.data.n) + log(turns.size)
        terms = (BreathingNoise(float(turns[best]), swell.real, swell.imag, cost),)
        loudest_s = (np.angle(waves[best]) / (2 * pi) % 1.0) / turns[best] * fit.data.span_s
        looks = (
            f"noise that swells and fades {turns[best]:.3g} times in the record, first loudest about "
            f"{loudest_s:.3g} s, most like changing noise"
        )
    return Evidence(
        check="course of the residuals' variance: chi-square per degree",
        p_value=p_value,
        observed=statistic / _COSINES,
        low=float(chi2.ppf(0.025, _COSINES)) / _COSINES,
        high=float(chi2.isf(0.025, _COSINES)) / _COSINES,
        terms=terms,
        looks=looks,
    )


def _rice(score: float, crossings: float, alone: int) -> float:
    """Return the bound on the probability that any of so many processes exceeds a score in size."""
    return min(1.0, crossings * exp(-0.5 * min(score, 37.0) ** 2) + alone * two_sided(score))


def _answer(step: Floats, shape: Floats) -> Floats:
    """Return what the filter leaves of a shape, from its answer to a step."""
    return np.asarray(fftconvolve(step, np.diff(shape, prepend=0.0))[: step.size])


def _beyond_a_shock(fit: Fit, step: Floats, at: int, width: float) -> tuple[float, float]:
    """Return the least score that a hump keeps beside one shock, over instants and decays; and the hump's size."""
    z = fit.z[at : at + step.size]
    x = np.arange(-4 * width, 4 * width + 1)
    bell = _answer(step, np.exp(-0.5 * (x / width) ** 2))[: z.size]
    size = float(bell @ bell)
    along = float(bell @ z)
    least = abs(along) / sqrt(size)
    for decay in _DECAYS:
        shock = _answer(step, np.exp(-np.arange(8 * decay + 1) / decay))[: z.size]
        for begin in range(0, min(round(8 * width), z.size - 2), max(round(decay / 3), 1)):
            late = np.concatenate((np.zeros(begin), shock[: z.size - begin]))
            loud, both = float(late @ late), float(late @ bell)
            left = size - both**2 / loud
            if left > 1e-3 * size:
                least = min(least, abs(along - both / loud * float(late @ z)) / sqrt(left))
    return least, along / size
