"""The recursion of the interacting multiple model, to be compiled: arrays in, arrays out, a state that is carried on.

All functions stand in this one file because numba's cache notices a change only in the file of the function that is
called from outside. Nothing is reordered or fused by the compiler (no fastmath), so the bits of a result depend on the
readings alone, not on how the stream was cut. No divisor can be 0 (every variance of a reading is above 0, every
probability at least IMPOSSIBLE), so none is checked for it.

Letters (Blom and Bar-Shalom, IEEE Trans. Automatic Control 33, 780, 1988):

    x, P   state of a mode, V, and its covariance, V^2: pairs (component and its quadrature), the slow part last
    R      variance of a reading about the state, V^2, in mode 0 (quiet) and 1 (disturbed)
    mu     probability of each mode
    e, S   innovation, V, and its variance, V^2

A function takes `pairs`, a tuple of zeros as long as there are pairs: the length of a tuple is known to the compiler,
which then unrolls the loops over the state. That is worth a factor of two.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aemd.block import ESTIMATE, NOT_A_VALUE, Status
from aemd.estimate.compiled import choose, kernel

__all__ = ["ImmModel", "ImmState", "drain_imm", "run_imm", "start_imm"]

Floats = NDArray[np.float64]

COASTED, RESTARTED = int(Status.COASTED), int(Status.RESTARTED)
NO_VALUE = NOT_A_VALUE
NEVER = -(2**62)  # a reading's number where there has been none
LOG_ROOT_2PI = 0.5 * math.log(2.0 * math.pi)
Z95 = 1.959963984540054  # a Gaussian is within this many standard deviations 95 % of the time
NOTHING_KNOWN_V = 1000.0  # of an estimate before the first reading: the meter's largest range
IMPOSSIBLE = 1e-30  # least probability of a mode: 0 would be divided by where a mode is always left at once
LEAST_FACTOR = 1e-6  # readings that repeat to the last digit leave no errors to go by
SURE = 1e-3  # a mode less probable than this moves the 95 % interval by less than one part in 200
KNOTS = 32  # of the table of the Gaussian, per standard deviation
FAR = 8.0  # standard deviations; beyond, 1e-15 is as good as the tail

GAUSSIAN = np.array(
    [
        (0.5 * math.erfc(k / KNOTS / math.sqrt(2.0)), math.exp(-0.5 * (k / KNOTS) ** 2 - LOG_ROOT_2PI))
        for k in range(int(FAR * KNOTS) + 1)
    ]
)
"""Upper tail and density of the standard Gaussian at k / KNOTS, shape (knots, 2)."""

NOW = np.dtype(
    [
        ("index", "<i8"),  # of the last reading, NEVER before the first
        ("hole", "<i8"),  # steps since the last reading that was taken in
        ("disturbed", "<i8"),  # readings in a row whose mode is probably the disturbed one
        ("held", "<i8"),  # estimates that the lag holds back
        ("slot", "<i8"),  # where the next one goes; the oldest is there once the ring is full
        ("origin", "<f8"),  # V; NaN until a reading has set it
        ("factor", "<f8"),  # of all variances of the quiet mode, as followed
    ]
)
"""What is carried from reading to reading, beside the modes."""


class ImmModel(NamedTuple):
    """The state model and its two noises, per reading."""

    cos: Floats
    """rho cos(theta) of each pair, shape (m,)."""
    sin: Floats
    """rho sin(theta)."""
    Q: Floats
    """Process noise of each, V^2."""
    drive: Floats
    """Noise that all pairs have in common, both components of each, V, shape (2 m,)."""
    start: Floats
    """Stationary variance of each, V^2."""
    slow_phi: float
    slow_Q: float
    slow_start: float
    R: Floats
    """V^2, shape (2,)."""
    leave: Floats
    """Probability of leaving mode 0 and mode 1 before the next reading, shape (2,)."""
    slow_is_input: int
    """1 where the slow part is of the input, else 0."""
    is_input: Floats
    """1 of each pair that is of the input, 0 of a disturbance, shape (m,)."""
    origin: float
    """V; NaN: the first reading with a value."""
    gate: float
    restart_after: int
    longest_disturbance: int
    forgetting: float
    """Weight of one reading in the factor of the variances; 0: the factor is 1."""


class Held(NamedTuple):
    """The inputs that the lag holds back, in each mode: a ring whose places are those of ImmState.rows."""

    mean: Floats
    """About the origin, V, shape (2, lag + 1)."""
    variance: Floats
    """V^2, shape (2, lag + 1)."""
    cross: Floats
    """Covariance with the present state, V^2, shape (2, lag + 1, n)."""


class ImmState(NamedTuple):
    """What is carried: the modes, and the estimates that the lag holds back."""

    now: NDArray[np.void]
    x: Floats
    P: Floats
    mu: Floats
    held: Held
    rows: NDArray[np.void]
    """As they were when their reading came, array of ESTIMATE (lag + 1,); value_V is the origin, NaN if there was none,
    and u_V the reading less its noise, about the origin (of a reading that was not taken in: u itself)."""
    scratch: Floats
    """P H' of each mode, shape (2, n)."""


