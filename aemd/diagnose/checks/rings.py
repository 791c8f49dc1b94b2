"""What rings after the shocks: damped waves, in proportion to each.

Where within an interval a shock came nobody knows, and by then a fast wave has turned by as much as half a turn. So two
statistics are taken: a wave of one angle after all shocks, small ones as well, and waves whose angles go with instants
that are integrated out, after the loudest.
"""

from dataclasses import dataclass
from math import exp, log, pi, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import expit, logsumexp
from scipy.stats import chi2

from aemd.diagnose.checks.gains import LONG, gain_of
from aemd.diagnose.checks.spectrum import regress
from aemd.diagnose.climb import assemble
from aemd.diagnose.evidence import Evidence, bonferroni
from aemd.diagnose.fit import Fit
from aemd.diagnose.kernels import whiten
from aemd.diagnose.terms.events import RingDown, rung
from aemd.diagnose.terms.lines import amplitude_cost

__all__ = ["check_ring_down", "likely_marks"]

Floats = NDArray[np.float64]

_DECAYS = 5
"""That are tried, from four readings on."""
_RINGS = 3
"""Decays whose best wave begins a fit."""
_WAYS, _FREEDOM = 3, 4
"""Statistics of one p-value; and degrees of chi-square for twice the gain: two quadratures, and the two numbers of the
shocks that may have had nothing else to do than to follow them, their decay and their size."""
_LOWEST_TURNS = 1.0
"""Turns within a decay from which what follows a shock is a wave and no second decay."""
_LEAST_ODDS, _MOST_SHOCKS = 0.15, 40
"""Probability of a shock at a reading from which it is followed, and how many are, the loudest."""
_INSTANTS = 6
"""Of an interval: three for each turn of the fastest wave."""
_FOLLOWED = 4.0
"""Decays over which a wave is followed; the next shock ends it sooner."""
_RATIOS = np.geomspace(0.02, 2.0, 10)
"""Of the ring to the shock, on either side of none; two of them are so near that one between loses 6 % of its nats."""
_APART_S = 1e12
"""Between stretches that are whitened in one go: after so long nothing of one is left in the next."""


@dataclass(frozen=True, slots=True)
class _Loud:
    """Shocks that are followed, each until the next; shapes (s,), and (s, instants)."""

    at: NDArray[np.int64]
    """The reading after it."""
    until: NDArray[np.int64]
    probability: Floats
    before_s: Floats
    """By which the shock came before that reading."""
    amplitude: Floats
    """At that instant."""
    weight: Floats
    """Of the instants, in logarithms."""


def check_ring_down(fit: Fit) -> list[Evidence]:
    """Look for damped waves set off by the shocks, over their frequencies and decays.

    What is laid under the residuals after a reading is known from that reading's own odds of a shock, so its
    correlation with them is a sum whose terms the past decides: its two quadratures, over their own deviations, have
    chi-square's law. The likelihood ratio of waves whose numbers and instants are integrated out has a mean of one, so
    it exceeds x with a probability of at most 1/x (Ville 1939). And a ring may have been taken for slower shocks: where
    there is any sign of one, what it gains once all is fitted again is looked at. The best counts, as one of three.
    """
    struck = likely_marks(fit)
    if struck is None or not struck.any():
        return []
    data = fit.data
    weight = np.where(data.used, 1 / np.sqrt(fit.variance), 0.0)
    decays = np.geomspace(4 * data.interval_s, min(100 * data.interval_s, data.span_s / 10), _DECAYS)
    found, ratios = [], list[tuple[float, float, float]]()
    loud = _loud(fit)
    for decay in decays:
        frequencies = np.arange(_LOWEST_TURNS / decay, 0.5 / data.interval_s, 1 / (4 * decay))
        if loud is not None and frequencies.size:
            each = _log_ratios(fit, loud, frequencies, float(decay))
            ratios += [(float(one), float(hz), float(decay)) for one, hz in zip(each, frequencies, strict=True)]
        for frequency in frequencies:
            power = _ring_power(struck, data.step_s, weight, fit.z, float(frequency), float(decay))
            if power >= 0:  # there are readings after the shocks
                found.append((power, float(frequency), float(decay)))
    if not found:
        return []
    trials, power = float(len(found)), max(found)[0]
    p_value = bonferroni(float(chi2.sf(power, 2)), trials)
    nats = float(logsumexp([one[0] for one in ratios])) - log(len(ratios)) if ratios else 0.0
    p_value = min(1.0, _WAYS * min(p_value, exp(-min(max(nats, 0.0), 650.0))))
    terms: tuple[RingDown, ...] = ()
    if p_value < 0.05:
        cost = amplitude_cost(2, data.n) + log(trials)
        # A wave that fades too fast for its grid looks best at another frequency: each decay's best is a start.
        best = sorted(max(one for one in found if one[2] == decay) for decay in {one[2] for one in found})
        starts = best[: -_RINGS - 1 : -1] + ([max(ratios)] if nats > 0 else [])
        terms = tuple(_ring(fit, struck, frequency, decay, cost) for _, frequency, decay in starts)
        if data.n <= LONG:
            gain, _ = gain_of(fit, [(term, np.append(fit.theta, term.start)) for term in terms])
            p_value = min(p_value, _WAYS * bonferroni(float(chi2.sf(2 * max(gain, 0.0), _FREEDOM)), trials))
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


