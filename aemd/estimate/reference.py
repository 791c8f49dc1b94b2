"""The Kalman filter of the filterpy package, one call a reading: what a script does today, and a check on our own."""

import importlib
import math

import numpy as np

from aemd.block import ESTIMATE, NOT_A_VALUE, Block, Estimates, Status
from aemd.estimate.kalman import KalmanOptions, rows_for, state_model
from aemd.estimate.kernels import predict

__all__ = ["Filterpy"]


class Filterpy:
    """Estimate as Kalman does, to rounding, through filterpy.kalman.KalmanFilter; some hundred times slower."""

    name = "filterpy"
    lag = 0

    def __init__(self, options: KalmanOptions, interval_s: float, few: int = 0) -> None:  # noqa: ARG002 - never compiled
        self.options = options
        self.interval_s = interval_s
        self._model = state_model(options, interval_s)
        # Here and not at the top: it imports all of scipy, and nobody else needs it.
        self._filter = importlib.import_module("filterpy.kalman").KalmanFilter(dim_x=1, dim_z=1)
        self._filter.F = np.array([[self._model.phi]])
        self._filter.H = np.array([[1.0]])
        self._filter.Q = np.array([[self._model.Q]])
        self._filter.R = np.array([[self._model.R]])
        self._last_index: int | None = None
        self._hole = -1
        """Readings without a value since the last one with; -1 before the first with one."""
        self._forget()

    def push(self, block: Block) -> Estimates:
        """Return the estimates of these readings."""
        estimates = rows_for(block)
        for reading, estimate in zip(block, estimates, strict=True):
            estimate["status"], estimate["log_likelihood"] = self._take(
                int(reading["index"]), float(reading["value_V"]), int(reading["status"])
            )
            estimate["value_V"] = self._filter.x[0, 0]
            estimate["sigma_V"] = math.sqrt(self._filter.P[0, 0])
        return estimates

    def flush(self) -> Estimates:
        """Return nothing: no estimate is held back."""
        return np.empty(0, dtype=ESTIMATE)

    def _take(self, index: int, z: float, status: int) -> tuple[int, float]:
        """Take one reading; return its status bits with ours, and its log-likelihood."""
        lost = 0 if self._last_index is None else index - self._last_index - 1
        self._last_index = index
        if lost < 0:  # another acquisition
            self._forget()
            self._hole = -1
            status |= Status.RESTARTED
        elif lost > 0:
            x, P = predict(float(self._filter.x[0, 0]), float(self._filter.P[0, 0]), lost, self._model)
            self._filter.x, self._filter.P = np.array([[x]]), np.array([[P]])
            self._hole += lost if self._hole >= 0 else 0
        has_value = not status & NOT_A_VALUE
        prior_reach = self._model.gate * math.sqrt(self._model.prior_P)
        if has_value and self._hole > self._model.restart_after and abs(z) <= prior_reach:
            self._forget()
            status |= Status.RESTARTED
        self._filter.predict()
        error = z - float(self._filter.x[0, 0])
        S = float(self._filter.P[0, 0]) + self._model.R
        if not (has_value and abs(error) <= self._model.gate * math.sqrt(S)):
            self._hole += self._hole >= 0
            return status | Status.COASTED, 0.0
        self._filter.update(z)
        self._hole = 0
        return status, -0.5 * (math.log(2.0 * math.pi * S) + error * error / S)

    def _forget(self) -> None:
        self._filter.x = np.array([[0.0]])
        self._filter.P = np.array([[self._model.prior_P]])
