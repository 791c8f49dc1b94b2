"""What happened once: the one hump that the residuals show best, a rival from outside of what acts all the time."""

from math import log, sqrt

import numpy as np
from scipy.signal import fftconvolve

from aemd.diagnose.checks.shapes import settled_response
from aemd.diagnose.fit import Fit
from aemd.diagnose.terms.lines import amplitude_cost
from aemd.diagnose.terms.shapes import Hump

__all__ = ["best_hump"]

_WIDTHS = (4, 12, 36, 108)
"""Readings."""


def best_hump(fit: Fit) -> Hump | None:
    """Return the hump whose response in the residuals is the largest in deviations, over places and widths.

    A search for what to hold against a name, and no check of its own: it has no p-value, and finds nothing alone.
    """
    n = fit.data.y.size
    step = settled_response(fit, min(n, 20 * _WIDTHS[-1]))
    best: tuple[float, Hump] | None = None
    for width in _WIDTHS:
        if 4 * width > n:
            break
        pulse = step - np.concatenate((np.zeros(2 * width), step[: -2 * width]))
        size = sqrt(float(np.sum(pulse**2)))
        scores = fftconvolve(fit.z, pulse[::-1])[pulse.size - 1 :][:n] / size
        at = int(np.argmax(np.abs(scores)))
        cost = amplitude_cost(1, fit.data.n) + log(n / width) + log(len(_WIDTHS))
        if best is None or abs(scores[at]) > best[0]:
            centre_s = float(fit.data.t_s[min(at + width, n - 1)])
            hump = Hump(centre_s, width * fit.data.interval_s, float(scores[at]) / size, cost)
            best = float(abs(scores[at])), hump
    return best[1] if best else None
