"""Records drawn from a fit: what a check says of readings that have nothing but what the fit has.

The laws that p-values are taken from hold for an exact likelihood, or for many readings. Beside loud shocks the filter
keeps one Gaussian for many histories, and loses a little at each shock; a short record has not many readings. So where
a finding rests on a p-value that is not overwhelming, its check is run on records that are drawn from the fit, with the
same instants and gaps and witnesses, and fitted anew (a parametric bootstrap). If the law is right, -ln p is
exponential of mean 1 there, or smaller; if it is not, it is about exponential of another mean, as the tails of squares
are whose scale is wrong, and the finding's own -ln p is judged by those that were drawn.
"""

from collections.abc import Callable
from dataclasses import replace
from math import exp, log, log1p

import numpy as np
from numpy.typing import NDArray
from scipy.stats import gamma

from aemd.diagnose.apertures import struck_between
from aemd.diagnose.climb import assemble, climb
from aemd.diagnose.evidence import Evidence
from aemd.diagnose.fit import Fit, residuals, steps_for
from aemd.diagnose.given import Given
from aemd.diagnose.hypothesis import Data, Parts
from aemd.diagnose.kernels import colour, predict
from aemd.diagnose.terms.events import RingDown
from aemd.diagnose.terms.ranges import RangeOffset, RangeSwitching

__all__ = ["Redrawn", "draw", "judged_by"]

Floats = NDArray[np.float64]
Check = Callable[[Fit], list[Evidence]]

_STAGES = (2, 4, 8, 16, 32, 64)
"""Records, after each of which a law that stands is left alone."""
_LEAVE = (0.98, 0.9, 0.5, 0.25, 0.1, 0.05)
"""Probability under a right law of a sum of -ln p beyond which it is not yet, or not at all, left alone. So a right law
is corrected in 2 % of the cases, after 17 draws on average, and is not where -ln p is twice too large in 7 %. A law
that is sure of less than it might be, as that of a level that jumps, is left alone after two or four.
"""
_LONG, _FEWER = 20_000, 32
"""Readings of a record beyond which so many are the most."""
_MOST = 100_000
"""Readings of a record that is drawn; of a longer one the beginning is."""
_WRONG, _NOTHING, _FEWEST = 1e-4, 0.01, 8
"""The same probability at which a law is surely wrong; and p, then, of what is nothing without drawing more, and draws
that say so."""
_BY_READINGS = (RangeOffset, RangeSwitching, RingDown)
"""Terms that are made from the readings themselves, and mean nothing beside others."""
_FADED = 40.0
"""Decays after which nothing of a shock is left."""


class Redrawn:
    """Records drawn from a fit, each fitted anew, as many as were asked for so far."""

    def __init__(self, fit: Fit) -> None:
        """Draw nothing yet."""
        self._fits = list[Fit]()
        self._times = max(fit.data.y.size / _MOST, 1.0)
        """The readings over those drawn; so many times as far is a law off, as it is off a little at each shock."""
        self._fit = fit if self._times == 1 else replace(fit, data=fit.data.first(_MOST))

    def corrected(self, evidence: Evidence, check: Check) -> Evidence:
        """Return the evidence, with the p-value that records drawn from the fit give it where its law is wrong there.

        Args:
            evidence: what was found.
            check: what found it.
        """
        if self._times > 1 and len(self._fit.terms) > 1:  # which know the length of the record
            return evidence
        nominal, p_value = list[float](), evidence.p_value
        for count, leave in zip(_STAGES, _LEAVE, strict=True):
            if count > _FEWER and self._fit.data.n > _LONG:
                break
            while len(nominal) < count:
                again = self._number(len(nominal))
                if again is None:
                    return evidence
                same = (item.p_value for item in check(again) if item.check == evidence.check)
                nominal.append(-log(max(next(same, 1.0), 1e-300)))
            if sum(nominal) < gamma.isf(leave, count):
                return evidence
            as_long = np.maximum(1 + self._times * (np.array(nominal) - 1), 0.0)
            p_value = judged_by(as_long, -log(max(evidence.p_value, 1e-300)))
            if count >= _FEWEST and p_value > _NOTHING and sum(nominal) > gamma.isf(_WRONG, count):
                break
        return replace(evidence, p_value=max(p_value, evidence.p_value))

    def _number(self, at: int) -> Fit | None:
        while len(self._fits) <= at:
            data = draw(self._fit, len(self._fits))
            if data is None:
                return None
            terms = self._fit.terms
            theta, _ = climb(terms, self._fit.theta, data, iterations=steps_for(data))
            self._fits.append(residuals(terms, theta, data))
        return self._fits[at]


