"""What the mean over an aperture leaves of a process, as the filter knows processes: at instants, in white noise.

The mean of an exponentially correlated process over apertures T that do not overlap is, to second order, the process at
instants with a variance a little larger, and white noise of a negative variance: averaging takes most of what is fast.
With a = T/tau, sigma^2 the variance, and the integrals of e^(-|t - u|/tau) over two apertures and over one,

    covariance k intervals apart   sigma^2 e^(-k h / tau) 2 (cosh a - 1)/a^2
    variance                       sigma^2 2 (a - 1 + e^-a)/a^2
    that less the first at k = 0   sigma^2 2 (a - sinh a)/a^2

and for the oscillator the same with the complex rate in place of 1/tau.
"""

from math import cosh, sinh, sqrt

import numpy as np

__all__ = ["averaged_markov", "averaged_out", "averaged_pair", "struck_between"]

_SMALL = 1e-2
"""Aperture in time constants below which the series is exact to 1e-9, and the closed form loses digits."""

_LARGE = 30.0
"""Aperture in time constants beyond which a process is white, but for a correlation of neighbours below 2 %; the two
parts would grow beyond all digits, and cancel."""


def averaged_markov(tau_s: float, rate: float, aperture_s: float) -> tuple[float, float]:
    """Return the rate of the process at instants, and the variance of the white noise beside it, which is negative.

    >>> averaged_markov(float("inf"), 1.0, 6.0)
    (1.0, -1.0)
    """
    a = aperture_s / tau_s
    if a > _LARGE:
        return rate, rate**2 * tau_s * ((a - 1) / a**2 - 0.5)
    if a < _SMALL:
        larger, lost = 1 + a**2 / 12, 1 / 6 + a**2 / 120
    else:
        larger, lost = 2 * (cosh(a) - 1) / a**2, (sinh(a) - a) / a**3
    return rate * sqrt(larger), -(rate**2) * aperture_s * lost


def averaged_out(tau_s: float, rate: float, aperture_s: float) -> float:
    """Return the variance of the white noise, which is negative, beside a process of this rate at instants.

    >>> averaged_out(float("inf"), 1.0, 6.0), round(averaged_out(1e-9, 1.0, 6.0) / (1e-9 / 2), 6)
    (-1.0, -1.0)
    """
    a = aperture_s / tau_s
    if a > _LARGE:
        return -(rate**2) * tau_s / 2
    kept, lost = averaged_markov(tau_s, 1.0, aperture_s)
    return lost * (rate / kept) ** 2


def averaged_pair(tau_s: float, omega: float, sd: float, aperture_s: float) -> tuple[float, float]:
    """Return the deviation of an oscillator's swinging pair at instants, and the variance of the noise beside it.

    Its covariance is the real part of sd^2 (1 - i/(omega tau)) e^(lambda t), lambda = -1/tau + i omega; a pair's has no
    imaginary part in front, which is small where there is something to call a resonance.
    """
    rate = complex(-1 / tau_s, omega) * aperture_s
    front = complex(1.0, -1 / (omega * tau_s))
    apart = float((front * 2 * (np.cosh(rate) - 1) / rate**2).real) if -rate.real < _LARGE else 1.0
    within = float((front * 2 * (np.exp(rate) - 1 - rate) / rate**2).real)
    return sd * sqrt(max(apart, 0.0)), sd**2 * (within - apart)


def struck_between(decay_s: float, step_s: float) -> float:
    """Return the root of the mean square that is left, at the next reading, of a shock at an even instant before it.

    >>> round(struck_between(1e9, 1.0), 6), round(struck_between(0.5, 1.0), 6)
    (1.0, 0.4954)
    """
    a = 2 * step_s / decay_s
    return sqrt(-np.expm1(-a) / a)
