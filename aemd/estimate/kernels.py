"""The recursions of the Kalman filter and of AEM, to be compiled: arrays in, arrays out, a state that is carried on.

All functions of one recursion stand in this one file because numba's cache notices a change only in the file of the
function that is called from outside. Nothing here is reordered or fused by the compiler (no fastmath), so the bits of a
result depend on the readings alone: not on how the stream was cut, and not on what the caches below hold.

Within the loop over the readings no array is looked up in a tuple, cut, or handed on in one: numba counts a reference
for each, by an instruction that lets no other overtake it, and without AEM takes two thirds of the time.

Letters, as in the paper (Shen et al., Micromachines 10(5), 294, 2019):

    z  reading, V           x, P  state and its variance, V and V^2      u  disturbance, V
    v  window length        K     gain of the Kalman filter              r  pass of the expectation maximisation
    m, M  predicted state and its variance                               Q, R  variances of process and reading, V^2
"""

import math
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from aemd.block import NOT_A_VALUE, Status
from aemd.estimate.compiled import kernel

__all__ = ["AemRule", "AemState", "StateModel", "run_aem", "run_kalman", "start_aem", "start_kalman"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Record: TypeAlias = Any  # one element of a structured array, fields as attributes: numba's, numpy has no type for it

START_UP, COASTED, RESTARTED = int(Status.START_UP), int(Status.COASTED), int(Status.RESTARTED)
NO_VALUE = NOT_A_VALUE
LOG_2PI = math.log(2.0 * math.pi)

NEVER = -(2**62)
"""Stands for a reading's number, or a count of readings since something, where there has been none."""

NOW = np.dtype(
    [
        ("index", "<i8"),  # of the last reading, NEVER before the first
        ("hole", "<i8"),  # readings without a value since the last one with; NEVER before the first with one
        ("run", "<i8"),  # usable readings in a row, up to the last one, that had an estimate before them
        ("blind", "<i8"),  # readings since the last that the estimate has taken in
        ("windowed", "<i8"),  # 1 from the first window on, until the Kalman filter stands in
        ("slot", "<i8"),  # of the next reading in the rings of AemState
        ("x", "<f8"),
        ("P", "<f8"),
        ("u", "<f8"),
        ("S", "<f8"),  # variance of a prediction, and its logarithm: the same for many readings
        ("log_S", "<f8"),
    ]
)
"""What is carried from reading to reading."""


class StateModel(NamedTuple):
    """x' = phi x + v, z = x + u + w: eq. 2 and 3."""

    phi: float
    Q: float
    R: float
    prior_P: float
    gate: float
    restart_after: int


@kernel()
def whole_power(base: float, exponent: int) -> float:
    """Return base^exponent for an exponent of at least 0, by squaring: to the same bits, compiled or not."""
    power = 1.0
    while exponent > 0:
        if exponent & 1:
            power *= base
        exponent >>= 1
        base *= base
    return power


@kernel()
def predict(x: float, P: float, steps: int, model: StateModel) -> tuple[float, float]:
    """Return state and variance `steps` readings later, in closed form.

    x_n = phi^n x,  P_n = phi^2n P + Q (1 - phi^2n) / (1 - phi^2)
    """
    if model.phi == 1.0:
        return x, P + steps * model.Q
    decay = whole_power(model.phi, steps)
    return decay * x, decay * decay * P + model.Q * (1.0 - decay * decay) / (1.0 - model.phi * model.phi)


@kernel()
def within_gate(distance: float, S: float, model: StateModel) -> bool:
    """Tell whether a reading that far from its prediction of variance S is to be believed; NaN and infinity are not."""
    return distance * distance <= model.gate * model.gate * S


def start_kalman(model: StateModel) -> NDArray[np.void]:
    """Return the state before the first reading, array of NOW (1,)."""
    now = np.zeros(1, dtype=NOW)
    now["index"] = now["hole"] = NEVER
    now["P"] = model.prior_P
    now["S"] = 1.0
    return now


@kernel()
def forget(now: Record, model: StateModel) -> None:
    """Return to the prior."""
    now.x, now.P, now.u = 0.0, model.prior_P, 0.0
    now.hole, now.windowed = NEVER, 0


@kernel()
def meet(now: Record, model: StateModel, index: int, z: float, status: int) -> tuple[int, bool, float, float]:
    """Bring the state up to just before a reading, across those that lack.

    Returns:
        The reading's status with ours; whether its value is to be used; mean and variance of its prediction without u.
    """
    flags = status
    has_value = flags & NO_VALUE == 0
    missing = index - now.index - 1 if now.index != NEVER else 0
    now.index = index
    if missing < 0:  # another acquisition: nothing is known of what lies between
        forget(now, model)
        flags |= RESTARTED
    elif missing > 0:
        now.x, now.P = predict(now.x, now.P, missing, model)
        now.run = 0
        now.hole += missing
        now.blind += missing
    if has_value and now.hole > model.restart_after and within_gate(z, model.prior_P, model):
        forget(now, model)
        flags |= RESTARTED
    m, M = predict(now.x, now.P, 1, model)
    usable = has_value and within_gate(z - m - now.u, M + model.R, model)
    if usable:
        now.run = now.run + 1 if now.hole >= 0 else 0
        now.hole = 0
    else:
        now.run = 0
        now.hole += 1
    return flags, usable, m, M


@kernel()
def log_density(now: Record, error: float, S: float) -> float:
    """Return the logarithm of the normal density of variance S at this error; its logarithm is kept while S lasts."""
    if now.S != S:
        now.S, now.log_S = S, math.log(S)
    log_S: float = now.log_S
    return -0.5 * (LOG_2PI + log_S + error * error / S)


@kernel()
def run_kalman(
    state: NDArray[np.void],
    model: StateModel,
    index: Ints,
    z: Floats,
    status: NDArray[np.uint32],
    out: NDArray[np.void],
) -> None:
    """Filter readings; `state` becomes that after the last, `out` (zeroed array of ESTIMATE) gets one row for each.

    m = phi x,  M = phi^2 P + Q,  K = M / (M + R),  x = m + K (z - m),  P = K R
    """
    now = state[0]
    for i in range(z.size):
        flags, usable, m, M = meet(now, model, index[i], z[i], status[i])
        if usable:
            out[i].log_likelihood = log_density(now, z[i] - m, M + model.R)
            K = M / (M + model.R)
            now.x, now.P = m + K * (z[i] - m), K * model.R
        else:
            now.x, now.P = m, M
            flags |= COASTED
        out[i].value_V = now.x
        out[i].sigma_V = math.sqrt(now.P)
        out[i].status = flags


class PassRule(NamedTuple):
    """What a pass is, and when they end."""

    likelihood_unit_V: float
    stored_prior: bool
    """A window's prior variance: of the estimate before it, else Q as eq. 5 prints."""
    smoothed: bool
    """E step by the smoother, else by the filter."""
    by_likelihood: bool
    """Stop by the expected likelihood, else by the disturbance."""
    delta: float
    r_max: int


class AemRule(NamedTuple):
    """How AEM chooses its window, and what it does with it."""

    windows: Ints
    """Window lengths, the longest first (eq. 17)."""
    thresholds: Floats
    """Spreads of slopes up to which each window but the last is chosen, in slope units."""
    curve: Floats
    """Rows that take recent readings, oldest first, to the coefficients of the fitted curve."""
    slopes: Floats
    """Rows that take those to the curve's slopes between neighbouring readings, per reading."""
    slope_unit_V: float
    coast: bool
    """Coast while the window holds a hole, else let the Kalman filter stand in."""
    passes: PassRule


class AemState(NamedTuple):
    """What AEM carries: the numbers of NOW, the last readings and estimates, and tables that depend on P alone.

    The rings are written twice, N apart, so that every window lies in one piece: slot p and slot p + N.
    """

    now: NDArray[np.void]
    z: Floats
    x: Floats
    P: Floats
    table: Floats
    """One table a window length, shape (windows, 5, longest window); see tabulate_filter and tabulate_smoother."""
    total: Floats
    """One row a window length, shape (windows, 7): P0 that the table is for (NaN: none yet), P, g, rho, q2, q0, h0."""
    scratch: Floats


def start_aem(model: StateModel, rule: AemRule) -> AemState:
    """Return the state before the first reading."""
    longest = int(rule.windows.max())
    slots = max(longest, rule.curve.shape[1]) + 1
    state = AemState(
        now=start_kalman(model),
        z=np.zeros(2 * slots),
        x=np.zeros(2 * slots),
        P=np.full(2 * slots, model.prior_P),
        table=np.zeros((rule.windows.size, 5, longest)),
        total=np.full((rule.windows.size, 7), np.nan),
        scratch=np.zeros(slots + 1),
    )
    state.now["blind"] = NEVER
    return state


@kernel(inline="always")
def slope_spread(z: Floats, end: int, curve: Floats, slopes: Floats, scratch: Floats) -> float:
    """Return the largest less the smallest slope between neighbours on the curve fitted to the readings before `end`.

    The paper means the slopes between any two points (after eq. 17). That of a chord is a mean of the neighbouring
    slopes that it spans, so the extremes are the same. The straight part of the curve adds one number to all slopes and
    is left out.
    """
    begin = end - curve.shape[1]
    for j in range(curve.shape[0]):
        coefficient = 0.0
        for i in range(curve.shape[1]):
            coefficient += curve[j, i] * z[begin + i]
        scratch[j] = coefficient
    low, high = np.inf, -np.inf
    for i in range(slopes.shape[0]):
        slope = 0.0
        for j in range(curve.shape[0]):
            slope += slopes[i, j] * scratch[j]
        low = min(low, slope)
        high = max(high, slope)
    return high - low


@kernel()
def likelihood_constant(v: int, variance_terms: float, model: StateModel, rule: PassRule) -> float:
    """Return the part of the expected log-likelihood that no pass changes: eq. 7 as printed, and the variances.

    Eq. 7, with n = d1 = d2 = 1 and L = v, in the paper's unit: -(1 + 2 (v + 2))/2 log 2 pi - v/2 log(Q + R). A Gaussian
    has v for v + 2, log Q + log R for log(Q + R), and log P0; it shifts the relative rule of eq. 16 a little, no more.
    """
    unit = rule.likelihood_unit_V * rule.likelihood_unit_V
    printed = (1.0 + 2.0 * (v + 2.0)) * LOG_2PI + v * math.log((model.Q + model.R) / unit)
    return -0.5 * (printed + variance_terms)


@kernel()
def tabulate_filter(P0: float, v: int, model: StateModel, rule: PassRule, table: Floats, total: Floats) -> None:
    """Fill the tables of a window whose E step is the Kalman filter's.

    With y_i the innovations for u = 0, those for another u are y_i - f_i u, with f_i = 1 + phi g_{i-1},
    g_i = (1 - K_i) phi g_{i-1} - K_i and g_0 = 0, and the estimate is x_i + g_i u. Hence the M step (eq. 15) is affine:
    mean(z_i - x_i) = a + rho u, with a = sum((1 - K_i) y_i) / v and rho = 1 - sum((1 - K_i) f_i) / v; and the sums of
    eq. 9 and 10 are sum(c_i (y_i - f_i u)^2) with c_i = K_i^2 / Q + (1 - K_i)^2 / R.

    Rows of the table: K, (1 - K) phi, (1 - K) / v, c f, c.
    """
    phi, Q, R = model.phi, model.Q, model.R
    P, g, rho, q2, variances = P0, 0.0, 1.0, 0.0, 1.0
    for i in range(v):
        M = phi * phi * P + Q
        K, left = M / (M + R), R / (M + R)  # left is 1 - K, without cancellation where M is large
        f = 1.0 + phi * g
        c = K * K / Q + left * left / R
        table[0, i] = K
        table[1, i] = left * phi
        table[2, i] = left / v
        table[3, i] = c * f
        table[4, i] = c
        rho -= left / v * f
        q2 -= 0.5 * c * f * f
        g = left * phi * g - K
        # E of (x_i - phi x_{i-1})^2 and (z_i - x_i - u)^2 beyond the means, with cov(x_i, x_{i-1}) = (1 - K) phi P.
        variances += (K * R + (phi * phi - 2.0 * phi * left * phi) * P) / Q + K
        P = K * R
    total[0], total[1], total[2], total[3], total[4], total[6] = P0, P, g, rho, q2, 0.0
    total[5] = likelihood_constant(v, variances, model, rule)


@kernel(inline="always")
def filter_window(
    x: float, z: Floats, begin: int, v: int, phi: float, table: Floats, j: int
) -> tuple[float, float, float, float]:
    """Return a, q1, q0 (less its constant) and the last x of a window's filter with u = 0; see tabulate_filter."""
    a = q1 = squares = 0.0
    for i in range(v):
        reading = z[begin + i]
        innovation = reading - phi * x
        x = table[j, 1, i] * x + table[j, 0, i] * reading
        a += table[j, 2, i] * innovation
        q1 += table[j, 3, i] * innovation
        squares += table[j, 4, i] * (innovation * innovation)
    return a, q1, -0.5 * squares, x


@kernel()
def tabulate_smoother(
    P0: float, v: int, model: StateModel, rule: PassRule, table: Floats, total: Floats, scratch: Floats
) -> None:
    """Fill the tables of a window whose E step is the Rauch-Tung-Striebel smoother's.

    Smoothed estimates are x_i + h_i u with h_v = g_v, h_i = g_i + C_i (h_{i+1} - phi g_i), i = 0..v, so the M step has
    rho = -mean(h_i), and eq. 8 to 10 are squares of (x_0 - prior) + h_0 u, d_i + (h_i - phi h_{i-1}) u and
    e_i - (1 + h_i) u.

    Rows of the table: K, (1 - K) phi, C_{i-1}, 1 + h_i, h_i - phi h_{i-1}.
    """
    phi, Q, R = model.phi, model.Q, model.R
    P, g = P0, 0.0
    for i in range(v):
        M = phi * phi * P + Q
        K, left = M / (M + R), R / (M + R)
        table[0, i] = K
        table[1, i] = left * phi
        table[2, i] = phi * P / M
        scratch[i] = g
        g = left * phi * g - K
        P = K * R
    total[0], total[1], total[2] = P0, P, g
    h, rho, q2, variances = g, 0.0, 0.0, 0.0
    for i in range(v - 1, -1, -1):
        C = table[2, i]
        P_before = P0 if i == 0 else table[0, i - 1] * R
        P_smoothed = P_before + C * C * (P - (phi * phi * P_before + Q))
        h_before = scratch[i] + C * (h - phi * scratch[i])
        table[3, i] = 1.0 + h
        table[4, i] = h - phi * h_before
        rho -= h / v
        q2 -= 0.5 * (table[3, i] * table[3, i] / R + table[4, i] * table[4, i] / Q)
        # Var(x_i - phi x_{i-1}) with the smoother's covariance C P_i, and Var(x_i), both given the whole window.
        variances += (P + phi * phi * P_smoothed - 2.0 * phi * C * P) / Q + P / R
        h, P = h_before, P_smoothed
    total[3], total[4], total[6] = rho, q2 - 0.5 * h * h / P0, h
    total[5] = likelihood_constant(v, variances + P / P0, model, rule)


@kernel()
def smooth_window(
    x0: float, z: Floats, model: StateModel, table: Floats, total: Floats, scratch: Floats
) -> tuple[float, float, float, float]:
    """Return a, q1, q0 (less its constant) and the last x of a window's smoother with u = 0; see tabulate_smoother."""
    scratch[0] = x0
    for i in range(z.size):
        scratch[i + 1] = table[1, i] * scratch[i] + table[0, i] * z[i]
    last = x = scratch[z.size]
    a = q1 = squares = 0.0
    for i in range(z.size - 1, -1, -1):
        before = scratch[i] + table[2, i] * (x - model.phi * scratch[i])
        d, e = x - model.phi * before, z[i] - x
        a += e / z.size
        q1 += table[3, i] * e / model.R - table[4, i] * d / model.Q
        squares += e * e / model.R + d * d / model.Q
        x = before
    start = x - x0
    return a, q1 - total[6] * start / total[0], -0.5 * (squares + start * start / total[0]), last


@kernel()
def stopping_pass(
    a: float, rho: float, q0: float, q1: float, q2: float, v: int, R: float, rule: PassRule
) -> tuple[float, int]:
    """Return u and r of the first pass that meets the stop rule, or of pass r_max.

    u_r = a + rho u_{r-1} from u_0 = 0, that is u* (1 - rho^r), also where rho = 1 and there is no u*. The expected
    log-likelihood is q0 + q1 u + q2 u^2, so its increment needs no difference of large numbers. Eq. 16 as printed
    depends on sign and unit of the likelihood; sizes are compared here.
    """
    u = 0.0
    for r in range(1, rule.r_max):
        new = a + rho * u
        if rule.by_likelihood:
            increment = (new - u) * (q1 + q2 * (new + u))
            stop = abs(increment) < rule.delta * abs(q0 + new * (q1 + q2 * new))
        else:
            stop = abs(new - u) < rule.delta * math.sqrt(R / v)
        u = new
        if stop:
            return u, r
    return a + rho * u, rule.r_max


@kernel(inline="always")
def maximise(
    z: Floats,
    x: Floats,
    P: Floats,
    table: Floats,
    total: Floats,
    scratch: Floats,
    end: int,
    v: int,
    j: int,
    model: StateModel,
    rule: PassRule,
) -> tuple[float, float, float, int]:
    """Return x, P, u and passes of the window of length v, number j, that ends before place `end` of the rings."""
    begin = end - v
    P0 = P[begin] if rule.stored_prior else model.Q
    if rule.smoothed:
        if total[j, 0] != P0:
            tabulate_smoother(P0, v, model, rule, table[j], total[j], scratch)
        a, q1, squares, last = smooth_window(x[begin], z[begin:end], model, table[j], total[j], scratch)
    else:
        if total[j, 0] != P0:
            tabulate_filter(P0, v, model, rule, table[j], total[j])
        a, q1, squares, last = filter_window(x[begin], z, begin, v, model.phi, table, j)
    u, passes = stopping_pass(a, total[j, 3], total[j, 5] + squares, q1, total[j, 4], v, model.R, rule)
    return last + total[j, 2] * u, total[j, 1], u, passes


@kernel()
def run_aem(
    state: AemState,
    model: StateModel,
    rule: AemRule,
    index: Ints,
    z: Floats,
    status: NDArray[np.uint32],
    out: NDArray[np.void],
) -> None:
    """Estimate; `state` becomes that after the last reading, `out` (zeroed array of ESTIMATE) gets one row for each.

    A window needs v readings without a hole (and the fitted curve its history), and an estimate before them: from the
    prior alone, which knows nothing, any disturbance would do, and passes would go on for ever. Until then the Kalman
    filter stands in: START_UP. After a hole the estimator coasts until a window is whole again, but not for more than
    `restart_after` readings.
    """
    now = state.now[0]
    z_ring, x_ring, P_ring, table, total, scratch = state.z, state.x, state.P, state.table, state.total, state.scratch
    windows, thresholds, curve, slopes = rule.windows, rule.thresholds, rule.curve, rule.slopes
    slots, history, passes = z_ring.size // 2, curve.shape[1], rule.passes
    for i in range(z.size):
        flags, usable, m, M = meet(now, model, index[i], z[i], status[i])
        p, end = now.slot, now.slot + slots + 1
        now.slot = p + 1 if p + 1 < slots else 0
        x_ring[p] = x_ring[p + slots] = now.x
        P_ring[p] = P_ring[p + slots] = now.P
        if usable:
            z_ring[p] = z_ring[p + slots] = z[i]
            out[i].log_likelihood = log_density(now, z[i] - m - now.u, M + model.R)

        j = 0
        if usable and 0 < history <= now.run:
            spread = slope_spread(z_ring, end, curve, slopes, scratch) / rule.slope_unit_V
            while j < thresholds.size and spread > thresholds[j]:
                j += 1
            out[i].spread = spread
        if usable and now.run >= max(windows[j], history):
            now.x, now.P, now.u, out[i].passes = maximise(
                z_ring, x_ring, P_ring, table, total, scratch, end, windows[j], j, model, passes
            )
            out[i].window = windows[j]
            now.blind, now.windowed = 0, 1
        elif usable and not (rule.coast and now.windowed == 1 and now.blind < model.restart_after):
            K = M / (M + model.R)
            now.x, now.P, now.u = m + K * (z[i] - m), K * model.R, 0.0
            now.blind = now.windowed = 0
            flags |= START_UP
        else:
            now.x, now.P = m, M
            now.blind += 1
            flags |= COASTED
        out[i].value_V = now.x
        out[i].sigma_V = math.sqrt(now.P)
        out[i].u_V = now.u
        out[i].status = flags
