"""The least mean squares filter (LMS) of the paper, as an adaptive line enhancer: the second of its three rivals."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import NDArray

from aemd.block import ESTIMATE, NOT_A_VALUE, READING, Block, Estimates, Status
from aemd.estimate.compiled import choose, kernel
from aemd.estimate.kalman import columns_of, rows_for
from aemd.estimate.options import Count, Positive, check_bounds, discrete_phi

__all__ = ["Lms", "LmsOptions"]

START_UP, COASTED, RESTARTED = int(Status.START_UP), int(Status.COASTED), int(Status.RESTARTED)
NO_VALUE = NOT_A_VALUE
NEVER = -(2**62)  # a reading's number, or a count of readings since one, where there has been none
LEAST_VARIANCE = 1e-6  # of sigma_R^2: constant readings leave no error, and a density needs some width


@dataclass(frozen=True, slots=True, kw_only=True)
class LmsOptions:
    """Options of LMS."""

    form: Literal["normalised", "plain"] = "normalised"
    """Whether a step is divided by the power of the readings in the line. Plain steps are stable only if `step` is
    below 2 over that power, in 1/V^2, which has to be known beforehand."""
    taps: Count = 15
    """Readings that the prediction is made from: as many as the longest window of eq. 17."""
    step: Annotated[float, Gt(0), Le(1e12)] = 0.5
    """Step of the weights: in 1/V^2 if plain; without unit if normalised, where 1 follows fastest and 2 is unstable."""
    least_power_V2: Annotated[float, Ge(0), Le(1e12)] = 15 * 60e-3**2
    """Added to the power that a normalised step is divided by, V^2: that of a line of the paper's largest impulses, so
    that the first of them, met by a quiet line, does not throw the weights over. Below it steps are plain ones."""
    sigma_R_V: Positive = 0.99e-3
    """First guess of the standard deviation of the prediction's error, V: the paper's sigma_R."""
    error_memory: Count = 100
    """Readings over which that deviation is averaged."""
    prior_sigma_V: Positive = 1000.0
    """Standard deviation of the input about 0 V before the first reading, V: the meter's largest range."""
    gate: Positive = 1e6
    """A reading further than this from its prediction, in standard deviations, is treated as one without a value."""
    restart_after: Annotated[int, Ge(0), Le(1_000_000)] = 15
    """After more readings in a row than this without a value (lost or flagged), the filter starts afresh."""

    def __post_init__(self) -> None:
        """Refuse what is out of bounds.

        Raises:
            ValueError: a value breaks a rule.
        """
        check_bounds(self)
        if self.form == "normalised" and self.step >= 2:
            raise ValueError(f"step = {self.step!r}: must be below 2 where it is normalised, or the weights diverge")


class Lms:
    """Predict each reading from those before it, with weights that follow the gradient of the squared error.

        y_k = w . (z_{k-1}, ..., z_{k-n}),  e = z_k - y_k,  w <- w + mu e (z_{k-1}, ...) / (eps + |z|^2)

    The paper says "LMS" and no more. With one sensor and no reference input the usual arrangement is the adaptive line
    enhancer (Widrow et al., Proc. IEEE 63, 1692, 1975): what a linear predictor foresees is the signal, the rest is
    noise. y is the estimate. Weights start as a mean, 1/n each.

    A reading without a value is bridged with the last estimate (COASTED), which also takes its place in the line. After
    more than `restart_after` of them the line is filled with the next value, which stands for itself (START_UP until
    the line holds readings only). sigma is that of the prediction's error, reading noise included: an upper bound.
    """

    name = "lms"
    lag = 0

    def __init__(self, options: LmsOptions, interval_s: float, few: int = 0) -> None:
        discrete_phi(1.0, interval_s)  # refuses an interval that cannot be
        self.options = options
        self.interval_s = interval_s
        self._few = few
        self._rule = LmsRule(
            normalised=options.form == "normalised",
            step=float(options.step),
            least_power=float(options.least_power_V2),
            R=float(options.sigma_R_V) ** 2,
            error_memory=options.error_memory,
            prior_P=float(options.prior_sigma_V) ** 2,
            gate=float(options.gate),
            restart_after=options.restart_after,
        )
        self._now = np.zeros(1, dtype=NOW)
        self._now["index"] = self._now["hole"] = NEVER
        self._now["variance"] = self._rule.prior_P
        self._line = np.zeros(options.taps)
        self._weights = np.zeros(options.taps)
        self.push(np.empty(0, dtype=READING))  # compiles now, or loads what was compiled, not at the first reading

    def push(self, block: Block) -> Estimates:
        """Return the estimates of these readings."""
        estimates = rows_for(block)
        run = choose(run_lms, block.size, self._few)
        run(self._now, self._line, self._weights, self._rule, *columns_of(block), estimates)
        return estimates

    def flush(self) -> Estimates:
        """Return nothing: no estimate is held back."""
        return np.empty(0, dtype=ESTIMATE)


