"""Whether a stated model expects as much noise as there is; a fitted one does by construction."""

import numpy as np
from scipy.stats import chi2

from aemd.diagnose.evidence import Evidence
from aemd.diagnose.fit import Fit
from aemd.diagnose.given import Given

__all__ = ["check_variance"]


def check_variance(fit: Fit) -> list[Evidence]:
    """Compare the residuals' sum of squares with chi-square's law of as many degrees of freedom as readings.

    No term answers it: what a mechanism adds has a colour or a shape that another check sees. Where this alone fires,
    the model's own figures are off.
    """
    if not isinstance(fit.terms[0], Given):
        return []
    n = fit.data.n
    total = float(np.sum(fit.z[fit.data.used] ** 2))
    return [
        Evidence(
            check="variance of the residuals over that of the stated model",
            p_value=float(min(1.0, 2 * min(chi2.sf(total, n), chi2.cdf(total, n)))),
            observed=total / n,
            low=float(chi2.ppf(0.025, n)) / n,
            high=float(chi2.isf(0.025, n)) / n,
        )
    ]
