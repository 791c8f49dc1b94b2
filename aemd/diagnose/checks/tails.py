"""Whether a reading now and then has far more noise than the base knows of: the likelihood with such readings."""

from math import log, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from aemd.diagnose.checks.gains import LONG, gain_of
from aemd.diagnose.checks.shocks import marks_of
from aemd.diagnose.climb import Climb
from aemd.diagnose.fit import Fit, climb
from aemd.diagnose.hypothesis import Base
from aemd.diagnose.terms.lines import amplitude_cost
from aemd.diagnose.terms.noise import HeavyTails

__all__ = ["gain_of_tails", "tail_of_gain"]

Floats = NDArray[np.float64]

_STARTS = ((0.005, 3.0), (0.05, 1.7))
"""Part of the readings, and deviation in those of the innovation."""
_FEWER_LOUDER = ((3.0, 1.4), (10.0, 2.0))
"""Times less often, and times as large, that shocks are where tails have to be given back what shocks took."""
_DECAYS = tuple(0.3 * 1.6**k for k in range(2, 10))
"""Intervals that those shocks take to decay."""
_AMONG = (0.02, 2.5)
"""Part of the readings, and deviation, of tails beside them."""
_WORTH_A_CLIMB, _FEW_STEPS = 6.0, 6
"""Nats from which the base is fitted without the tails again from where it has come to, and steps of that."""
_FREEDOM = 2
"""Degrees of chi-square for twice the gain: how often, and how large. Tails end at none, so that is more than their
share: 1 of 165 clean records came to p < 0.05 by it. Shocks that turn to other readings beside tails, which the base
had never needed, are no third number, as what they gain without the tails is taken off.
"""

_MERGED = 0.03
"""Nats a shock that tails gain on a record without them. The filter merges what each shock leaves open (its instant
within the interval, a second one after it) into one normal number; on 60,000 clean readings with some 500 loud shocks
that came to 0.02 to 0.033 a shock."""


def gain_of_tails(fit: Fit) -> tuple[float, HeavyTails | None]:
    """Return the log-likelihood that tails add to a fit, all else fitted again, and the tails; 0 where there are some.

    What loud shocks alone would have lent them is taken off.

    The fourth moment of the residuals does not do alone: shocks that fade within a reading are fitted to tails, and
    what they leave is nearly normal.
    """
    if fit.data.n > LONG or any(isinstance(term, HeavyTails) for term in fit.terms):
        return 0.0, None
    core = sqrt(float(np.median(fit.variance[fit.data.used])))
    cost = amplitude_cost(2, fit.data.n)
    begun = [HeavyTails(share, ratio * core, cost) for share, ratio in _STARTS]
    starts = [(tails, np.concatenate((fit.theta, tails.start))) for tails in begun]
    among = HeavyTails(_AMONG[0], _AMONG[1] * core, cost)
    gain, theta = gain_of(fit, [*starts, *((among, start) for start in _among_louder_shocks(fit, among))])
    if gain > _WORTH_A_CLIMB:  # what a base gains that came to another top by this way is not the tails'
        gain -= max(climb(fit.terms, theta[:-2], fit.data, _FEW_STEPS)[1] - fit.log_likelihood, 0.0)
    share, sd = np.exp(theta[-2:])
    marks = marks_of(fit)
    lent = _MERGED * marks.at.size if marks is not None else 0.0
    return gain - lent, HeavyTails(float(share), float(sd), cost, tuple(theta[:-2].tolist()))


def _among_louder_shocks(fit: Fit, tails: HeavyTails) -> list[Floats]:
    """Return where a climb with tails begins whose shocks are fewer and louder, if the base has any.

    One law of shocks that has to do for tails, too, is that of more and fainter ones that fade within a reading or two,
    and from there no climb finds back.
    """
    base, data = fit.terms[0], fit.data
    if not isinstance(base, Base) or not base.shocks:
        return []
    tried = list[Climb]()
    for fewer, louder in _FEWER_LOUDER:
        for intervals in _DECAYS:
            theta = np.concatenate((fit.theta, tails.start))
            theta[6:9] = theta[6] - log(fewer), theta[7] + log(louder), log(intervals * data.interval_s)
            tried.append(Climb([*fit.terms, tails], theta, data))
    return [max(tried, key=lambda one: one.value).theta]


def tail_of_gain(gain: float) -> float:
    """Return the probability that tails add so much to a record that has none.

    >>> round(tail_of_gain(2.996), 3)
    0.05
    """
    return float(chi2.sf(2 * max(gain, 0.0), _FREEDOM))
