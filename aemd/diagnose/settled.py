"""One fit near another: with some of its numbers held, and how well the others are known there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.climb import box, densities, readings_scores
from aemd.diagnose.fit import Fit
from aemd.diagnose.hypothesis import Data, Term

__all__ = ["UNLIKELY", "Tried", "information_at", "likelihood_at", "log_volume", "settled", "weighted"]

Floats = NDArray[np.float64]

UNLIKELY = 4.0
"""Nats below the best from which nothing more is tried."""
_STEPS = 2
"""Of Newton from one fit to its neighbour."""
_DAMPINGS = (0.01, 0.3)
"""Of such a step, and of a second try at it: two processes that share the signal can change places at no cost."""
_ENOUGH = 0.02
"""Nats that are not worth another one."""


@dataclass(frozen=True, slots=True)
class Tried:
    """A fit with some numbers held: its weight, all its free numbers, and their covariance."""

    log_weight: float
    theta: Floats
    within: Floats


def information_at(terms: Sequence[Term], theta: Floats, data: Data) -> tuple[Floats, Floats]:
    """Return the gradient and the covariance at some free numbers: the inverse of the outer product of scores."""
    low, high = box(terms, theta)
    scores = readings_scores(terms, theta, data, densities(terms, theta, data), high)
    return scores.sum(axis=0), _inverse(scores, (theta > low) & (theta < high))


def likelihood_at(fit: Fit, index: int, value: float) -> float:
    """Return the likelihood with a free number of some term held elsewhere, near the top."""
    near = fit.theta.copy()
    near[index] = value
    return settled(fit.terms, near, fit.data, held=(index,))[0]


def weighted(tries: Sequence[Tried]) -> tuple[list[Tried], Floats]:
    """Return those of some fits that could be computed, and their weights, which sum to 1."""
    kept = [one for one in tries if np.isfinite(one.log_weight) and np.isfinite(one.within).all()]
    weights = np.array([one.log_weight for one in kept])
    weights = np.exp(weights - weights.max(initial=-np.inf))
    return kept, weights / weights.sum()


def log_volume(within: Floats, at: Sequence[int]) -> float:
    """Return the logarithm of the volume of some of the free numbers, the root of their covariance's determinant."""
    own = within[np.ix_(at, at)]
    certain = np.diag(own) <= 0  # on a bound
    return 0.5 * float(np.linalg.slogdet(own + np.diag(np.where(certain, 1.0, 1e-9 * np.diag(own))))[1])


def settled(terms: Sequence[Term], near: Floats, data: Data, held: Sequence[int] = ()) -> tuple[float, Floats, Floats]:
    """Return likelihood, free numbers and covariance a step or two of Newton from a neighbour, some numbers held."""
    low, high = box(terms, near, held)
    theta = np.clip(near, low, high)
    here = densities(terms, theta, data)
    value, within = float(here.sum()), np.zeros((theta.size, theta.size))
    for _ in range(_STEPS):
        scores = readings_scores(terms, theta, data, here, high)
        gradient = scores.sum(axis=0)
        inside = (theta > low) & (theta < high)
        within = _inverse(scores, inside)
        free = inside | ((low < high) & _inwards(theta, low, high, gradient))
        gained = 0.0
        for damping in _DAMPINGS:
            step = _inverse(scores, free, damping) @ gradient
            if float(gradient @ step) < _ENOUGH:
                break
            trial = np.clip(theta + np.clip(step, -1.5, 1.5), low, high)
            there = densities(terms, trial, data)
            if float(there.sum()) > value:
                gained, theta, here, value = float(there.sum()) - value, trial, there, float(there.sum())
                break
        if gained < _ENOUGH:
            break
    return value, theta, within


def _inwards(theta: Floats, low: Floats, high: Floats, gradient: Floats) -> NDArray[np.bool_]:
    return np.asarray(((theta <= low) & (gradient > 0)) | ((theta >= high) & (gradient < 0)))


def _inverse(scores: Floats, free: NDArray[np.bool_], damping: float = 1e-9) -> Floats:
    """Return the inverse of the outer product of scores among what is free; what is not is not uncertain by it.

    The damping is a part of each number's own information, as Levenberg and Marquardt have it.
    """
    information = np.einsum("nk,nl->kl", scores, scores)
    covered = np.zeros(information.shape)
    scale = np.sqrt(np.maximum(np.diag(information), 1e-12))
    kept = np.flatnonzero(free)
    inner = (information / np.outer(scale, scale))[np.ix_(kept, kept)] + damping * np.eye(kept.size)
    covered[np.ix_(kept, kept)] = np.linalg.pinv(inner)
    return np.asarray(covered / np.outer(scale, scale))
