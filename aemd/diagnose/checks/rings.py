"""What rings after the shocks: damped waves, in proportion to each."""

from math import log, pi

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import expit
from scipy.stats import chi2

from aemd.diagnose.checks.spectrum import regress
from aemd.diagnose.climb import assemble
from aemd.diagnose.evidence import Evidence, bonferroni
from aemd.diagnose.fit import Fit
from aemd.diagnose.terms.events import RingDown, rung
from aemd.diagnose.terms.lines import amplitude_cost

__all__ = ["check_ring_down", "likely_marks"]

Floats = NDArray[np.float64]

_DECAYS = 5
"""That are tried, from four readings on."""
_RINGS = 3
"""Decays whose best wave begins a fit."""
_LOWEST_TURNS = 1.0
"""Turns within a decay from which what follows a shock is a wave and no second decay."""


def check_ring_down(fit: Fit) -> list[Evidence]:
    """Look for damped waves set off by the shocks, over their frequencies and decays.

    What is laid under the residuals after a reading is known from that reading's own odds of a shock, so its
    correlation with them is a sum whose terms the past decides: its two quadratures, over their own deviations, have
    chi-square's law.
    """
    struck = likely_marks(fit)
    if struck is None or not struck.any():
        return []
    data = fit.data
    weight = np.where(data.used, 1 / np.sqrt(fit.variance), 0.0)
    decays = np.geomspace(4 * data.interval_s, min(100 * data.interval_s, data.span_s / 10), _DECAYS)
    found = []
    for decay in decays:
        for frequency in np.arange(_LOWEST_TURNS / decay, 0.5 / data.interval_s, 1 / (4 * decay)):
            power = _ring_power(struck, data.step_s, weight, fit.z, float(frequency), float(decay))
            if power >= 0:  # there are readings after the shocks
                found.append((power, float(frequency), float(decay)))
    if not found:
        return []
    trials, power = float(len(found)), max(found)[0]
    p_value = bonferroni(float(chi2.sf(power, 2)), trials)
    terms: tuple[RingDown, ...] = ()
    if p_value < 0.05:
        cost = amplitude_cost(2, data.n) + log(trials)
        # A wave that fades too fast for its grid looks best at another frequency: each decay's best is a start.
        best = sorted(max(one for one in found if one[2] == decay) for decay in {one[2] for one in found})
        terms = tuple(_ring(fit, struck, frequency, decay, cost) for _, frequency, decay in best[: -_RINGS - 1 : -1])
    return [
        Evidence(
            check="damped waves after the shocks: chi-square of two degrees",
            p_value=p_value,
            observed=power,
            low=float(chi2.isf(0.975 ** (1 / trials) if trials > 1 else 0.975, 2)),
            high=float(chi2.isf(0.025 / trials, 2)),
            terms=terms,
        )
    ]


def likely_marks(fit: Fit) -> Floats | None:
    """Return by how much each reading moves the shocks' state on average, shape (n,); None where the model has none.

    Each reading's own odds of being struck, times what it would then have been struck by: most marks are too small to
    be sure of, and together say as much as the few large ones. Known from the reading and those before it.
    """
    rate_per_s, jump_var, at_state = assemble(fit.terms, fit.theta, fit.data)[1].shocks[:3]
    if at_state < 0:
        return None
    struck_var = fit.variance + jump_var
    jump = -np.expm1(-rate_per_s * fit.data.step_s)
    odds = np.log(jump) - np.log1p(-jump) + 0.5 * np.log(fit.variance / struck_var)
    odds += 0.5 * fit.innovation**2 * (1 / fit.variance - 1 / struck_var)
    return np.asarray(np.where(fit.data.used, expit(odds) * jump_var / struck_var * fit.innovation, 0.0))


def _ring(fit: Fit, struck: Floats, frequency_hz: float, decay_s: float, cost: float) -> RingDown:
    wave = rung(struck, fit.data.step_s, frequency_hz, decay_s)
    (a, b), _ = regress(fit, [np.ascontiguousarray(wave.real), np.ascontiguousarray(wave.imag)])
    return RingDown(struck, frequency_hz, decay_s, (float(a), float(b)), cost)


@njit(cache=True)
def _ring_power(
    struck: Floats, step_s: Floats, weight: Floats, z: Floats, frequency_hz: float, decay_s: float
) -> float:
    """Return the chi-square of the wave of `rung` in the residuals, both quadratures; -1 where there is none."""
    level, last_step, turn = 0j, -1.0, 0j
    cc, cs, ss, zc, zs = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(struck.size):
        if step_s[k] != last_step:
            last_step = step_s[k]
            turn = np.exp(complex(-1 / decay_s, 2 * pi * frequency_hz) * last_step)
        level *= turn
        c, s = level.real * weight[k], level.imag * weight[k]
        cc, cs, ss = cc + c * c, cs + c * s, ss + s * s
        zc, zs = zc + c * z[k], zs + s * z[k]
        level += struck[k]
    ridge = 1e-9 * (cc + ss)
    cc, ss = cc + ridge, ss + ridge
    left = cc * ss - cs * cs
    return (ss * zc * zc - 2 * cs * zc * zs + cc * zs * zs) / left if left > 0 else -1.0
