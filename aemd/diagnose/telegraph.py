"""The likelihood of a level that jumps between two values at random, in the same noise as all else.

Two filters run side by side, one for each level, and mix before every reading by the odds of a jump (Blom and
Bar-Shalom 1988: interacting multiple models). The level enters the mean alone, so both have one covariance; the spread
between them is left out of it, which costs a little just after a jump and keeps the predictive density a density.
"""

from math import erfc, exp, log, pi, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import ndtri

from aemd.diagnose.kernels import advance_vector, transition

__all__ = ["follow_telegraph"]

Floats = NDArray[np.float64]


def follow_telegraph(
    telegraph: Floats,
    y: Floats,
    used: NDArray[np.bool_],
    step_s: Floats,
    mean: Floats,
    noise_var: Floats,
    scale: Floats,
    states: Floats,
    *_: Floats,
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return for each reading its log density, z, predicted mean, variance, and the gains, as `kernels.predict` does.

    Args:
        telegraph: the step, and the mean stays below and above it, s.
        y: readings, shape (n,), and so on to `states`, as of `kernels.log_densities`; shocks and extras are left out.
        used: see `y`.
        step_s: see `y`.
        mean: see `y`.
        noise_var: see `y`.
        scale: see `y`.
        states: see `y`.
    """
    n = y.size
    each, cdf, predicted, variance = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    gains = np.zeros((n, states.shape[0]))
    _follow(y, used, step_s, mean, noise_var, scale, states, telegraph, each, cdf, predicted, variance, gains)
    z = np.where(used, -np.sign(cdf) * ndtri(np.clip(np.abs(cdf), 1e-300, 0.5)), 0.0)
    return each, z, predicted, variance, gains


@njit(cache=True)
def _follow(
    y: Floats,
    used: NDArray[np.bool_],
    step_s: Floats,
    mean: Floats,
    noise_var: Floats,
    scale: Floats,
    states: Floats,
    telegraph: Floats,
    each: Floats,
    cdf: Floats,
    predicted: Floats,
    variance: Floats,
    gains: Floats,
) -> None:
    m, n = states.shape[0], y.size
    keep, turn, noise = np.zeros(m), np.zeros(m), np.zeros(m)
    below, above, p = np.zeros(m), np.zeros(m), np.zeros((m, m))
    column, work = np.zeros(m), np.zeros(m)
    for i in range(m):
        p[i, i] = states[i, 4] ** 2
    high = telegraph[2] / (telegraph[1] + telegraph[2])
    last_step, root_two_pi = -1.0, 0.5 * log(2 * pi)
    for k in range(n):
        if step_s[k] != last_step:
            last_step = step_s[k]
            transition(last_step, states, keep, turn, noise)
        if k > 0:
            up, down = 1 - exp(-last_step / telegraph[1]), 1 - exp(-last_step / telegraph[2])
            risen, fallen = (1 - high) * up, high * down
            low_next, high_next = (1 - high) - risen + fallen, high - fallen + risen
            to_above, to_below = risen / high_next, fallen / low_next
            for i in range(m):
                a, b = below[i], above[i]
                below[i] = (1 - to_below) * a + to_below * b
                above[i] = (1 - to_above) * b + to_above * a
            high = high_next
            advance_vector(states, keep, turn, below)
            advance_vector(states, keep, turn, above)
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
        s, low_guess, high_guess = noise_var[k], mean[k], mean[k] + telegraph[0]
        for i in range(m):
            c = 0.0
            for j in range(m):
                c += states[j, 5] * p[i, j]
            column[i] = c * scale[k]
            s += states[i, 5] * column[i] * scale[k]
            low_guess += scale[k] * states[i, 5] * below[i]
            high_guess += scale[k] * states[i, 5] * above[i]
        predicted[k] = (1 - high) * low_guess + high * high_guess
        variance[k] = s
        if not used[k]:
            continue
        e, f = y[k] - low_guess, y[k] - high_guess
        l0, l1 = log(max(1 - high, 1e-300)) - 0.5 * e * e / s, log(max(high, 1e-300)) - 0.5 * f * f / s
        top = max(l0, l1)
        w0, w1 = exp(l0 - top), exp(l1 - top)
        each[k] = top + log(w0 + w1) - 0.5 * log(s) - root_two_pi
        beyond = 0.5 * ((1 - high) * erfc(e / sqrt(2 * s)) + high * erfc(f / sqrt(2 * s)))
        short = 0.5 * ((1 - high) * erfc(-e / sqrt(2 * s)) + high * erfc(-f / sqrt(2 * s)))
        cdf[k] = max(beyond, 1e-300) if beyond < short else -max(short, 1e-300)
        high = w1 / (w0 + w1)
        for i in range(m):
            gain = column[i] / s
            gains[k, i] = gain
            below[i] += gain * e
            above[i] += gain * f
        for i in range(m):
            for j in range(i + 1):
                p[i, j] -= column[i] * column[j] / s
                p[j, i] = p[i, j]
