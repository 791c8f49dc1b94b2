"""The exact likelihood of a sum of Markov processes in white noise, with shocks as a mixture inside the filter.

Readings y_k at steps h_k obey

    y_k = mean_k + scale_k H x_k + noise_k,   x_k = F(h_k) x_{k-1} + process noise,

where x stacks first-order processes, swinging pairs and short memories. With shocks, each step has two hypotheses, a
jump of variance A^2 in the shock's states or none; with tails, each reading has as many again per further noise. The
filter keeps one Gaussian: the mixture's mean and covariance. All hypotheses move the mean along one of two directions,
with the jump or without, so collapsing costs three outer products however many there are. A bent scale, y = x + b x^2,
is met by its slope at the prediction. A gain that flickers, y = x (1 + f n), is a mixture, too: of what n may be, given
which all is linear. Its variance alone, f^2 (E x)^2, would leave out what is not known of x, and all of its tails.

Of a reading that was rounded, clipped or held by a dead band only an interval is known. Each hypothesis then has the
probability of the interval in place of a density, and its update the mean and variance of a normal law cut to it.

Besides the log-likelihood the kernel returns for each reading what the checks are made of: the predicted mean, the
variance of the undisturbed hypothesis, and the probability integral transform of the reading under the predicted
mixture as a standard normal z; of an interval, that of an even choice within it. If the model is right, z is a sequence
of independent N(0, 1).

All that is compiled stands in this one file, because numba's cache notices a change only in the file of the function
that is called from outside. A division by zero gives what numpy's gives: to look for one at every division, as Python
does, is a third of the filter's work, and what is not finite is met where the densities are summed.
"""

from math import cos, erf, erfc, exp, log, pi, sin, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import ndtri

__all__ = [
    "MARKOV",
    "PAIR",
    "PAIR_SECOND",
    "PREVIOUS",
    "WHITE",
    "colour",
    "follow_telegraph",
    "log_densities",
    "predict",
    "telegraph_densities",
    "whiten",
]

Floats = NDArray[np.float64]

# Kinds of a state, column 0 of the table of states; its other columns are tau_s, omega_rad_per_s, rate (standard
# deviation for all but MARKOV), standard deviation before the first reading, weight in the reading.
MARKOV = 0
"""dx = -x/tau dt + rate dW; tau may be infinite."""
PAIR = 1
"""First of two that swing into each other at omega and decay with tau; the rate is the stationary deviation."""
PAIR_SECOND = 2
"""The other one."""
WHITE = 3
"""Drawn anew at each reading."""
PREVIOUS = 4
"""What the state before it in the table was at the reading before, an interval ago; where a reading was lost between,
that was another. Its tau_s is the longest step that is one, its rate the deviation of what it is then."""

_MOST = 40  # states; the size of the work space
_STEEP = 500.0  # logarithm of odds from which they are taken relative to the likeliest, lest they overflow
_AGES = 3
"""Readings since the last jump that are told apart, the last for all longer ones. Against 20, on records of 1,500 to
9,000 readings with jumps of three deviations, 3 lose up to 0.6 nats of a likelihood, 2 up to 3."""
_FLICKERS, _FLICKER_SHARES = np.polynomial.hermite_e.hermegauss(11)
_FLICKER_SHARES = _FLICKER_SHARES / _FLICKER_SHARES.sum()
"""Normal numbers, and their probabilities, that a gain that flickers has: the moments of the normal law up to the
21st."""
_SMOOTH = 1.5
"""Distance of two such readings in deviations of each up to which their sum has no ripple."""
_LEAST_SMOOTHED = 0.02
_NEGLIGIBLE = 1e-4
"""Probability of a history from which it is dropped; a jump a moment later brings it back."""


@njit(cache=True, error_model="numpy")
def transition(step_s: float, states: Floats, keep: Floats, turn: Floats, noise: Floats) -> None:
    """Fill what a step does to each state: factor, coupling to its partner, variance added."""
    for i in range(states.shape[0]):
        kind, tau, omega, rate = states[i, 0], states[i, 1], states[i, 2], states[i, 3]
        turn[i] = 0.0
        if kind == MARKOV:
            a = step_s / tau
            keep[i] = exp(-a)
            noise[i] = rate * rate * step_s * (1.0 if a < 1e-9 else (1.0 - exp(-2.0 * a)) / (2.0 * a))
        elif kind in (PAIR, PAIR_SECOND):
            fade = exp(-step_s / tau)
            keep[i] = fade * cos(omega * step_s)
            turn[i] = fade * sin(omega * step_s)
            noise[i] = rate * rate * (1.0 - fade * fade)
        elif kind == WHITE:
            keep[i] = 0.0
            noise[i] = rate * rate
        else:
            next_to = step_s < tau
            keep[i] = 0.0
            turn[i] = 1.0 if next_to else 0.0
            noise[i] = 0.0 if next_to else rate * rate


