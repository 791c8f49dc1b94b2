"""Whether a stated model expects as much noise as there is; a fitted one does by construction."""

from math import sqrt

import numpy as np
from scipy.stats import chi2

from aemd.diagnose.evidence import Evidence
from aemd.diagnose.fit import Fit
from aemd.diagnose.given import Given
from aemd.diagnose.terms.lines import amplitude_cost
from aemd.diagnose.terms.noise import HeavyTails

__all__ = ["check_variance"]

_WORTH_A_FIT = 0.01
"""p from which tails are tried; far above the level of any finding."""
_TAILS = ((0.02, 3.0), (0.1, 1.5), (0.3, 0.7))
"""Share of the readings, and deviation in deviations of the innovation, that their fits begin with."""


def check_variance(fit: Fit) -> list[Evidence]:
    """Compare the residuals' sum of squares with chi-square's law of as many degrees of freedom as readings.

    What a mechanism adds has a colour or a shape that another check sees, but for tails that the stated shocks have
    taken for theirs. Where this alone fires and tails do not answer it, the model's own figures are off.
    """
    if not isinstance(fit.terms[0], Given):
        return []
    n = fit.data.n
    total = float(np.sum(fit.z[fit.data.used] ** 2))
    p_value = float(min(1.0, 2 * min(chi2.sf(total, n), chi2.cdf(total, n))))
    terms: tuple[HeavyTails, ...] = ()
    if p_value < _WORTH_A_FIT and total > n:
        core = sqrt(float(np.median(fit.variance[fit.data.used])))
        terms = tuple(HeavyTails(share, ratio * core, amplitude_cost(2, n)) for share, ratio in _TAILS)
    return [
        Evidence(
            check="variance of the residuals over that of the stated model",
            p_value=p_value,
            observed=total / n,
            low=float(chi2.ppf(0.025, n)) / n,
            high=float(chi2.isf(0.025, n)) / n,
            terms=terms,
        )
    ]