def start_imm(model: ImmModel, lag: int) -> ImmState:
    """Return the state before the first reading."""
    n = 2 * model.cos.size + 1
    now = np.zeros(1, dtype=NOW)
    now["index"] = NEVER
    now["origin"] = model.origin
    state = ImmState(
        now=now,
        x=np.zeros((2, n)),
        P=np.zeros((2, n, n)),
        mu=np.zeros(2),
        held=Held(np.zeros((2, lag + 1)), np.zeros((2, lag + 1)), np.zeros((2, lag + 1, n))),
        rows=np.zeros(lag + 1, dtype=ESTIMATE),
        scratch=np.zeros((2, n)),
    )
    choose(forget, 0, few=1)(state, model)
    return state


@kernel(error_model="numpy")
def forget(state: ImmState, model: ImmModel) -> None:
    """Return to what is known before any reading: the stationary law of every part, whatever the mode."""
    n = state.x.shape[1]
    now = state.now[0]
    now.hole = now.disturbed = 0
    now.origin = model.origin
    now.factor = 1.0
    state.x[:] = 0.0
    state.P[:] = 0.0
    state.held.cross[:] = 0.0
    for j in range(2):
        for i in range(model.cos.size):
            state.P[j, 2 * i, 2 * i] = state.P[j, 2 * i + 1, 2 * i + 1] = model.start[i]
        state.P[j, n - 1, n - 1] = model.slow_start
        state.mu[j] = model.leave[1 - j] / (model.leave[0] + model.leave[1])


@kernel(error_model="numpy")
def mixing_shares(mu: Floats, leave: Floats) -> tuple[float, float, float, float]:
    """Return the modes' probabilities at the next reading, and the share of mode 1 in what each then starts from.

    mu'_j = sum_i mu_i p_ij, and the share is mu_1 p_1j / mu'_j.
    """
    new0 = mu[0] * (1.0 - leave[0]) + mu[1] * leave[1]
    new1 = mu[0] * leave[0] + mu[1] * (1.0 - leave[1])
    return new0, new1, mu[1] * leave[1] / new0, mu[1] * (1.0 - leave[1]) / new1


@kernel(error_model="numpy")
def mix(pairs: tuple[int, ...], x: Floats, P: Floats, gap: Floats, a: float, b: float) -> None:
    """Give mode 0 mean and covariance of the mixture with share a of mode 1, mode 1 with b; x_0 - x_1 goes to `gap`."""
    n = 2 * len(pairs) + 1
    aa, bb = a * (1.0 - a), b * (1.0 - b)
    for r in range(n):
        gap[r] = x[0, r] - x[1, r]
    for r in range(n):
        for c in range(r, n):
            square, quiet, step = gap[r] * gap[c], P[0, r, c], P[1, r, c] - P[0, r, c]
            P[0, r, c] = P[0, c, r] = quiet + a * step + aa * square
            P[1, r, c] = P[1, c, r] = quiet + b * step + bb * square
    for r in range(n):
        x[1, r] = x[0, r] - b * gap[r]
        x[0, r] -= a * gap[r]


