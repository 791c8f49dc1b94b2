"""First-order Gauss-Markov process: the signal's model, and with a long time constant the drift's."""

from dataclasses import dataclass
from math import exp, expm1, inf, sqrt
from typing import Literal

import numpy as np
from numba import njit
from numpy.random import Generator
from numpy.typing import NDArray

from aemd.model.term import Finite, Positive, PositiveOrInfinite, Role, Times, Volts

__all__ = ["GaussMarkov"]


@dataclass(frozen=True, slots=True, kw_only=True)
class GaussMarkov:
    """dx = -x/tau dt + rate dW; tau = inf is the random walk.

    The rate and not the standard deviation is the parameter, because it stays finite as tau grows: it is the rms change
    over a second that is short against tau. For finite tau the stationary standard deviation is rate sqrt(tau/2).
    """

    term: Literal["gauss_markov"] = "gauss_markov"
    role: Role = "signal"
    rate_V_per_rt_s: Positive
    """V/sqrt(s)."""
    tau_s: PositiveOrInfinite = inf
    """s."""
    start_V: Finite | None = None
    """Value at t = 0, V; without one, drawn from the stationary law, or 0 where tau is infinite."""

    @classmethod
    def from_sd(cls, sd_V: float, tau_s: float, role: Role = "signal") -> "GaussMarkov":
        """Return the process of stationary standard deviation `sd_V`, V, and finite time constant `tau_s`, s."""
        return cls(role=role, rate_V_per_rt_s=sd_V * sqrt(2 / tau_s), tau_s=tau_s)

    @property
    def sd(self) -> float:
        """Stationary standard deviation, V; inf for the random walk."""
        return self.rate_V_per_rt_s * sqrt(self.tau_s / 2)

    def realise(self, rng: Generator) -> "GaussMarkovRealisation":
        """Draw the value at t = 0 and return the history that begins there."""
        drawn = rng.standard_normal()  # always, so that start_V does not shift what follows
        if self.start_V is not None:
            return GaussMarkovRealisation(self, rng, self.start_V)
        return GaussMarkovRealisation(self, rng, 0.0 if self.tau_s == inf else self.sd * drawn)


class GaussMarkovRealisation:
    """Steps exactly from aperture to aperture; no step is approximated, however long or short.

    Over a time h, with a = h/tau, the value x and the integral I of x over h are jointly Gaussian given the value x0
    at its beginning (solve the equation, integrate it, and take the covariances of the two stochastic integrals):

        mean x = x0 e^-a                    mean I = x0 h (1 - e^-a)/a
        var x  = q^2 h (1 - e^-2a)/(2a)     var I  = q^2 h^3 (a - 2(1 - e^-a) + (1 - e^-2a)/2)/a^3
        cov    = q^2 h^2 ((1 - e^-a)/a)^2/2

    with the limits q^2 h, q^2 h^3/3 and q^2 h^2/2 of the random walk at a = 0. Each reading takes three normal numbers
    in a fixed order: for the value after the pause before it, and for value and integral over its aperture.
    """

    def __init__(self, process: GaussMarkov, rng: Generator, start_V: float) -> None:
        self._process = process
        self._rng = rng
        self._value_V = start_V
        self._end_s = 0.0

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return the mean over each aperture, V, shape (n,)."""
        means = np.empty(start_s.size)
        normals = self._rng.standard_normal((start_s.size, 3))
        self._value_V, self._end_s = _step(
            self._value_V,
            self._end_s,
            np.ascontiguousarray(start_s, dtype=np.float64),
            aperture_s,
            self._process.tau_s,
            self._process.rate_V_per_rt_s,
            normals,
            means,
        )
        return means


@njit(cache=True)
def _faded(a: float) -> float:
    """Return (1 - e^-a)/a, which is 1 at 0."""
    return 1.0 if a == 0.0 else -expm1(-a) / a


@njit(cache=True)
def _integral_variance(a: float) -> float:
    """Return (a - 2(1 - e^-a) + (1 - e^-2a)/2)/a^3, which is 1/3 at 0; by its series where the sum would cancel."""
    if a > 0.1:  # the cancellation costs 3 of 16 digits here, and 12 terms below reach the last digit
        return (a + 2 * expm1(-a) - expm1(-2 * a) / 2) / a**3
    total, power, factorial = 0.0, 1.0, 6.0
    for n in range(3, 15):
        total += power * (2.0 ** (n - 1) - 2.0) / factorial
        power *= -a
        factorial *= n + 1
    return total


@njit(cache=True)
def _step(
    value: float,
    end: float,
    start: NDArray[np.float64],
    aperture: float,
    tau: float,
    rate: float,
    normals: NDArray[np.float64],
    means: NDArray[np.float64],
) -> tuple[float, float]:
    a = aperture / tau
    keep = exp(-a)
    value_sd = rate * sqrt(aperture * _faded(2 * a))
    mean_gain = _faded(a)
    shared = rate * sqrt(aperture) * _faded(a) ** 2 / 2 / sqrt(_faded(2 * a))  # cov/sd of x, per aperture
    own = sqrt(max(rate**2 * aperture * _integral_variance(a) - shared**2, 0.0))
    for k in range(start.size):
        pause = max(start[k] - end, 0.0)  # rounding of start + aperture may leave a tiny overlap
        value = value * exp(-pause / tau) + rate * sqrt(pause * _faded(2 * pause / tau)) * normals[k, 0]
        means[k] = value * mean_gain + shared * normals[k, 1] + own * normals[k, 2]
        value = value * keep + value_sd * normals[k, 1]
        end = start[k] + aperture
    return value, end