def judged_by(drawn: Floats, observed: float) -> float:
    """Return the probability that one more of some exponential numbers exceeds what was observed.

    Their mean being unknown but for them, the ratio of one more to the sum of n has P(> r) = (1 + r)^-n: a few draws
    can reject no more than a few draws may.

    >>> round(1 / judged_by(np.ones(8), 8.0), 6)
    256.0
    """
    total = float(drawn.sum())
    return exp(-drawn.size * log1p(observed / total)) if total > 0 else 0.0


def draw(fit: Fit, number: int) -> Data | None:
    """Return the data with readings drawn from a fit, the same ones for the same number.

    None where the fit has what cannot be drawn here: a stated model, a level that jumps, a scale that is bent, noise or
    ranges that follow the readings, readings known by intervals.

    Args:
        fit: base and terms.
        number: which of the records.
    """
    data = fit.data
    if data.low is not None or isinstance(fit.terms[0], Given):
        return None
    if any(isinstance(term, _BY_READINGS) for term in fit.terms):
        return None
    _, parts, (mean, noise_var, scale, states, _, extras) = assemble(fit.terms, fit.theta, data)
    if parts.telegraph is not None or parts.undo is not None or extras[:2].any():
        return None
    rng = np.random.default_rng([number, 1])
    calm = (mean, noise_var, scale, states, np.array([0.0, 0.0, -1.0]), np.zeros(6))
    _, _, _, variance, gains = predict(np.zeros(data.y.size), np.full(data.y.size, fill_value=True), data.step_s, *calm)
    if not (variance > 0).all():  # apertures that average out more than a term leaves
        return None
    innovation = np.sqrt(variance) * rng.standard_normal(data.y.size)
    jump, struck, within = _shocks(fit, parts, rng)
    y = mean + scale * within + colour(innovation, jump, struck, data.step_s, states, gains, scale)
    for share, added in [(extras[2], extras[3]), *parts.tails]:
        if share > 0:
            y += np.where(rng.random(y.size) < share, np.sqrt(added) * rng.standard_normal(y.size), 0.0)
    y = _smoothed(np.where(data.used, y, 0.0), data, parts.kept)
    return replace(data, y=np.where(data.used, y, 0.0))


def _shocks(fit: Fit, parts: Parts, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Return the shocks' sum at each reading, which states it moves, and what those within an aperture add to it.

    Shocks come at any time: at the next reading some of it is left, and one within an aperture is in a part of it. The
    base counts each as one at a reading, of a size that is normal.
    """
    data, size = fit.data, fit.data.y.size
    per_s, jump_var, state = parts.shocks
    struck, jump, within = np.zeros(len(parts.states)), np.zeros(size), np.zeros(size)
    if state < 0:
        return jump, struck, within
    struck[int(state)] = 1.0
    decay_s, aperture_s = parts.states[int(state)][1], data.aperture_s
    begin_s = -min(_FADED * decay_s, data.span_s)
    count = rng.poisson(per_s * (data.span_s - begin_s))
    at_s = rng.uniform(begin_s, data.span_s, count)
    marks = np.sqrt(jump_var) / struck_between(decay_s, data.interval_s) * np.abs(rng.standard_normal(count))
    marks = np.where(rng.random(count) < 0.5 * (1 + parts.extras[5]), marks, -marks)
    # Of an aperture after the shock the mean of the decay over it is seen; of one that it falls in, the rest of it.
    apart = aperture_s / decay_s
    passed = -np.expm1(-apart) / apart if apart > 0 else 1.0
    after = np.searchsorted(data.t_s, at_s, side="left")
    there = after < size
    left = np.exp(-(data.t_s[after[there]] - at_s[there]) / decay_s)
    np.add.at(jump, after[there], passed * marks[there] * left)
    inside = (after > 0) & (at_s < data.t_s[np.maximum(after - 1, 0)] + aperture_s)
    rest_s = data.t_s[np.maximum(after - 1, 0)] + aperture_s - at_s
    np.add.at(within, after[inside] - 1, marks[inside] * -np.expm1(-rest_s[inside] / decay_s) / max(apart, 1e-300))
    return jump, struck, within


def _smoothed(y: Floats, data: Data, kept: float) -> Floats:
    """Return what a smoothing makes of readings; over a gap it goes on as if each reading had been what the next is."""
    if kept == 0.0:
        return y
    smooth, last = y.copy(), -1
    for at in np.flatnonzero(data.used).tolist():
        if last >= 0:
            share = kept ** max(float(data.slot[at] - data.slot[last]), 1.0)
            smooth[at] = share * smooth[last] + (1 - share) * y[at]
        last = at
    return smooth