@kernel(error_model="numpy")
def mix_held(held: Held, count: int, slot: int, gap: Floats, a: float, b: float) -> None:
    """Do the same to the held inputs and their covariance with the state."""
    aa, bb = a * (1.0 - a), b * (1.0 - b)
    mean, variance, cross = held
    for i in range(count):
        s = (slot - 1 - i) % mean.shape[1]
        distance = mean[0, s] - mean[1, s]
        quiet, step = variance[0, s], variance[1, s] - variance[0, s]
        variance[0, s] = quiet + a * step + aa * distance * distance
        variance[1, s] = quiet + b * step + bb * distance * distance
        mean[1, s] = mean[0, s] - b * distance
        mean[0, s] -= a * distance
        for r in range(gap.size):
            quiet, step = cross[0, s, r], cross[1, s, r] - cross[0, s, r]
            cross[0, s, r] = quiet + a * step + aa * distance * gap[r]
            cross[1, s, r] = quiet + b * step + bb * distance * gap[r]


@kernel(error_model="numpy")
def predict(
    pairs: tuple[int, ...],
    x: Floats,
    P: Floats,
    j: int,
    cos: Floats,
    sin: Floats,
    Q: Floats,
    drive: Floats,
    phi: float,
    slow_Q: float,
) -> None:
    """Take mode j one reading on: x <- F x, P <- F P F' + Q + drive drive'.

    F turns and shrinks the pairs, and shrinks the slow part.
    """
    m, last = len(pairs), 2 * len(pairs)
    for i in range(m):
        r, co, si = 2 * i, cos[i], sin[i]
        x[j, r], x[j, r + 1] = co * x[j, r] - si * x[j, r + 1], si * x[j, r] + co * x[j, r + 1]
        for c in range(last + 1):
            P[j, r, c], P[j, r + 1, c] = co * P[j, r, c] - si * P[j, r + 1, c], si * P[j, r, c] + co * P[j, r + 1, c]
    x[j, last] *= phi
    for c in range(last + 1):
        P[j, last, c] *= phi
    for i in range(m):
        c, co, si = 2 * i, cos[i], sin[i]
        for r in range(last + 1):
            P[j, r, c], P[j, r, c + 1] = co * P[j, r, c] - si * P[j, r, c + 1], si * P[j, r, c] + co * P[j, r, c + 1]
        P[j, c, c] += Q[i]
        P[j, c + 1, c + 1] += Q[i]
    for r in range(last):
        for c in range(last):
            P[j, r, c] += drive[r] * drive[c]
    for r in range(last + 1):
        P[j, r, last] *= phi
    P[j, last, last] += slow_Q


@kernel(error_model="numpy")
def predict_held(
    pairs: tuple[int, ...], cross: Floats, count: int, slot: int, cos: Floats, sin: Floats, phi: float
) -> None:
    """Take the covariance of the held inputs with the state one reading on: C <- C F'."""
    m, last = len(pairs), 2 * len(pairs)
    for i in range(count):
        s = (slot - 1 - i) % cross.shape[1]
        for j in range(2):
            for p in range(m):
                r, co, si = 2 * p, cos[p], sin[p]
                first, second = cross[j, s, r], cross[j, s, r + 1]
                cross[j, s, r], cross[j, s, r + 1] = co * first - si * second, si * first + co * second
            cross[j, s, last] *= phi


@kernel(error_model="numpy")
def expect(pairs: tuple[int, ...], x: Floats, P: Floats, PH: Floats, j: int, z: float, R: float) -> tuple[float, float]:
    """Return e = z - H x and S = H P H' + R of mode j, H being the sum of all parts; leave P H' in row j of `PH`."""
    m, last = len(pairs), 2 * len(pairs)
    for r in range(last + 1):
        PH[j, r] = P[j, r, last]
        for i in range(m):
            PH[j, r] += P[j, r, 2 * i]
    e, S = z - x[j, last], PH[j, last] + R
    for i in range(m):
        e -= x[j, 2 * i]
        S += PH[j, 2 * i]
    return e, S