@njit(cache=True, error_model="numpy")
def advance_vector(states: Floats, keep: Floats, turn: Floats, x: Floats) -> None:
    """Apply the step to a vector, in place."""
    i = states.shape[0] - 1
    while i >= 0:
        kind = states[i, 0]
        if kind == PAIR_SECOND:
            first, second = x[i - 1], x[i]
            x[i - 1] = keep[i - 1] * first + turn[i - 1] * second
            x[i] = keep[i] * second - turn[i] * first
            i -= 2
        elif kind == PREVIOUS:
            x[i] = turn[i] * x[i - 1]
            i -= 1
        else:
            x[i] *= keep[i]
            i -= 1


@njit(cache=True, error_model="numpy")
def _advance_covariance(states: Floats, keep: Floats, turn: Floats, noise: Floats, p: Floats, work: Floats) -> None:
    """Apply the step to a covariance, in place: to its columns, then to its rows; `work` holds one of them."""
    m = states.shape[0]
    for j in range(m):
        for i in range(m):
            work[i] = p[i, j]
        advance_vector(states, keep, turn, work)
        for i in range(m):
            p[i, j] = work[i]
    for i in range(m):
        for j in range(m):
            work[j] = p[i, j]
        advance_vector(states, keep, turn, work)
        for j in range(m):
            p[i, j] = work[j]
    for i in range(m):
        p[i, i] += noise[i]


@njit(cache=True, error_model="numpy")
def _within(a: float, b: float) -> float:
    """Return the probability that a standard normal number is between a and b, a <= b; in a tail to all digits."""
    if a > 0.0:
        return 0.5 * (erfc(a / sqrt(2.0)) - erfc(b / sqrt(2.0)))
    return 0.5 * (erfc(-b / sqrt(2.0)) - erfc(-a / sqrt(2.0)))