def _loud(fit: Fit) -> _Loud | None:
    """Return the shocks that are loud enough to be followed each; None where there is none.

    A shock within an aperture shows in that reading in part and in the next one in full: then it is the next that it is
    followed from. The earlier it came, the larger it was, and the less likely.
    """
    _, parts, arguments = assemble(fit.terms, fit.theta, fit.data)
    states = arguments[3]
    rate_per_s, jump_var, at_state = parts.shocks[:3]
    if at_state < 0 or parts.telegraph is not None:
        return None
    data, size = fit.data, fit.data.y.size
    decay_s, aperture_s = float(states[int(at_state), 1]), data.aperture_s
    struck_var = fit.variance + jump_var
    jump = -np.expm1(-rate_per_s * data.step_s)
    odds = np.log(jump) - np.log1p(-jump) + 0.5 * np.log(fit.variance / struck_var)
    odds += 0.5 * fit.innovation**2 * (1 / fit.variance - 1 / struck_var)
    probability = np.where(data.used, expit(odds), 0.0)
    mark = jump_var / struck_var * fit.innovation
    likely = probability > _LEAST_ODDS
    first = likely & ~np.concatenate(([False], likely[:-1]))
    at = np.flatnonzero(first)
    paired = (at + 2 < size) & likely[np.minimum(at + 1, size - 1)]
    paired &= mark[at] * mark[np.minimum(at + 1, size - 1)] > 0
    begin = at + paired
    heard = begin + 1 < size
    at, paired, begin = at[heard], paired[heard], begin[heard]
    if not at.size:
        return None
    until = np.append(begin[1:] + 1, size)  # up to and with the next shock's reading: what that shows is its past's
    probability = np.minimum(probability, 1 - 1e-12)
    shown = mark[at] + np.where(paired, mark[begin], 0.0)
    kept = np.sort(np.argsort(-np.abs(probability[at] * shown), kind="stable")[:_MOST_SHOCKS])
    parts_of = (np.arange(_INSTANTS) + 0.5) / _INSTANTS
    before_s = np.where(paired[:, None], data.step_s[begin][:, None] + parts_of * aperture_s, 0.0)
    before_s = np.where(paired[:, None], before_s, parts_of * data.step_s[begin][:, None])
    left = np.exp(-before_s / decay_s)
    amplitude = shown[:, None] / left
    deviation = sqrt(jump_var / max(float(np.mean(left[~paired] ** 2)), 1e-12) if (~paired).any() else jump_var)
    weight = -0.5 * (amplitude / deviation) ** 2 - np.log(left)
    weight -= logsumexp(weight, axis=1)[:, None]
    return _Loud(begin[kept] + 1, until[kept], probability[at][kept], before_s[kept], amplitude[kept], weight[kept])


def _log_ratios(fit: Fit, loud: _Loud, frequencies_hz: Floats, decay_s: float) -> Floats:
    """Return the logarithm of the likelihood ratio of rings of each frequency, mean over ratios and two angles.

    Each shock's wave is whitened by the gains that the filter had there, and ends where the next shock begins; so each
    is known from what came before the readings that it is held against.
    """
    data = fit.data
    ends = np.minimum(np.searchsorted(data.t_s, data.t_s[loud.at - 1] + _FOLLOWED * decay_s), loud.until)
    ends = np.maximum(ends, loud.at + 1)
    places = np.concatenate([np.arange(begin, end) for begin, end in zip(loud.at, ends, strict=True)])
    edges = np.concatenate(([0], np.cumsum(ends - loud.at)[:-1]))
    since_s = data.t_s[places] - np.repeat(data.t_s[loud.at - 1], ends - loud.at)
    step_s = data.step_s[places]
    step_s[edges] = _APART_S
    gains, used = np.ascontiguousarray(fit.gains[places]), data.used[places]
    scale, z = np.where(used, 1 / np.sqrt(fit.variance[places]), 0.0), np.where(used, fit.z[places], 0.0)
    sums = np.empty((frequencies_hz.size, 5, edges.size))
    for at, frequency_hz in enumerate(frequencies_hz):
        wave = np.exp(complex(-1 / decay_s, 2 * pi * frequency_hz) * since_s)
        c, s = (
            scale * whiten(np.ascontiguousarray(one), step_s, fit.states, gains, used) for one in (wave.real, wave.imag)
        )
        sums[at] = np.add.reduceat(np.array([c * z, s * z, c * c, c * s, s * s]), edges, axis=1)
    turn = (-1 / decay_s + 2j * pi * frequencies_hz)[:, None, None]
    start = loud.amplitude * np.exp(turn * loud.before_s)
    zc, zs, cc, cs, ss = (sums[:, one, :, None] for one in range(5))
    tries = []
    for began in (start, 1j * start):  # what rings as a sine, and as a cosine
        along = began.real * zs + began.imag * zc
        energy = began.real**2 * ss + 2 * began.real * began.imag * cs + began.imag**2 * cc
        for ratio in (*_RATIOS, *-_RATIOS):
            each = logsumexp(loud.weight + ratio * along - 0.5 * ratio**2 * energy, axis=2)
            tries.append(np.logaddexp(np.log1p(-loud.probability), np.log(loud.probability) + each).sum(axis=1))
    return np.asarray(logsumexp(np.array(tries), axis=0) - log(len(tries)))