@kernel(error_model="numpy")
def update(pairs: tuple[int, ...], x: Floats, P: Floats, PH: Floats, j: int, e: float, inverse_S: float) -> None:
    """Take a reading into mode j: x <- x + K e, P <- P - K S K', K = P H' / S."""
    n = 2 * len(pairs) + 1
    for r in range(n):
        K = PH[j, r] * inverse_S
        x[j, r] += K * e
        for c in range(r, n):
            P[j, r, c] = P[j, c, r] = P[j, r, c] - K * PH[j, c]


@kernel(error_model="numpy")
def update_held(
    pairs: tuple[int, ...], held: Held, count: int, slot: int, PH: Floats, j: int, e: float, inverse_S: float
) -> None:
    """Take a reading into the held inputs of mode j, by their covariance with the state."""
    m, last = len(pairs), 2 * len(pairs)
    mean, variance, cross = held
    for i in range(count):
        s = (slot - 1 - i) % mean.shape[1]
        CH = cross[j, s, last]
        for p in range(m):
            CH += cross[j, s, 2 * p]
        K = CH * inverse_S
        mean[j, s] += K * e
        variance[j, s] -= K * CH
        for r in range(last + 1):
            cross[j, s, r] -= K * PH[j, r]


@kernel(error_model="numpy", inline="always")
def hold(
    pairs: tuple[int, ...], held: Held, slot: int, x: Floats, P: Floats, slow_is_input: int, is_input: Floats
) -> None:
    """Put the present input into a slot, its mean, variance and covariance with the state in each mode."""
    m, last = len(pairs), 2 * len(pairs)
    mean, variance, cross = held
    for j in range(2):
        for r in range(last + 1):
            cross[j, slot, r] = P[j, r, last] if slow_is_input else 0.0
            for i in range(m):
                cross[j, slot, r] += is_input[i] * P[j, r, 2 * i]
        mean[j, slot] = x[j, last] if slow_is_input else 0.0
        variance[j, slot] = cross[j, slot, last] if slow_is_input else 0.0
        for i in range(m):
            mean[j, slot] += is_input[i] * x[j, 2 * i]
            variance[j, slot] += is_input[i] * cross[j, slot, 2 * i]


@kernel(error_model="numpy")
def tail(t: float) -> tuple[float, float]:
    """Return upper tail and density of the standard Gaussian: the series about a knot below, to 2e-8 and 2e-7.

    The interval below asks for four of them at each step; erf and exp would take two thirds of the filter's time.
    """
    size = min(abs(t), FAR)
    knot = int(size * KNOTS)
    at = knot / KNOTS
    s, density = size - at, GAUSSIAN[knot, 1]
    above = GAUSSIAN[knot, 0] - density * s * (1.0 - s * (0.5 * at - s * (at * at - 1.0) / 6.0))
    return above if t >= 0.0 else 1.0 - above, density * (1.0 - s * (at - s * 0.5 * (at * at - 1.0)))


@kernel(error_model="numpy")
def beyond(h: float, d: float, inverse_sd: float) -> tuple[float, float, float]:
    """Return how probably a Gaussian about d is not within +-h, minus its derivative by h, and its second one."""
    a, b = (h - d) * inverse_sd, (h + d) * inverse_sd
    above, density_a = tail(a)
    below, density_b = tail(b)
    fall = (density_a + density_b) * inverse_sd
    return above + below, fall, (a * density_a + b * density_b) * inverse_sd * inverse_sd