@njit(cache=True, error_model="numpy")
def _cut(a: float, b: float, inside: float) -> tuple[float, float]:
    """Return mean and variance of a standard normal number between a and b, given the probability of that.

    Beyond 37 deviations the probability is 0 in floating point; then all of it is at the nearer end.
    """
    if inside < 1e-300:
        return (a if a > 0.0 else b), 0.0
    low, high = exp(-0.5 * a * a) / sqrt(2.0 * pi), exp(-0.5 * b * b) / sqrt(2.0 * pi)
    mean = (low - high) / inside
    bend = 0.0
    if low > 0.0:
        bend += a * low
    if high > 0.0:
        bend -= b * high
    return mean, min(max(1.0 + bend / inside - mean * mean, 0.0), 1.0)


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp", "nsz"})
def _filter(
    y: Floats,
    used: NDArray[np.bool_],
    step_s: Floats,
    mean: Floats,
    noise_var: Floats,
    scale: Floats,
    states: Floats,
    shocks: Floats,
    extras: Floats,
    low: Floats,
    high: Floats,
    chance: Floats,
    each: Floats,
    cdf: Floats,
    predicted: Floats,
    variance: Floats,
    gains: Floats,
) -> float:
    """Run the filter; see `log_densities` and `predict` for the arguments.

    `chance` holds even numbers in (0, 1), one a reading, that place z within an interval. `each` and the arrays after
    it are filled if they have the readings' length, and left alone if they are empty.
    """
    m, n = states.shape[0], y.size
    keep, turn, noise = np.zeros(_MOST), np.zeros(_MOST), np.zeros(_MOST)
    x, p, column, work = np.zeros(m), np.zeros((m, m)), np.zeros(m), np.zeros(m)
    before = np.zeros((m, m))
    for i in range(m):
        p[i, i] = states[i, 4] ** 2
    shock_at, bias = int(shocks[2]), extras[5]
    struck = np.zeros(m)
    jump_var, weight_at = 0.0, 0.0
    if shock_at >= 0:
        jump_var = shocks[1]
        struck[shock_at] = 1.0
        for i in range(min(m, shocks.size - 3)):
            struck[i] = shocks[3 + i]
        for i in range(m):
            weight_at += states[i, 5] * struck[i]
    # Noises of a reading, the usual one first; each is a hypothesis without a jump and one with it.
    noises = 1 + (1 if extras[2] > 0.0 else 0) + (extras.size - 6) // 2
    share, added = np.zeros(noises), np.zeros(noises)
    at = 1
    if extras[2] > 0.0:
        share[at], added[at] = extras[2], extras[3]
        at += 1
    for j in range((extras.size - 6) // 2):
        share[at + j], added[at + j] = extras[6 + 2 * j], extras[7 + 2 * j]
    share[0] = 1.0 - share.sum()
    spread, inverse, odds = np.zeros(2 * noises), np.zeros(2 * noises), np.zeros(2 * noises)
    # At the first reading stands what is left of a shock before it, if one was within its decay.
    jump, jump_step = (1.0 - exp(-shocks[0] * states[shock_at, 1]) if shock_at >= 0 else 0.0), -1.0
    jumped, moved = np.zeros(m), np.zeros(m)
    flickering = np.zeros((4, 2 * noises * _FLICKERS.size if extras[0] < 0.0 else 0))
    diagonal = True
    for i in range(m):
        if states[i, 0] != MARKOV:
            diagonal = False
    plain = shock_at < 0 and extras[0] == 0.0 and extras[1] == 0.0 and noises == 1 and low.size == 0
    frozen, last_step, s_frozen, log_s, last_noise, last_scale = False, -1.0, 0.0, 0.0, -1.0, 1.0
    total = 0.0
    root_two_pi = 0.5 * log(2.0 * pi)
    for k in range(n):
        h = step_s[k]
        if h != last_step:
            transition(h, states, keep, turn, noise)
            last_step = h
            frozen = False
        if k > 0:
            if h != jump_step:
                jump_step = h
                jump = 1.0 - exp(-shocks[0] * h) if shock_at >= 0 else 0.0
            if diagonal:
                for i in range(m):
                    x[i] *= keep[i]
            else:
                advance_vector(states, keep, turn, x)
            if not frozen:
                if diagonal:
                    for i in range(m):
                        for j in range(i + 1):
                            p[i, j] *= keep[i] * keep[j]
                            p[j, i] = p[i, j]
                        p[i, i] += noise[i]
                else:
                    _advance_covariance(states, keep, turn, noise, p, work)
        state = 0.0
        for i in range(m):
            state += states[i, 5] * x[i]
        guess = mean[k] + scale[k] * (state + extras[1] * state * state)
        slope = scale[k] * (1.0 + 2.0 * extras[1] * state)
        r = noise_var[k] + max(extras[0], 0.0) * (state + extras[4]) ** 2
        if predicted.size:
            predicted[k] = guess
        if frozen and r == last_noise and scale[k] == last_scale:
            s = s_frozen
        else:
            if frozen:
                frozen = False
            s = r
            for i in range(m):
                c = 0.0
                for j in range(m):
                    c += states[j, 5] * p[i, j]
                column[i] = c * slope
                s += states[i, 5] * c * slope * slope
            log_s = 0.5 * log(s)
        whole = guess + extras[4]  # where a gain flickers, what it multiplies
        if variance.size:
            variance[k] = s if extras[0] >= 0.0 else s - extras[0] * (whole * whole + s)
        if not used[k]:
            frozen = False
            if gains.size:
                for i in range(m):
                    gains[k, i] = 0.0
            if shock_at >= 0:
                for i in range(m):
                    for j in range(m):
                        p[i, j] += jump * jump_var * struck[i] * struck[j]
            continue
        e = y[k] - guess
        if plain:
            density = -0.5 * e * e / s - log_s - root_two_pi
            total += density
            if each.size:
                each[k] = density
            if cdf.size:
                cdf[k] = e / sqrt(s)
            for i in range(m):
                x[i] += column[i] / s * e
                if gains.size:
                    gains[k, i] = column[i] / s
            if not frozen:
                largest = 0.0
                for i in range(m):
                    for j in range(i + 1):
                        p[i, j] -= column[i] * column[j] / s
                        p[j, i] = p[i, j]
                        largest = max(largest, abs(p[i, j] - before[i, j]) / s)
                        before[i, j] = p[i, j]
                if largest < 1e-13:
                    frozen, s_frozen, last_noise, last_scale = True, s, r, scale[k]
            continue
        count = noises if jump == 0.0 else 2 * noises
        rise_var = jump_var * (weight_at * slope) ** 2
        for i in range(count):
            spread[i] = s + added[i] if i < noises else s + added[i - noises] + rise_var
            inverse[i] = 1.0 / spread[i]
        bounded = low.size > 0 and high[k] > low[k]
        top = 0.0
        for i in range(m):
            jumped[i] = column[i] + jump_var * weight_at * slope * struck[i]
        if extras[0] < 0.0:
            f = sqrt(-extras[0])
            # A part of the flicker stays a plain noise, so that what the others lead to has no ripple.
            a = f * f * whole * whole / s
            step = (_FLICKERS[6] - _FLICKERS[5]) ** 2 * a
            smoothed = max((step - _SMOOTH**2) / (step + _SMOOTH**2 * a) if a > 0.0 else 0.0, _LEAST_SMOOTHED)
            odds_of, e_of, root_of, gain_of = flickering[0], flickering[1], flickering[2], flickering[3]
            top = -1e300
            for q in range(count * _FLICKERS.size):
                i, j = q % count, q // count
                off = f * sqrt(1.0 - smoothed) * _FLICKERS[j]
                gain_of[q], e_of[q] = 1.0 + off, e - off * whole
                root_of[q] = sqrt(spread[i] * (1.0 + off) ** 2 + smoothed * f * f * (whole * whole + spread[i]))
                prior = share[i] * (1.0 - jump) if i < noises else share[i - noises] * jump
                prior *= _FLICKER_SHARES[j]
                if bounded:
                    lower, upper = (low[k] - y[k] + e_of[q]) / root_of[q], (high[k] - y[k] + e_of[q]) / root_of[q]
                    odds_of[q] = log(prior * max(_within(lower, upper), 1e-300))
                else:
                    odds_of[q] = log(max(prior, 1e-300) / root_of[q]) - 0.5 * (e_of[q] / root_of[q]) ** 2
                top = max(top, odds_of[q])
            weights, below, above = 0.0, 0.0, 0.0
            for q in range(count * _FLICKERS.size):
                odds_of[q] = exp(odds_of[q] - top)
                weights += odds_of[q]
                if cdf.size:
                    i = q % count
                    prior = share[i] * (1.0 - jump) if i < noises else share[i - noises] * jump
                    prior *= 0.5 * _FLICKER_SHARES[q // count]
                    if bounded:
                        lower, upper = (low[k] - y[k] + e_of[q]) / root_of[q], (high[k] - y[k] + e_of[q]) / root_of[q]
                        a, b = lower / sqrt(2.0), upper / sqrt(2.0)
                        below += prior * ((1.0 - chance[k]) * erfc(-a) + chance[k] * erfc(-b))
                        above += prior * ((1.0 - chance[k]) * erfc(a) + chance[k] * erfc(b))
                    else:
                        below += prior * erfc(-e_of[q] / (root_of[q] * sqrt(2.0)))
                        above += prior * erfc(e_of[q] / (root_of[q] * sqrt(2.0)))
            density = top + log(weights) - (0.0 if bounded else root_two_pi)
            total += density
            if each.size:
                each[k] = density
            if cdf.size:
                cdf[k] = max(above, 1e-300) if above < below else -max(below, 1e-300)
            still, still_by, a, moving, moving_by, b, struck_odds = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for q in range(count * _FLICKERS.size):
                w, root = odds_of[q] / weights, root_of[q]
                gain, by = gain_of[q] / root**2, gain_of[q] * e_of[q] / root**2
                if bounded:
                    lower, upper = (low[k] - y[k] + e_of[q]) / root, (high[k] - y[k] + e_of[q]) / root
                    centre, kept = _cut(lower, upper, _within(lower, upper))
                    by, gain = gain_of[q] * centre / root, (1.0 - kept) * gain
                if q % count < noises:
                    still, still_by = still + w * gain, still_by + w * by
                    a += w * (by * by - gain * gain_of[q])
                else:
                    moving, moving_by = moving + w * gain, moving_by + w * by
                    b += w * (by * by - gain * gain_of[q])
                    struck_odds += w
            if shock_at >= 0 and struck_odds > 0.0:
                for i in range(m):
                    if struck[i] != 0.0:
                        for j in range(m):
                            p[i, j] += struck_odds * jump_var * struck[i] * struck[j]
            for i in range(m):
                moved[i] = still_by * column[i] + moving_by * jumped[i]
                x[i] += moved[i]
                for j in range(i + 1):
                    p[i, j] += a * column[i] * column[j] + b * jumped[i] * jumped[j] - moved[i] * moved[j]
                    p[j, i] = p[i, j]
                if gains.size:
                    gains[k, i] = still * column[i] + moving * jumped[i]
            continue
        if not bounded:
            # By their odds to the usual noise without a jump, unless that one is all but impossible.
            for i in range(1, count):
                odds[i] = 0.5 * e * e * (inverse[0] - inverse[i])
                top = max(top, odds[i])
            if top < _STEEP:
                top = 0.0
        weights = 0.0
        for i in range(count):
            prior = share[i] * (1.0 - jump) if i < noises else share[i - noises] * jump
            if bounded:
                root = sqrt(spread[i])
                odds[i] = prior * max(_within((low[k] - guess) / root, (high[k] - guess) / root), 1e-300)
            elif i == 0:
                odds[i] = prior if top == 0.0 else prior * exp(-top)
            else:
                odds[i] = prior * sqrt(s * inverse[i]) * exp(odds[i] - top)
            if i >= noises and bias != 0.0:  # the jump's own sign is known from e but for the rest of the variance
                odds[i] *= 1.0 + bias * erf(e * sqrt(rise_var / (2.0 * (spread[i] - rise_var) * spread[i])))
            weights += odds[i]
        density = log(weights) if bounded else top + log(weights) - log_s - 0.5 * e * e / s - root_two_pi
        total += density
        if each.size:
            each[k] = density
        if cdf.size:
            below, above = 0.0, 0.0  # the reading; of an interval, a place in it that `chance` picks evenly
            for i in range(count):
                prior = share[i] * (1.0 - jump) if i < noises else share[i - noises] * jump
                root = sqrt(2.0 * spread[i])
                if bounded:
                    a, b = (low[k] - guess) / root, (high[k] - guess) / root
                    below += 0.5 * prior * ((1.0 - chance[k]) * erfc(-a) + chance[k] * erfc(-b))
                    above += 0.5 * prior * ((1.0 - chance[k]) * erfc(a) + chance[k] * erfc(b))
                else:
                    lean = 1.0
                    if i >= noises:
                        lean += bias if e >= 0 else -bias
                    above += 0.5 * prior * lean * erfc(abs(e) / root)
            if not bounded and above > 0.5:  # beyond the median: the other tail's
                above -= 1.0
            tail = max(above, 1e-300) if above > 0.0 else above
            if bounded:
                cdf[k] = max(above, 1e-300) if above < below else -max(below, 1e-300)
            else:
                cdf[k] = tail * (1.0 if e >= 0 else -1.0)
        # Each hypothesis moves the mean by its gain times e; that of a jump sees the covariance with the jump in it.
        # The mixture's covariance is the mean of theirs, plus the spread of their means.
        share_of = 1.0 / weights
        still, still_by, a, moving, moving_by, b, struck_odds = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(count):
            w = odds[i] * share_of
            gain, by = inverse[i], e * inverse[i]
            if bounded:
                root = sqrt(spread[i])
                lower, upper = (low[k] - guess) / root, (high[k] - guess) / root
                centre, kept = _cut(lower, upper, _within(lower, upper))
                by, gain = centre / root, (1.0 - kept) * inverse[i]
            if i < noises:
                still, still_by = still + w * gain, still_by + w * by
                a += w * (by * by - gain)
            else:
                moving, moving_by = moving + w * gain, moving_by + w * by
                b += w * (by * by - gain)
                struck_odds += w
        if shock_at >= 0 and struck_odds > 0.0:
            for i in range(m):
                if struck[i] != 0.0:
                    for j in range(m):
                        p[i, j] += struck_odds * jump_var * struck[i] * struck[j]
        for i in range(m):
            moved[i] = still_by * column[i] + moving_by * jumped[i]
            x[i] += moved[i]
            for j in range(i + 1):
                p[i, j] += a * column[i] * column[j] + b * jumped[i] * jumped[j] - moved[i] * moved[j]
                p[j, i] = p[i, j]
            if gains.size:
                gains[k, i] = still * column[i] + moving * jumped[i]
    return total


_NONE = np.empty(0)
_NO_GAINS = np.empty((0, 0))


def log_densities(
    y: Floats,
    used: NDArray[np.bool_],
    step_s: Floats,
    mean: Floats,
    noise_var: Floats,
    scale: Floats,
    states: Floats,
    shocks: Floats,
    extras: Floats,
    low: Floats = _NONE,
    high: Floats = _NONE,
) -> Floats:
    """Return each reading's log density given those before it, shape (n,); 0 where it is not used.

    Args:
        y: readings, shape (n,); what is not used may be anything.
        used: which of them count, shape (n,).
        step_s: time since the reading before, s, shape (n,); the first is ignored.
        mean: deterministic part, shape (n,).
        noise_var: variance of the white noise, shape (n,).
        scale: factor of the states in each reading, shape (n,).
        states: table of states, shape (m, 6).
        shocks: rate per s, variance of the jump, index of the shock's state or -1; where a jump strikes other states,
            the part of it that each state takes, shape (3,) or (3 + m,).
        extras: noise variance per squared state (below 0: less the variance of a gain that flickers, and the whole
            reading, noise too, is what it multiplies; the offset is then the origin's), quadratic coefficient,
            probability and variance of an outlier, the offset of the state for the first, and the bias of the jumps'
            sign, within (-1, 1); then probability and added variance of each further noise, shape (6 + 2 j,).
        low: where of a reading only an interval is known, its lower end, shape (n,), or empty where there is none such.
        high: the upper end; where it is not above the lower one, the reading is `y`.
    """
    each = np.zeros(y.size)
    _filter(
        *(y, used, step_s, mean, noise_var, scale, states, shocks, extras, low, high, _NONE),
        *(each, _NONE, _NONE, _NONE, _NO_GAINS),
    )
    return each


def predict(
    y: Floats,
    used: NDArray[np.bool_],
    step_s: Floats,
    mean: Floats,
    noise_var: Floats,
    scale: Floats,
    states: Floats,
    shocks: Floats,
    extras: Floats,
    low: Floats = _NONE,
    high: Floats = _NONE,
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return for each reading its log density, z, predicted mean, variance without shock, and the gains.

    Shapes (n,), the gains (n, m). The log density and z are 0 where a reading is not used.
    """
    n = y.size
    each, cdf, predicted, variance = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    gains = np.zeros((n, states.shape[0]))
    chance = np.random.default_rng(0).random(n if low.size else 0)  # any even numbers do, the same each time
    _filter(
        *(y, used, step_s, mean, noise_var, scale, states, shocks, extras, low, high, chance),
        *(each, cdf, predicted, variance, gains),
    )
    if shocks[2] >= 0 or extras[:4].any() or extras.size > 6 or low.size:
        z = np.where(used, -np.sign(cdf) * ndtri(np.clip(np.abs(cdf), 1e-300, 0.5)), 0.0)
    else:
        z = cdf
    return each, z, predicted, variance, gains


@njit(cache=True, error_model="numpy")
def whiten(template: Floats, step_s: Floats, states: Floats, gains: Floats, used: NDArray[np.bool_]) -> Floats:
    """Return what the filter, with the gains it had, leaves of a template added to the readings, shape (n,).

    The innovations are linear in the readings once the gains are given, so this is how an effect of that shape would
    show in them.
    """
    m, n = states.shape[0], template.size
    keep, turn, noise = np.zeros(_MOST), np.zeros(_MOST), np.zeros(_MOST)
    x, left = np.zeros(m), np.zeros(n)
    last_step = -1.0
    for k in range(n):
        if step_s[k] != last_step:
            last_step = step_s[k]
            transition(last_step, states, keep, turn, noise)
        if k > 0:
            advance_vector(states, keep, turn, x)
        if not used[k]:
            continue
        e = template[k]
        for i in range(m):
            e -= states[i, 5] * x[i]
        left[k] = e
        for i in range(m):
            x[i] += gains[k, i] * e
    return left


@njit(cache=True, error_model="numpy")
def colour(
    innovation: Floats, jump: Floats, struck: Floats, step_s: Floats, states: Floats, gains: Floats, scale: Floats
) -> Floats:
    """Return readings less their mean, shape (n,), that have these innovations under the filter with these gains.

    The inverse of `whiten`, and so a draw from a Gaussian hypothesis where the innovations are drawn: it needs no white
    noise beside the states, of which there is less than none where apertures average out much of a process. On top,
    jumps of the states along `struck`, of each reading's size, shape (n,), which the filter does not know of.
    """
    m, n = states.shape[0], innovation.size
    keep, turn, noise = np.zeros(_MOST), np.zeros(_MOST), np.zeros(_MOST)
    x, beside, y = np.zeros(m), np.zeros(m), np.zeros(n)
    last_step = -1.0
    for k in range(n):
        if step_s[k] != last_step:
            last_step = step_s[k]
            transition(last_step, states, keep, turn, noise)
        if k > 0:
            advance_vector(states, keep, turn, x)
            advance_vector(states, keep, turn, beside)
        state = 0.0
        for i in range(m):
            beside[i] += jump[k] * struck[i]
            state += states[i, 5] * (x[i] + beside[i])
        y[k] = scale[k] * state + innovation[k]
        for i in range(m):
            x[i] += gains[k, i] * innovation[k]
    return y


def follow_telegraph(
    telegraph: Floats,
    y: Floats,
    used: NDArray[np.bool_],
    step_s: Floats,
    mean: Floats,
    noise_var: Floats,
    scale: Floats,
    states: Floats,
    shocks: Floats,
    *_: Floats,
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return for each reading what `predict` does, of a level that jumps between two values at random.

    Where the jumps are decides everything, and one reading seldom shows one: the next few do. So the filter follows,
    for each level, the histories whose last jump was now, a reading ago, and longer ago, each with its own mean and
    covariance; those that grow older are merged by their moments. (Blom and Bar-Shalom 1988 keep one for each level;
    with one covariance for both, a drift that nearly follows the jumps costs a nat for each of them.) Shocks are two
    hypotheses a reading, collapsed within each history.

    Args:
        telegraph: the step, and the mean stays below and above it, s.
        y: readings, shape (n,), and so on to `shocks`, as of `log_densities`; extras and bounds are left out.
        used: see `y`.
        step_s: see `y`.
        mean: see `y`.
        noise_var: see `y`.
        scale: see `y`.
        states: see `y`.
        shocks: see `y`.
    """
    n = y.size
    each, cdf, predicted, variance = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    gains = np.zeros((n, states.shape[0]))
    _follow_telegraph(
        y, used, step_s, mean, noise_var, scale, states, shocks, telegraph, each, cdf, predicted, variance, gains
    )
    z = np.where(used, -np.sign(cdf) * ndtri(np.clip(np.abs(cdf), 1e-300, 0.5)), 0.0)
    return each, z, predicted, variance, gains


def telegraph_densities(
    telegraph: Floats,
    y: Floats,
    used: NDArray[np.bool_],
    step_s: Floats,
    mean: Floats,
    noise_var: Floats,
    scale: Floats,
    states: Floats,
    shocks: Floats,
    *_: Floats,
) -> Floats:
    """Return each reading's log density given those before it, shape (n,); see `follow_telegraph`."""
    each, none = np.zeros(y.size), np.empty(0)
    _follow_telegraph(
        *(y, used, step_s, mean, noise_var, scale, states, shocks, telegraph),
        *(each, none, none, none, np.empty((0, 0))),
    )
    return each


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp", "nsz"})
def _merge(weight: Floats, x: Floats, p: Floats, at: int, more: float, other_x: Floats, other_p: Floats) -> None:
    """Add a history of weight `more` to the one at `at`: the mixture's mean and covariance."""
    if more <= 0.0:
        return
    m = other_x.size
    whole = weight[at] + more
    old, new = weight[at] / whole, more / whole
    for i in range(m):
        for j in range(i + 1):
            apart = old * new * (x[at, i] - other_x[i]) * (x[at, j] - other_x[j])
            p[at, i, j] = old * p[at, i, j] + new * other_p[i, j] + apart
            p[at, j, i] = p[at, i, j]
    for i in range(m):
        x[at, i] = old * x[at, i] + new * other_x[i]
    weight[at] = whole


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp", "nsz"})
def _follow_telegraph(
    y: Floats,
    used: NDArray[np.bool_],
    step_s: Floats,
    mean: Floats,
    noise_var: Floats,
    scale: Floats,
    states: Floats,
    shocks: Floats,
    telegraph: Floats,
    each: Floats,
    cdf: Floats,
    predicted: Floats,
    variance: Floats,
    gains: Floats,
) -> None:
    m, n, count = states.shape[0], y.size, 2 * _AGES
    keep, turn, noise, work = np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(m)
    # Histories, those with the level below first, each level's youngest first; and the same a reading later.
    x, p, weight = np.zeros((count, m)), np.zeros((count, m, m)), np.zeros(count)
    next_x, next_p, next_weight = np.zeros((count, m)), np.zeros((count, m, m)), np.zeros(count)
    column, struck, moved, jumped = np.zeros((count, m)), np.zeros(m), np.zeros(m), np.zeros(m)
    spread, apart, still, moving = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count)
    high = telegraph[2] / (telegraph[1] + telegraph[2])
    weight[_AGES - 1], weight[count - 1] = 1.0 - high, high
    for i in range(m):
        p[_AGES - 1, i, i] = p[count - 1, i, i] = states[i, 4] ** 2
    shock_at, jump_var, weight_at, jump = int(shocks[2]), 0.0, 0.0, 0.0
    if shock_at >= 0:
        jump_var, struck[shock_at] = shocks[1], 1.0
        for i in range(min(m, shocks.size - 3)):
            struck[i] = shocks[3 + i]
        for i in range(m):
            weight_at += states[i, 5] * struck[i]
        jump = 1.0 - exp(-shocks[0] * states[shock_at, 1])
    diagonal = True
    for i in range(m):
        if states[i, 0] != MARKOV:
            diagonal = False
    last_step, up, down, rate = -1.0, 0.0, 0.0, 0.0
    for k in range(n):
        if step_s[k] != last_step:
            last_step = step_s[k]
            transition(last_step, states, keep, turn, noise)
            up, down = 1.0 - exp(-last_step / telegraph[1]), 1.0 - exp(-last_step / telegraph[2])
            rate = 1.0 - exp(-shocks[0] * last_step) if shock_at >= 0 else 0.0
        if k > 0:
            jump = rate
            next_weight[:] = 0.0
            for q in range(count):
                if weight[q] == 0.0:
                    continue
                above = q >= _AGES
                leaves = down if above else up
                older = q if q % _AGES == _AGES - 1 else q + 1
                _merge(next_weight, next_x, next_p, older, weight[q] * (1.0 - leaves), x[q], p[q])
                _merge(next_weight, next_x, next_p, 0 if above else _AGES, weight[q] * leaves, x[q], p[q])
            x, next_x, p, next_p, weight, next_weight = next_x, x, next_p, p, next_weight, weight
            for q in range(count):
                if weight[q] == 0.0:
                    continue
                if diagonal:
                    for i in range(m):
                        x[q, i] *= keep[i]
                        for j in range(i + 1):
                            p[q, i, j] *= keep[i] * keep[j]
                            p[q, j, i] = p[q, i, j]
                        p[q, i, i] += noise[i]
                else:
                    advance_vector(states, keep, turn, x[q])
                    _advance_covariance(states, keep, turn, noise, p[q], work)
        whole = 0.0
        for q in range(count):
            whole += weight[q]
        rise_var = jump_var * (weight_at * scale[k]) ** 2
        least = 1e300
        for q in range(count):
            if weight[q] == 0.0:
                continue
            guess, s = mean[k] + (telegraph[0] if q >= _AGES else 0.0), noise_var[k]
            for i in range(m):
                c = 0.0
                for j in range(m):
                    c += states[j, 5] * p[q, i, j]
                column[q, i] = c * scale[k]
                s += states[i, 5] * column[q, i] * scale[k]
                guess += scale[k] * states[i, 5] * x[q, i]
            spread[q], apart[q] = s, y[k] - guess
            if predicted.size:
                predicted[k] += weight[q] / whole * guess
                variance[k] += weight[q] / whole * s
            least = min(least, 0.5 * apart[q] ** 2 / (s + rise_var if jump > 0.0 else s))
        if not used[k]:
            if shock_at >= 0:
                for q in range(count):
                    for i in range(m):
                        for j in range(m):
                            p[q, i, j] += jump * jump_var * struck[i] * struck[j]
            continue
        # Densities over that of the likeliest, lest they all vanish.
        density, beyond, short = 0.0, 0.0, 0.0
        for q in range(count):
            if weight[q] == 0.0:
                continue
            s, e = spread[q], apart[q]
            wide = s + rise_var
            still[q] = (1.0 - jump) * exp(least - 0.5 * e * e / s) / sqrt(s)
            moving[q] = jump * exp(least - 0.5 * e * e / wide) / sqrt(wide) if jump > 0.0 else 0.0
            density += weight[q] / whole * (still[q] + moving[q])
            if cdf.size:
                a, b = sqrt(2.0 * s), sqrt(2.0 * wide)
                beyond += 0.5 * weight[q] / whole * ((1.0 - jump) * erfc(e / a) + jump * erfc(e / b))
                short += 0.5 * weight[q] / whole * ((1.0 - jump) * erfc(-e / a) + jump * erfc(-e / b))
        each[k] = log(density) - least - 0.5 * log(2.0 * pi)
        if cdf.size:
            cdf[k] = max(beyond, 1e-300) if beyond < short else -max(short, 1e-300)
        for q in range(count):
            if weight[q] == 0.0:
                continue
            seen = still[q] + moving[q]
            weight[q] *= seen / (whole * density)
            if weight[q] < _NEGLIGIBLE:
                weight[q] = 0.0
                continue
            # As without a level: both hypotheses move the state along a direction, with the jump in it or without.
            s, e = spread[q], apart[q]
            wide, w = s + rise_var, moving[q] / seen
            v, by, more = 1.0 - w, e / s, e / wide
            a, b = v * (by * by - 1.0 / s), w * (more * more - 1.0 / wide)
            for i in range(m):
                jumped[i] = column[q, i] + jump_var * weight_at * scale[k] * struck[i]
                moved[i] = v * by * column[q, i] + w * more * jumped[i]
                x[q, i] += moved[i]
                for j in range(i + 1):
                    p[q, i, j] += a * column[q, i] * column[q, j] + b * jumped[i] * jumped[j] - moved[i] * moved[j]
                    p[q, i, j] += w * jump_var * struck[i] * struck[j]
                    p[q, j, i] = p[q, i, j]
                if gains.size:
                    gains[k, i] += weight[q] * (v * column[q, i] / s + w * jumped[i] / wide)
