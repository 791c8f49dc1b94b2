"""A mixture of normal laws, and between what it leaves a parameter."""

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

from aemd.diagnose.hypothesis import Parameter

__all__ = ["Weighed", "slopes_of"]

Floats = NDArray[np.float64]

_FARTHEST = 50.0
"""Of a free number, most of which are logarithms, that an end lies from the middle at most."""


@dataclass(frozen=True, slots=True)
class Weighed:
    """A mixture of normal laws of a term's free numbers; shapes (m,), (m, k), (m, k, k)."""

    weights: Floats
    thetas: Floats
    within: Floats

    def ends(self, parameter: Parameter, share: float, wider: tuple[float, float] = (1.0, 1.0)) -> tuple[float, float]:
        """Return between what a parameter lies but for this share of the probability at each end.

        Of one number's, the ends are as many times as far from the middle as `wider` says, below and above.
        """
        slopes = [slopes_of(parameter, theta) for theta in self.thetas]
        alone = {int(at) for slope in slopes for at in np.flatnonzero(slope)}
        values = np.array([parameter.value(theta) for theta in self.thetas])
        sds = np.array([sqrt(max(float(s @ c @ s), 0.0)) for s, c in zip(slopes, self.within, strict=True)])
        if len(alone) == 1:  # the number's own scale, so that a share stays below 1
            at = alone.pop()
            low, high = self._quantiles(self.thetas[:, at], np.sqrt(self.within[:, at, at]), share)
            middle = float(self.weights @ self.thetas[:, at])
            low = middle - min(wider[0] * (middle - low), _FARTHEST)
            high = middle + min(wider[1] * (high - middle), _FARTHEST)
            below, above = self.thetas[0].copy(), self.thetas[0].copy()
            below[at], above[at] = low, high
            first, second = sorted((parameter.value(below), parameter.value(above)))
            return first, second
        if parameter.positive and (values > 0).all():
            low, high = np.exp(self._quantiles(np.log(values), sds / values, share))
            return float(low), float(high)
        return self._quantiles(values, sds, share)

    def _quantiles(self, centres: Floats, sds: Floats, share: float) -> tuple[float, float]:
        sds = np.maximum(sds, 1e-9 * max(float(np.abs(centres).max()), 1e-30))
        least, most = float((centres - 9 * sds).min()), float((centres + 9 * sds).max())

        def above(x: float, part: float) -> float:
            return float(self.weights @ ndtr((x - centres) / sds)) - part

        low, high = (brentq(above, least, most, args=(part,)) for part in (share, 1 - share))
        return float(low), float(high)


def slopes_of(parameter: Parameter, theta: Floats) -> Floats:
    """Return how a parameter changes with each free number."""
    here, slopes = parameter.value(theta), np.empty(theta.size)
    for number in range(theta.size):
        width = 1e-4 * max(abs(theta[number]), 1.0)
        aside = theta.copy()
        aside[number] += width
        slopes[number] = (parameter.value(aside) - here) / width
    return slopes