@kernel(error_model="numpy")
def merge(
    mu0: float, mu1: float, mean0: float, mean1: float, variance0: float, variance1: float
) -> tuple[float, float]:
    """Return the mean of the mixture of both modes, and half its 95 % interval about that mean over 1.96.

    The mixture has a narrow core and rare wide wings. Its standard deviation follows the wings, and an interval of
    +-1.96 of those would hold the truth far more often than 95 % of the time. Halley's method, kept within a bracket;
    a step of a tenth of the narrower mode's width leaves less than a thousandth of the interval.
    """
    value = mu0 * mean0 + mu1 * mean1
    d0, d1 = abs(mean0 - value), abs(mean1 - value)
    sd0, sd1 = math.sqrt(max(variance0, 0.0)), math.sqrt(max(variance1, 0.0))
    if mu1 < SURE or sd0 == 0.0:
        return value, sd0
    if mu0 < SURE or sd1 == 0.0:
        return value, sd1
    inverse0, inverse1, near = 1.0 / sd0, 1.0 / sd1, 0.1 * min(sd0, sd1)
    low, high = 0.0, max(d0 + Z95 * sd0, d1 + Z95 * sd1)
    h = min(high, Z95 * math.sqrt(mu0 * (variance0 + d0 * d0) + mu1 * (variance1 + d1 * d1)))
    for _ in range(50):
        out0, fall0, bend0 = beyond(h, d0, inverse0)
        out1, fall1, bend1 = beyond(h, d1, inverse1)
        excess = mu0 * out0 + mu1 * out1 - 0.05
        fall, bend = mu0 * fall0 + mu1 * fall1, mu0 * bend0 + mu1 * bend1
        if excess > 0.0:
            low = h
        else:
            high = h
        curved = 2.0 * fall * fall - excess * bend
        step = 2.0 * excess * fall / curved if curved > 0.0 else math.inf
        within = low <= h + step <= high
        h = h + step if within else 0.5 * (low + high)
        if (within and abs(step) < near) or high - low < 1e-3 * h:
            break
    return value, h / Z95


@kernel(error_model="numpy")
def rest(pairs: tuple[int, ...], x: Floats, j: int, z: float) -> float:
    """Return what the state of mode j leaves of a reading, z - H x."""
    left = z - float(x[j, 2 * len(pairs)])
    for i in range(len(pairs)):
        left -= x[j, 2 * i]
    return left


@kernel(error_model="numpy", inline="always")
def release(
    rows: NDArray[np.void], held: Held, mu: Floats, factor: float, slot: int, out: NDArray[np.void], place: int
) -> None:
    """Write the estimate in a slot of the ring to a place of `out`, as all readings so far see it."""
    row, estimate = rows[slot], out[place]
    mean, variance, _ = held
    value, sigma = merge(
        mu[0], mu[1], mean[0, slot], mean[1, slot], factor * variance[0, slot], factor * variance[1, slot]
    )
    estimate.index, estimate.t_ns, estimate.status = row.index, row.t_ns, row.status
    estimate.window, estimate.passes, estimate.spread, estimate.log_likelihood = 0, 0, 0.0, row.log_likelihood
    estimate.u_V = row.u_V if row.status & COASTED else row.u_V - value
    estimate.value_V, estimate.sigma_V = row.value_V + value, sigma
    if math.isnan(row.value_V):
        estimate.value_V, estimate.sigma_V = 0.0, NOTHING_KNOWN_V


