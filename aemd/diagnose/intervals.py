"""Intervals of the reported parameters, from the readings' own scores."""

from collections.abc import Mapping
from math import exp, inf, log, sqrt

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.fit import Fit, densities, readings_scores
from aemd.diagnose.hypothesis import Parameter
from aemd.diagnose.result import Value

__all__ = ["covariance", "describe"]

Floats = NDArray[np.float64]


def covariance(fit: Fit) -> Floats:
    """Return the covariance of the free numbers: the inverse of the outer product of scores, shape (k, k)."""
    low, high = np.array([bound for term in fit.terms for bound in term.bounds], np.float64).reshape(-1, 2).T
    here = densities(fit.terms, fit.theta, fit.data)
    scores = readings_scores(fit.terms, fit.theta, fit.data, here, high)
    free = (fit.theta > low) & (fit.theta < high)  # what lies on a bound is not uncertain by this measure
    information = scores.T @ scores
    covered = np.zeros(information.shape)
    scale = np.asarray(np.sqrt(np.maximum(np.diag(information), 1e-12)))
    kept = np.flatnonzero(free)
    inner = (information / np.outer(scale, scale))[np.ix_(kept, kept)] + 1e-9 * np.eye(kept.size)
    covered[np.ix_(kept, kept)] = np.linalg.pinv(inner)
    return np.asarray(covered / np.outer(scale, scale))


def describe(fit: Fit, number: int, spread: Floats) -> Mapping[str, Value]:
    """Return the reported parameters of one term with 95 % intervals, by the delta method."""
    begin = sum(term.start.size for term in fit.terms[:number])
    term, theta = fit.terms[number], fit.parts_of(number)
    own = spread[begin : begin + theta.size, begin : begin + theta.size]
    return {parameter.name: _value(parameter, theta, own) for parameter in term.parameters(fit.data)}


def _value(parameter: Parameter, theta: Floats, spread: Floats) -> Value:
    here = parameter.value(theta)
    slopes = np.empty(theta.size)
    for number in range(theta.size):
        aside = theta.copy()
        width = 1e-4 * max(abs(theta[number]), 1.0)
        aside[number] += width
        slopes[number] = (parameter.value(aside) - here) / width
    sd = sqrt(max(float(slopes @ spread @ slopes), 0.0))
    if parameter.positive and here > 0:
        reach = min(1.96 * sd / here, 50.0)
        return Value(here, exp(log(here) - reach), exp(log(here) + reach) if reach < 50 else inf, parameter.unit)
    return Value(here, here - 1.96 * sd, here + 1.96 * sd, parameter.unit)