class LmsRule(NamedTuple):
    """What the kernel needs of the options."""

    normalised: bool
    step: float
    least_power: float
    R: float
    error_memory: int
    prior_P: float
    gate: float
    restart_after: int


NOW = np.dtype(
    [
        ("index", "<i8"),  # of the last reading, NEVER before the first
        ("hole", "<i8"),  # readings without a value since the last one with; NEVER before the first with one
        ("filled", "<i8"),  # readings in the line since the start
        ("slot", "<i8"),  # of the last reading in the line
        ("y", "<f8"),  # last estimate, V
        ("variance", "<f8"),  # of the prediction's error, V^2
        ("errors", "<i8"),  # that went into it
    ]
)
"""What is carried from reading to reading, beside line and weights."""


@kernel()
def shift_in(line: NDArray[np.float64], z: float) -> None:
    """Put a reading in front of the line; the oldest falls out."""
    for j in range(line.size - 1, 0, -1):
        line[j] = line[j - 1]
    line[0] = z


@kernel()
def believable(e: float, S: float, rule: LmsRule) -> bool:
    """Tell whether an error is within the gate; not one that is NaN or infinite, nor any once S has overflowed."""
    return e * e <= rule.gate * rule.gate * S < math.inf


@kernel()
def adapt(w: NDArray[np.float64], line: NDArray[np.float64], e: float, rule: LmsRule) -> None:
    """Step the weights down the gradient of e^2."""
    step = rule.step * e
    if rule.normalised:
        power = rule.least_power
        for j in range(line.size):
            power += line[j] * line[j]
        step /= power if power > 0.0 else 1.0  # of a line of zeros, which no step moves
    for j in range(line.size):
        w[j] += step * line[j]


@kernel()
def run_lms(
    now: NDArray[np.void],
    line: NDArray[np.float64],
    w: NDArray[np.float64],
    rule: LmsRule,
    index: NDArray[np.int64],
    z: NDArray[np.float64],
    status: NDArray[np.uint32],
    out: NDArray[np.void],
) -> None:
    """Filter readings into `out` (zeroed); `now`, `line` (newest first) and `w` become those after the last."""
    state = now[0]
    for i in range(z.size):
        flags = status[i]
        has_value = flags & NO_VALUE == 0
        missing = index[i] - state.index - 1 if state.index != NEVER else 0
        state.index = index[i]
        if missing < 0:  # another acquisition: nothing is known of what lies between
            state.hole, state.variance, state.y = NEVER, rule.prior_P, 0.0
            flags |= RESTARTED
        else:
            state.hole += missing
            for _ in range(min(missing, line.size)):
                shift_in(line, state.y)

        fresh = state.hole < 0
        if has_value and state.hole > rule.restart_after and believable(z[i], rule.prior_P, rule):
            fresh = True
            flags |= RESTARTED
        y, S = state.y, rule.prior_P
        if not fresh:
            y, S = 0.0, state.variance * (1.0 + state.hole)
            for j in range(line.size):
                y += w[j] * line[j]
        e = z[i] - y if not fresh else z[i]
        log_likelihood = 0.0
        if not (has_value and believable(e, S, rule)):
            state.hole += 1
            shift_in(line, state.y)
            flags |= COASTED
        else:
            log_likelihood = -0.5 * (math.log(2.0 * math.pi * S) + e * e / S)
            if fresh:
                line[:] = z[i]
                w[:] = 1.0 / w.size
                y = z[i]
                state.filled, state.errors, state.variance = 0, 0, rule.R
            else:
                adapt(w, line, e, rule)
                state.errors = min(state.errors + 1, rule.error_memory)
                state.variance += (e * e - state.variance) / (state.errors + 1.0)
                state.variance = max(state.variance, LEAST_VARIANCE * rule.R)
                shift_in(line, z[i])
            if state.filled < line.size:
                flags |= START_UP
            state.filled += 1
            state.y, state.hole = y, 0
        out[i].value_V = state.y
        out[i].sigma_V = math.sqrt(state.variance * (1.0 + max(state.hole, 0)))
        out[i].log_likelihood = log_likelihood
        out[i].status = flags
