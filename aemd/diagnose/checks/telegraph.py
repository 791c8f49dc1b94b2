"""A level that jumps between two: its likelihood against that of the base, which imitates it with shocks or drift."""

from dataclasses import replace
from math import log

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from aemd.diagnose.evidence import Evidence
from aemd.diagnose.fit import Fit, climb, densities
from aemd.diagnose.hypothesis import Base, Data
from aemd.diagnose.terms.events import Popcorn
from aemd.diagnose.terms.lines import amplitude_cost

__all__ = ["check_popcorn"]

Floats = NDArray[np.float64]

_SIZES = (2.0, 4.0, 7.0)
"""In deviations of the undisturbed innovation."""
_STAYS = (30.0, 100.0, 300.0)
"""Readings."""
_FREEDOM = 9
"""Degrees of chi-square by which twice the gain is judged. Not derived: step and two stays are three numbers, but they
are sought from a grid of starts on a likelihood with several tops, whose law is not known. Nine is an empirical
calibration on clean records of our own making: their gain seldom exceeds 3 nats, and of 40 short ones that shocks
dwarf, one had 13, which is 2e-4 with six degrees and 2e-3 with nine. Further out than that it has not been tried."""
_LONG = 20_000
"""Readings that are judged; of a longer record the first so many, and those only beside the base alone."""
_KEPT_OUT = 0.02
"""Part of the readings that may be kept out: a dead band's leave a hole, which two levels imitate."""
_PROMISING = 2.0
"""Nats behind the base, after some steps, from which a start is given up."""


def check_popcorn(fit: Fit) -> Evidence:
    """Fit the jumping level together with all else, from a grid of starts.

    No score does it: who does not know of the level has fitted its jumps as shocks, or its spectrum as a drift, and
    nothing is left of it in second moments. One such start is therefore a drift that is slow again.
    """
    data, before = _part(fit)
    if data is None:
        return _evidence(0.0, ())
    one = float(np.sqrt(np.median(fit.variance[fit.data.used])))
    starts = []
    for base in _bases(fit):
        for size in _SIZES:
            for stay in _STAYS:
                if stay * data.interval_s < data.span_s / 4:
                    term = Popcorn(size * one, stay * data.interval_s, stay * data.interval_s, 0.0)
                    theta = np.concatenate((base, term.start))
                    starts.append((float(densities([*fit.terms, term], theta, data).sum()), theta, term))
    tried = []
    for _, theta, term in sorted(starts, key=lambda item: -item[0])[:3]:
        found, value = climb([*fit.terms, term], theta, data, iterations=4)
        tried.append((value, found, term))
    if not tried:
        return _evidence(0.0, ())
    value, found, term = max(tried, key=lambda item: item[0])
    if value > before - _PROMISING:
        found, value = climb([*fit.terms, term], found, data, iterations=12)
    gained = value - before
    step, low_s, high_s = np.exp(found[-3:])
    cost = amplitude_cost(3, fit.data.n)
    return _evidence(gained, (Popcorn(float(step), float(low_s), float(high_s), cost, tuple(found[:-3].tolist())),))


def _evidence(gained: float, terms: tuple[Popcorn, ...]) -> Evidence:
    p_value = float(chi2.sf(2 * max(gained, 0.0), _FREEDOM))
    return Evidence(
        check="a level that jumps between two: log-likelihood over the base's, nats",
        p_value=p_value,
        observed=gained,
        low=-1e3,
        high=float(chi2.isf(0.025, _FREEDOM)) / 2,
        terms=terms if p_value < 0.05 else (),
    )


def _part(fit: Fit) -> tuple[Data | None, float]:
    """Return the readings that are judged, and what the model makes of them, nats."""
    if any(isinstance(term, Popcorn) for term in fit.terms):
        return None, 0.0
    if np.count_nonzero(~fit.data.used) > _KEPT_OUT * fit.data.y.size:
        return None, 0.0
    if fit.data.n <= _LONG:
        return fit.data, fit.log_likelihood
    if len(fit.terms) > 1:
        return None, 0.0
    data, part = fit.data, slice(_LONG)
    short = replace(
        data,
        y=data.y[part],
        used=data.used[part],
        step_s=data.step_s[part],
        t_s=data.t_s[part],
        slot=data.slot[part],
        witnesses={name: values[part] for name, values in data.witnesses.items()},
    )
    return short, float(fit.each[part].sum())


def _bases(fit: Fit) -> list[Floats]:
    """Return the free numbers as they are, and with a drift that is slow and small."""
    if not isinstance(fit.terms[0], Base):
        return [fit.theta]
    slow = fit.theta.copy()
    slow[2] = max(slow[2], log(fit.data.span_s / 4))
    slow[3] -= 0.7
    return [fit.theta, slow]
