"""Regular expectation maximisation (REM): AEM with one fixed window, the third rival in the paper."""

from dataclasses import dataclass

import numpy as np

from aemd.block import ESTIMATE, Block, Estimates
from aemd.estimate.em import EmFilter, EmOptions
from aemd.estimate.options import Count

__all__ = ["Rem", "RemOptions"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RemOptions(EmOptions):
    """Options of REM: those of the passes, and the window."""

    window: Count = 10
    """Readings in the window. The paper does not say; this is the middle one of eq. 17."""


class Rem:
    """Estimate input and disturbance by expectation maximisation over a window of fixed length; see Aem."""

    name = "rem"
    lag = 0

    def __init__(self, options: RemOptions, interval_s: float, few: int = 0) -> None:
        self.options = options
        self.interval_s = interval_s
        none = np.zeros((0, 0))
        self._filter = EmFilter(options, interval_s, (options.window,), (), none, none, 1.0, few)

    def push(self, block: Block) -> Estimates:
        """Return the estimates of these readings."""
        return self._filter.push(block)

    def flush(self) -> Estimates:
        """Return nothing: no estimate is held back."""
        return np.empty(0, dtype=ESTIMATE)
