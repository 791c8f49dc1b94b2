"""The Kalman filter of the paper's state model, without a disturbance: the first of its three rivals."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aemd.block import ESTIMATE, READING, Block, Estimates
from aemd.estimate import kernels
from aemd.estimate.compiled import choose
from aemd.estimate.options import StateOptions, discrete_phi

__all__ = ["Kalman", "KalmanOptions", "columns_of", "rows_for", "state_model"]


@dataclass(frozen=True, slots=True, kw_only=True)
class KalmanOptions(StateOptions):
    """Options of the Kalman filter: those of the state model."""


class Kalman:
    """Estimate the input with the Kalman filter of x' = phi x + v, z = x + w (eq. 2 and 3 with u = 0).

    A reading without a value, lost or flagged, is predicted over (COASTED) and sigma grows. After more than
    `restart_after` of them the filter starts afresh at the next value (RESTARTED).
    """

    name = "kalman"
    lag = 0

    def __init__(self, options: KalmanOptions, interval_s: float, few: int = 0) -> None:
        self.options = options
        self.interval_s = interval_s
        self._few = few
        self._model = state_model(options, interval_s)
        self._state = kernels.start_kalman(self._model)
        self.push(np.empty(0, dtype=READING))  # compiles now, or loads what was compiled, not at the first reading

    def push(self, block: Block) -> Estimates:
        """Return the estimates of these readings."""
        estimates = rows_for(block)
        run = choose(kernels.run_kalman, block.size, self._few)
        run(self._state, self._model, *columns_of(block), estimates)
        return estimates

    def flush(self) -> Estimates:
        """Return nothing: no estimate is held back."""
        return np.empty(0, dtype=ESTIMATE)


def state_model(options: StateOptions, interval_s: float) -> kernels.StateModel:
    """Return the numbers that the kernels need of the state model."""
    return kernels.StateModel(
        phi=discrete_phi(options.tau_s, interval_s),
        Q=float(options.sigma_Q_V) ** 2,
        R=float(options.sigma_R_V) ** 2,
        prior_P=float(options.prior_sigma_V) ** 2,
        gate=float(options.gate),
        restart_after=options.restart_after,
    )


def rows_for(block: Block) -> Estimates:
    """Return rows for the estimates of a block: number and instant filled in, the rest 0."""
    estimates = np.zeros(block.size, dtype=ESTIMATE)
    estimates["index"] = block["index"]
    estimates["t_ns"] = block["t_ns"]
    return estimates


def columns_of(block: Block) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.uint32]]:
    """Return index, value and status as arrays of their own, always of one layout, so that one kernel is compiled."""
    return block["index"].copy(), block["value_V"].copy(), block["status"].copy()
