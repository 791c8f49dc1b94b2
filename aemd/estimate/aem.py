"""The adaptive expectation maximisation of the paper (AEM): Shen et al., Micromachines 10(5), 294, 2019, section 3."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le

from aemd.block import ESTIMATE, Block, Estimates
from aemd.estimate.em import EmFilter, EmOptions
from aemd.estimate.options import Count, Positive, check_bounds
from aemd.estimate.window import fit_matrices

__all__ = ["Aem", "AemOptions"]


@dataclass(frozen=True, slots=True, kw_only=True)
class AemOptions(EmOptions):
    """Options of AEM: those of the passes, and how the window is chosen."""

    windows: tuple[Count, ...] = (15, 10, 5)
    """Window lengths, the longest first (eq. 17)."""
    thresholds: tuple[Positive, ...] = (math.sqrt(3) / 3, math.sqrt(3))
    """Spread of slopes up to which each window but the last is taken: tan 30 and tan 60 degrees (eq. 17)."""
    slope_unit_V: Positive = 1e-3
    """Unit of a slope, V per reading: the paper's millivolt. Scale it with the noise of the sensor."""
    fit_order: Annotated[int, Ge(2), Le(10)] = 2
    """Degree of the curve fitted to the recent readings: the lowest whose slopes differ. White noise of 0.99 mV then
    leaves the longest window in place 85 times in 100, and a newest reading 3 mV off takes it away."""
    fit_history: Count = 15
    """Readings that the curve is fitted to: as many as the longest window takes."""

    def __post_init__(self) -> None:
        """Refuse what is out of bounds, or does not fit together.

        Raises:
            ValueError: a value breaks a rule.
        """
        check_bounds(self)
        if not self.windows or min(self.windows) < 1 or any(a <= b for a, b in pairwise(self.windows)):
            raise ValueError(f"windows = {list(self.windows)}: must fall from the longest to the shortest, at least 1")
        if len(self.thresholds) != len(self.windows) - 1 or any(
            not a < b for a, b in pairwise((0.0, *self.thresholds, math.inf))
        ):
            raise ValueError(f"thresholds = {list(self.thresholds)}: must rise, one fewer than windows, above 0")
        if self.fit_history <= self.fit_order:
            raise ValueError(f"fit_history = {self.fit_history}: must be above fit_order = {self.fit_order}")


class Aem:
    """Estimate input and disturbance by expectation maximisation over a window that the readings choose.

    For each reading: fit a curve to the last ones, take the window from how far its slopes spread (eq. 17), start from
    the estimate before the window, and take in turn the filter (E step) and the mean of what it leaves (M step, eq. 15)
    until the stop rule holds. Input and disturbance cannot be told apart within one window; only the start and the
    early stop keep them apart. With `delta` at 0.01 the first pass is mostly the last, and AEM nearly a Kalman filter.

    Many passes are no cure: their limit is x_k = x_{k-v}: an estimate that repeats an early window, shocks
    included, and follows the input no more.

    value_V, sigma_V  the filter's at the window's last reading, the disturbance taken as known: sigma is a lower bound
    log_likelihood    of the reading about phi x + u with the last estimate and disturbance, variance phi^2 P + Q + R
    """

    name = "aem"
    lag = 0

    def __init__(self, options: AemOptions, interval_s: float, few: int = 0) -> None:
        self.options = options
        self.interval_s = interval_s
        curve, slopes = fit_matrices(options.fit_history, options.fit_order)
        self._filter = EmFilter(
            options, interval_s, options.windows, options.thresholds, curve, slopes, options.slope_unit_V, few
        )

    def push(self, block: Block) -> Estimates:
        """Return the estimates of these readings."""
        return self._filter.push(block)

    def flush(self) -> Estimates:
        """Return nothing: no estimate is held back."""
        return np.empty(0, dtype=ESTIMATE)
