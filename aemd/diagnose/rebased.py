"""Other fits of a base: tops of its likelihood that are as high as the one that was found, or higher.

A climb ends on the top of the hill it began on. Where the base's two processes have both turned to what is fast, a slow
drift is left over as a finding; where faint shocks never got a hold, tails are. And where one process is hardly there,
its time constant is anything, and directions that the checks take for used up with it. So before a finding is believed
that is not overwhelming, the base is fitted from where such tops are.
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.checks.tails import gain_of_tails
from aemd.diagnose.climb import Climb, race
from aemd.diagnose.fit import Fit, residuals, steps_for
from aemd.diagnose.hypothesis import Base, base_start_with_shocks
from aemd.diagnose.starts import with_drift

__all__ = ["rebased"]

Floats = NDArray[np.float64]

_AS_GOOD = 1.0
"""Nats below the fit's likelihood of a top that readings tell from it by nothing."""
_SAME = 0.02
"""Nats between climbs that ended on one top."""
_SHOCK_GAIN = 6.0
"""Nats that shocks must bring, three numbers more."""
_FAINT = ((0.003, 4.0), (0.01, 2.0), (0.03, 1.5))
"""Shocks a reading, and their deviation in those of the innovation."""
_LONG = 200_000
"""Readings beyond which a climb from so far off would take minutes; of so many, faint shocks are not missed."""
_STEPS = 40
"""From such a start, which is far off, and more than a race on a long record gives."""
_DECAYS = (0.5, 1.0, 3.0, 10.0)
"""Intervals that they take to decay."""


def rebased(fit: Fit, *, tails: bool) -> list[Fit]:
    """Return other fits of the same hypothesis that readings do not prefer that one to, the likeliest first.

    Args:
        fit: base and terms.
        tails: whether what was found may be faint shocks; then those are tried as well, in a base without any. They
            have to explain more than tails do.
    """
    if not isinstance(fit.terms[0], Base):
        return []
    steps = steps_for(fit.data)
    (drifting,) = race([Climb(fit.terms, with_drift(fit.theta, fit.data), fit.data)], steps)
    found = [drifting] if drifting.value > fit.log_likelihood - _AS_GOOD else []
    if tails and len(fit.terms) == 1 and not fit.terms[0].shocks and fit.data.n <= _LONG:
        struck = _best_struck(fit)
        for _ in range(_STEPS):
            if not struck.done:
                struck.step()
        if struck.value > fit.log_likelihood + max(_SHOCK_GAIN, gain_of_tails(fit)[0]):
            found.append(struck)
    found.sort(key=lambda one: -one.value)
    return [residuals(one.terms, one.theta, fit.data) for one in found if abs(one.value - fit.log_likelihood) > _SAME]


def _best_struck(fit: Fit) -> Climb:
    """Return the best start with faint shocks."""
    data, core = fit.data, sqrt(float(np.median(fit.variance[fit.data.used])))
    bases = [
        base_start_with_shocks(data, fit.theta, share / data.interval_s, size * core, decay * data.interval_s)
        for share, size in _FAINT
        for decay in _DECAYS
    ]
    return max((Climb([base], base.start, data) for base in bases), key=lambda one: one.value)
