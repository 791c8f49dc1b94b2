"""The limit: a Kalman filter that is told the true state model, and which readings are disturbed and by how much.

It has the rival's model of the input with the true parameters, exact down to the mean over the aperture, and for each
reading the true variance of its abrupt disturbance. Only a benchmark can know these. With a lag it is a fixed-lag
smoother, by carrying the last inputs along in its state. It is written plainly, and shares no code with the estimator
that it judges.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from aemd.block import ESTIMATE, Estimates
from aemd.paper.protocol import (
    APERTURE_S,
    INTERVAL_S,
    MARKOV_SD_V,
    MARKOV_TAU_S,
    NOISE_V,
    PROBE_V,
    SIGNAL_HZ,
    SIGNAL_V,
    Condition,
    Record,
)

__all__ = ["oracle"]

Floats = NDArray[np.float64]


def oracle(condition: Condition, record: Record, lag: int) -> Estimates:
    """Return the estimates of a record's input, array of ESTIMATE; only value and sigma are filled in.

    The drift of the static tests is known to it as well, as their shocks are: what is left of a reading of the static
    test is its input, 0 V, and noise, and since the model knows that there is no input, the error is 0.
    """
    F, Q, start = _state_model(condition)
    reading_V = record.block["value_V"] - record.slow_V
    value_V, variance_V2 = _filter(F, Q, start, reading_V, NOISE_V**2 + record.abrupt_variance_V2, lag)
    estimates = np.zeros(reading_V.size, dtype=ESTIMATE)
    estimates["index"], estimates["t_ns"] = record.block["index"], record.block["t_ns"]
    estimates["value_V"], estimates["sigma_V"] = value_V, np.sqrt(np.maximum(variance_V2, 0))
    return estimates


def _state_model(condition: Condition) -> tuple[Floats, Floats, Floats]:
    """Return F, Q and the variance before the first reading, of a state whose first part is the input."""
    amplitude_V = {"dynamic": SIGNAL_V, "probe": PROBE_V}.get(condition, 0.0)
    if condition == "broadband":
        return _markov_means()
    angle = 2 * np.pi * SIGNAL_HZ * INTERVAL_S
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn, np.zeros((2, 2)), np.eye(2) * amplitude_V**2 / 2


def _markov_means() -> tuple[Floats, Floats, Floats]:
    """Return the model of a Markov process averaged over apertures; its second part is the value at the end of one.

    Through the pause p before an aperture a, in units of tau: x <- e^-p x + noise. Through the aperture, from x: the
    mean is g x + m with g = (1 - e^-a)/a, the end e^-a x + e, and integrating the process's equation twice gives

        var m = 2 sigma^2 (a - 2 (1 - e^-a) + (1 - e^-2a)/2)/a^2
        cov(m, e) = sigma^2 a g^2
        var e = sigma^2 (1 - e^-2a)
    """
    a, p = APERTURE_S / MARKOV_TAU_S, (INTERVAL_S - APERTURE_S) / MARKOV_TAU_S
    square, gone = MARKOV_SD_V**2, -np.expm1(-a)
    g, shared = gone / a, square * gone**2 / a
    through = np.array([g, 1 - gone])
    own = np.array([[2 * square * (a - 2 * gone - np.expm1(-2 * a) / 2) / a**2, shared], [shared, 0]])
    own[1, 1] = -square * np.expm1(-2 * a)
    F = np.column_stack([np.zeros(2), np.exp(-p) * through])
    Q = own - square * np.expm1(-2 * p) * np.outer(through, through)
    return F, Q, own + square * np.outer(through, through)


@njit(cache=True)
def _filter(F: Floats, Q: Floats, start: Floats, z: Floats, R: Floats, lag: int) -> tuple[Floats, Floats]:
    """Return mean and variance of the input `lag` readings back; the last ones are those of the end of the record."""
    n = F.shape[0] + lag
    A, B, P = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    A[:2, :2], B[:2, :2], P[:2, :2] = F, Q, start
    for i in range(lag):
        A[2 + i, 0 if i == 0 else 1 + i] = 1.0  # the input of one reading before moves one place back
    x = np.zeros(n)
    value, variance = np.empty(z.size), np.empty(z.size)
    seen = n - 1 if lag > 0 else 0
    for k in range(z.size):
        x = A @ x
        P = A @ P @ A.T + B
        S = P[0, 0] + R[k]
        K = P[:, 0].copy() / S
        x = x + K * (z[k] - x[0])
        P = P - np.outer(K, K) * S
        if k >= lag:
            value[k - lag], variance[k - lag] = x[seen], P[seen, seen]
    for back in range(lag):  # the held ones: place 0 is the last input, place 1 + j the one j before it
        place = 0 if back == 0 else 1 + back
        value[z.size - 1 - back], variance[z.size - 1 - back] = x[place], P[place, place]
    return value, variance
