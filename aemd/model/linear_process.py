"""A linear system driven by white noise, stepped exactly from aperture to aperture; resonance and heat are made of it.

    dx = F x dt + g dW,   reading = mean of H x over the aperture

State x and integral of H x over a time h are jointly Gaussian given the state at its beginning. Transition matrix and
covariance over h are two blocks of one matrix exponential (C. F. Van Loan, Computing integrals involving the matrix
exponential, IEEE Trans. Automatic Control 23(3), 1978, theorem 1).
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.linalg import expm, solve_continuous_lyapunov

from aemd.model.term import Times

__all__ = ["LinearProcess", "Transition"]

Matrix = NDArray[np.float64]

_PAUSE_DIGITS = 12  # pauses are told apart to 1 ps, so that rounding of the starts does not make each one different


@dataclass(frozen=True, slots=True)
class Transition:
    """What happens to a state over a time: x -> matrix x + root n, with standard normal n."""

    matrix: Matrix
    """Shape (d, d)."""
    root: Matrix
    """Of the covariance, shape (d, d)."""


class LinearProcess:
    """One history, beginning at t = 0 with a state of the stationary law."""

    def __init__(self, rng: Generator, dynamics: Matrix, drive: Matrix, outputs: Matrix) -> None:
        """Take F, shape (d, d), stable; g, shape (d,); H, shape (m, d)."""
        d, m = dynamics.shape[0], outputs.shape[0]
        self._rng = rng
        self._dynamics = np.zeros((d + m, d + m))  # of the state and the integrals of the outputs
        self._dynamics[:d, :d] = dynamics
        self._dynamics[d:, :d] = outputs
        self._drive = np.concatenate((drive, np.zeros(m)))
        self._known: dict[float, Transition] = {}
        stationary = np.asarray(solve_continuous_lyapunov(dynamics, -np.outer(drive, drive)), np.float64)
        self._state = np.zeros(d + m)
        self._state[:d] = _root(stationary) @ rng.standard_normal(d)
        self._outputs = m
        self._end_s = 0.0

    def average(self, start_s: Times, aperture_s: float) -> Matrix:
        """Return the mean of each output over each aperture, shape (n, m)."""
        means = np.empty((start_s.size, self._outputs))
        if not start_s.size:
            return means
        ends_s = np.concatenate(([self._end_s], start_s[:-1] + aperture_s))
        pauses_s, which = np.unique(np.round(np.maximum(start_s - ends_s, 0), _PAUSE_DIGITS), return_inverse=True)
        transitions = [self._over(float(pause)) for pause in pauses_s]
        during = self._over(aperture_s)
        normals = self._rng.standard_normal((start_s.size, 2, self._state.size))
        _step(
            self._state,
            np.array([transition.matrix for transition in transitions]),
            np.array([transition.root for transition in transitions]),
            which,
            during.matrix,
            during.root,
            normals,
            means,
        )
        self._end_s = float(start_s[-1]) + aperture_s
        return means / aperture_s

    def _over(self, time_s: float) -> Transition:
        if time_s not in self._known:
            self._known[time_s] = _transition(self._dynamics, self._drive, time_s)
        return self._known[time_s]


def _transition(dynamics: Matrix, drive: Matrix, time_s: float) -> Transition:
    """Return the transition over a time: by the matrix exponential over a short part of it, then doubled.

    The exponential holds the inverse of the matrix too, which would overflow over a time that is long for the system.
    """
    doublings = max(int(np.ceil(np.log2(np.linalg.norm(dynamics) * time_s))), 0) if time_s > 0 else 0
    d = len(drive)
    block = np.zeros((2 * d, 2 * d))
    block[:d, :d] = -dynamics
    block[:d, d:] = np.outer(drive, drive)
    block[d:, d:] = dynamics.T
    exponential = expm(block * (time_s / 2**doublings))
    matrix = exponential[d:, d:].T
    covariance = matrix @ exponential[:d, d:]
    for _ in range(doublings):
        covariance = matrix @ covariance @ matrix.T + covariance
        matrix = matrix @ matrix
    return Transition(np.ascontiguousarray(matrix), _root(covariance))


def _root(covariance: Matrix) -> Matrix:
    """Return R with R R' = covariance, which may be singular; scaled, so that small variances keep their digits."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2 * np.outer(inverse, inverse))
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


@njit(cache=True)
def _step(
    state: Matrix,
    pause_matrices: Matrix,
    pause_roots: Matrix,
    which: NDArray[np.int64],
    matrix: Matrix,
    root: Matrix,
    normals: Matrix,
    integrals: Matrix,
) -> None:
    """Step `state`, shape (d + m,), through all apertures and fill `integrals`, shape (n, m)."""
    d = state.size - integrals.shape[1]
    for k in range(integrals.shape[0]):
        state[:] = pause_matrices[which[k]] @ state + pause_roots[which[k]] @ normals[k, 0]
        state[d:] = 0.0
        state[:] = matrix @ state + root @ normals[k, 1]
        integrals[k] = state[d:]
