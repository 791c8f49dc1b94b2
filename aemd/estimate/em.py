"""Expectation maximisation over a window: the options that AEM and REM share, and the run of the kernel."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Lt
from numpy.typing import NDArray

from aemd.block import READING, Block, Estimates
from aemd.estimate import kernels
from aemd.estimate.compiled import choose
from aemd.estimate.kalman import columns_of, rows_for, state_model
from aemd.estimate.options import Count, Positive, StateOptions

__all__ = ["EmFilter", "EmOptions"]


@dataclass(frozen=True, slots=True, kw_only=True)
class EmOptions(StateOptions):
    """How the disturbance of one window is found: shared by AEM and by REM, whose window is fixed."""

    e_step: Literal["filtered", "smoothed"] = "filtered"
    """Estimates that a pass averages over: the Kalman filter's (Table 1) or the smoother's (section 3). With the filter
    the expected likelihood may fall from one pass to the next; with the smoother it cannot."""
    stop_rule: Literal["likelihood", "disturbance"] = "likelihood"
    """Eq. 16 with sizes in place of signed numbers, |dQ| < delta |Q|; or |du| < delta sqrt(R / v), free of units."""
    delta: Annotated[float, Ge(0), Lt(1)] = 0.01
    """Limit of the stop rule (after eq. 16). At 0 every window takes r_max passes."""
    r_max: Count = 10
    """Most passes; the paper names no number. A pass moves what is constant in a window from the estimate into the
    disturbance, signal or not; the limit repeats the estimate of a window ago for ever, and 30 passes come near it."""
    likelihood_unit_V: Positive = 1e-3
    """Unit in which eq. 7 takes the variances, V: the paper's millivolt. It weighs on the likelihood rule alone."""
    prior: Literal["stored", "process"] = "stored"
    """Variance of the estimate that a window starts from: its own, or sigma_Q^2, which is what eq. 5 prints."""
    holes: Literal["coast", "kalman"] = "coast"
    """While the window holds a reading without a value: coast, for at most `restart_after` readings, or let the Kalman
    filter stand in, which loses less where flagged readings are frequent."""


class EmFilter:
    """The run of AEM with a choice of windows, and its state.

    Args:
        options: of the state model and the passes.
        interval_s: between readings, s.
        windows: lengths, the longest first.
        thresholds: spread of slopes up to which each but the last is taken; empty for one window.
        curve: matrix from readings to the fitted curve, see window.fit_matrices; empty for one window.
        slopes: matrix from the fitted curve to its slopes; empty for one window.
        slope_unit_V: unit of a slope, V per reading.
        few: blocks of fewer readings are not worth a compiler.
    """

    def __init__(
        self,
        options: EmOptions,
        interval_s: float,
        windows: tuple[int, ...],
        thresholds: tuple[float, ...],
        curve: NDArray[np.float64],
        slopes: NDArray[np.float64],
        slope_unit_V: float,
        few: int,
    ) -> None:
        self._few = few
        self._model = state_model(options, interval_s)
        self._rule = kernels.AemRule(
            windows=np.array(windows, dtype=np.int64),
            thresholds=np.array(thresholds, dtype=np.float64),
            curve=curve,
            slopes=slopes,
            slope_unit_V=float(slope_unit_V),
            coast=options.holes == "coast",
            passes=kernels.PassRule(
                likelihood_unit_V=float(options.likelihood_unit_V),
                stored_prior=options.prior == "stored",
                smoothed=options.e_step == "smoothed",
                by_likelihood=options.stop_rule == "likelihood",
                delta=float(options.delta),
                r_max=options.r_max,
            ),
        )
        self._state = kernels.start_aem(self._model, self._rule)
        self.push(np.empty(0, dtype=READING))  # compiles now, or loads what was compiled, not at the first reading

    def push(self, block: Block) -> Estimates:
        """Return the estimates of these readings."""
        estimates = rows_for(block)
        run = choose(kernels.run_aem, block.size, self._few)
        run(self._state, self._model, self._rule, *columns_of(block), estimates)
        return estimates