@kernel(error_model="numpy")
def run_imm(
    pairs: tuple[int, ...],
    state: ImmState,
    model: ImmModel,
    index: NDArray[np.int64],
    t_ns: NDArray[np.int64],
    z: Floats,
    status: NDArray[np.uint32],
    out: NDArray[np.void],
) -> int:
    """Estimate; `state` becomes that after the last reading; return how many rows of `out` (ESTIMATE) are filled."""
    # One array each: a tuple of arrays costs a count of references up and down at every call.
    x, P, mu, held, rows, PH = state.x, state.P, state.mu, state.held, state.rows, state.scratch
    cos, sin, Q, R, leave, drive = model.cos, model.sin, model.Q, model.R, model.leave, model.drive
    phi, slow_Q, is_input = model.slow_phi, model.slow_Q, model.is_input
    now, last = state.now[0], 2 * len(pairs)
    released = 0
    for k in range(z.size):
        flags = status[k]
        missing = index[k] - now.index - 1 if now.index != NEVER else 0
        now.index = index[k]
        if missing < 0 or now.hole + missing > model.restart_after or now.disturbed > model.longest_disturbance:
            forget(state, model)
            flags |= RESTARTED
            missing = 0
        for _ in range(missing + 1):
            p0, p1, a, b = mixing_shares(mu, leave)
            mix(pairs, x, P, PH[0], a, b)
            predict(pairs, x, P, 0, cos, sin, Q, drive, phi, slow_Q)
            predict(pairs, x, P, 1, cos, sin, Q, drive, phi, slow_Q)
            mu[0], mu[1] = p0, p1
            if now.held > 0:
                mix_held(held, now.held, now.slot, PH[0], a, b)
                predict_held(pairs, held.cross, now.held, now.slot, cos, sin, phi)
        now.hole += missing

        has_value = flags & NO_VALUE == 0 and math.isfinite(z[k])
        if has_value and math.isnan(now.origin):
            now.origin = z[k]
        y = z[k] - now.origin if has_value else 0.0
        inverse_factor = 1.0 / now.factor
        R1 = R[0] + (R[1] - R[0]) * inverse_factor
        e0, S0 = expect(pairs, x, P, PH, 0, y, R[0])
        e1, S1 = expect(pairs, x, P, PH, 1, y, R1)
        likelihood = 0.0
        if has_value and e1 * e1 <= model.gate * model.gate * S1 * now.factor:
            # Divisions are a third of the filter's time: one for each mode, and one for their weights.
            inverse0, inverse1 = 1.0 / S0, 1.0 / S1
            update(pairs, x, P, PH, 0, e0, inverse0)
            update(pairs, x, P, PH, 1, e1, inverse1)
            if now.held > 0:
                update_held(pairs, held, now.held, now.slot, PH, 0, e0, inverse0)
                update_held(pairs, held, now.held, now.slot, PH, 1, e1, inverse1)
            # Bayes' rule; the larger exponent is taken out first, so that not both densities can underflow.
            square = e0 * e0 * inverse0
            g0, g1 = -0.5 * square * inverse_factor, -0.5 * e1 * e1 * inverse1 * inverse_factor
            g, less = max(g0, g1), math.exp(-abs(g0 - g1))
            p0 = mu[0] * math.sqrt(inverse0) * (1.0 if g0 >= g1 else less)
            p1 = mu[1] * math.sqrt(inverse1) * (less if g0 >= g1 else 1.0)
            share = 1.0 / (p0 + p1)
            mu[0], mu[1] = max(p0 * share, IMPOSSIBLE), max(p1 * share, IMPOSSIBLE)
            likelihood = math.log((p0 + p1) * math.sqrt(inverse_factor)) + g - LOG_ROOT_2PI
            # The reading less its noise: in each mode the noise has its share of what the state leaves.
            u = y - mu[0] * rest(pairs, x, 0, y) - mu[1] * rest(pairs, x, 1, y) * (R[0] / R1)
            now.factor = max(now.factor + model.forgetting * mu[0] * (square - now.factor), LEAST_FACTOR)
            now.hole = 0
            now.disturbed = now.disturbed + 1 if mu[1] > 0.5 else 0
        else:
            u = 0.0 if model.slow_is_input else mu[0] * x[0, last] + mu[1] * x[1, last]
            for i in range(len(pairs)):
                u += (1.0 - is_input[i]) * (mu[0] * x[0, 2 * i] + mu[1] * x[1, 2 * i])
            flags |= COASTED
            now.hole += 1

        slot = now.slot
        hold(pairs, held, slot, x, P, model.slow_is_input, is_input)
        row = rows[slot]
        row.index, row.t_ns, row.status, row.log_likelihood = index[k], t_ns[k], flags, likelihood
        row.value_V, row.u_V = now.origin, u
        now.slot = slot + 1 if slot + 1 < rows.size else 0
        now.held += 1
        if now.held == rows.size:
            release(rows, held, mu, now.factor, now.slot, out, released)
            now.held -= 1
            released += 1
    return released


@kernel(error_model="numpy")
def drain_imm(state: ImmState, out: NDArray[np.void]) -> int:
    """Write the estimates that the lag still holds back, the oldest first; return how many."""
    now, size = state.now[0], state.rows.size
    waiting = int(now.held)
    for i in range(waiting):
        release(state.rows, state.held, state.mu, now.factor, (now.slot - waiting + i) % size, out, i)
    now.held = 0
    return waiting
