"""Known shapes in the mean: each is whitened by the filter that made the residuals, then correlated with them."""

from math import log, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve
from scipy.stats import chi2, norm

from aemd.diagnose.evidence import Evidence, bonferroni, two_sided
from aemd.diagnose.fit import Fit
from aemd.diagnose.kernels import whiten
from aemd.diagnose.terms.lines import amplitude_cost
from aemd.diagnose.terms.shapes import ReadingPattern, Step, SupplyCoupling, ThermalDrift, WarmUp, lagged

__all__ = ["check_pattern", "check_step", "check_warm_up", "check_witness"]

Floats = NDArray[np.float64]

_LONGEST_RESPONSE = 20_000
"""Readings of the filter's response to a step that are used; by then it has followed."""
_PERIODS = (2, 3, 4, 5, 6, 7, 8, 10, 12, 16)
_SLIDES = 40


def _settled_response(fit: Fit, length: int) -> Floats:
    """Return what the filter leaves, in deviations, of a unit step, once its gains have settled, shape (length,)."""
    used = fit.data.used
    half = used & (np.arange(used.size) > used.size // 4)
    gains = np.median(fit.gains[half], axis=0)
    step_s = np.full(length, fit.data.interval_s)
    left = whiten(np.ones(length), step_s, fit.states, np.tile(gains, (length, 1)), np.ones(length, bool))
    return np.asarray(left / sqrt(float(np.median(fit.variance[half]))))


def check_step(fit: Fit) -> Evidence:
    """Look for a step at every reading."""
    data = fit.data
    n = data.y.size
    response = _settled_response(fit, min(n, _LONGEST_RESPONSE))
    sums = fftconvolve(fit.z, response[::-1])[response.size - 1 :][:n]
    norms = np.cumsum(response**2)
    size = np.sqrt(norms[np.minimum(n - 1 - np.arange(n), response.size - 1)])
    scores = sums / size
    scores[:2] = scores[n - 2 :] = 0.0  # the first readings have the level to themselves
    at = int(np.argmax(np.abs(scores)))
    score = float(scores[at])
    p_value = bonferroni(two_sided(score), n)
    terms: tuple[Step, ...] = ()
    if p_value < 0.05:
        cost = amplitude_cost(1, data.n) + log(n)
        terms = tuple(
            Step(float(data.t_s[near]), float(scores[near] / size[near]), cost)
            for near in range(max(at - 1, 2), min(at + 2, n - 2))
        )
    return Evidence(
        check="strongest step in the residuals: score in deviations",
        p_value=p_value,
        observed=abs(score),
        low=float(norm.isf(0.5 * (1 - 0.025 ** (1 / n)))),
        high=float(norm.isf(0.5 * (1 - 0.975 ** (1 / n)))),
        terms=terms,
    )


def check_warm_up(fit: Fit) -> Evidence:
    """Look for a decay that began with the record."""
    data = fit.data
    taus = np.geomspace(10 * data.interval_s, data.span_s / 3, 8)
    tries = []
    for tau in taus:
        shape = fit.whitened(np.exp(-data.t_s / tau))
        size = float(np.sqrt(np.sum(shape[2:] ** 2)))  # the first readings have the level to themselves
        tries.append((float(shape[2:] @ fit.z[2:]) / max(size, 1e-12), size, float(tau)))
    score, size, tau = max(tries, key=lambda item: abs(item[0]))
    p_value = bonferroni(two_sided(score), taus.size)
    terms: tuple[WarmUp, ...] = ()
    if p_value < 0.05:
        terms = (WarmUp(tau, score / max(size, 1e-12), amplitude_cost(1, data.n) + log(taus.size)),)
    return Evidence(
        check="decay from the first reading on: score in deviations",
        p_value=p_value,
        observed=abs(score),
        low=0.1,
        high=float(norm.isf(0.0125 / taus.size)),
        terms=terms,
    )


def check_pattern(fit: Fit) -> Evidence:
    """Fold the residuals over small numbers of readings: sums of squared means are chi-square."""
    data, used = fit.data, fit.data.used
    tries = []
    for period in _PERIODS:
        phase = data.slot[used] % period
        counts = np.bincount(phase, minlength=period)
        if counts.min() < 10:
            continue
        means = np.bincount(phase, fit.z[used], period) / counts
        statistic = float(np.sum(counts * (means - fit.z[used].mean()) ** 2))
        tries.append((float(chi2.sf(statistic, period - 1)), period, statistic))
    if not tries:
        return Evidence("pattern locked to the reading's number, chi-square per degree", 1.0, 1.0, 0.0, 3.0)
    p_value, period, statistic = min(tries)
    corrected = bonferroni(p_value, len(tries))
    terms: tuple[ReadingPattern, ...] = ()
    if corrected < 0.05:
        phase = data.slot % period
        shapes = np.column_stack(
            [fit.whitened((phase == k).astype(np.float64) - (phase == period - 1)) for k in range(period - 1)]
        )
        offsets, *_ = np.linalg.lstsq(shapes, fit.z, rcond=None)
        cost = amplitude_cost(period - 1, data.n) + log(len(_PERIODS))
        terms = (ReadingPattern(period, tuple(float(offset) for offset in offsets), cost),)
    return Evidence(
        check="pattern locked to the reading's number: chi-square per degree",
        p_value=corrected,
        observed=statistic / (period - 1),
        low=0.0,
        high=float(chi2.isf(0.025 / len(tries), period - 1)) / (period - 1),
        terms=terms,
    )


def check_witness(fit: Fit, name: str) -> list[Evidence]:
    """Regress the residuals on a witness, lagged and not, and on its product with the reading.

    The law is checked on the spot: the same shapes slid along the record by tenths of it and more have nothing to do
    with it, so where their scores scatter by more than one deviation, the score counts for as much less.
    """
    data = fit.data
    witness = data.witnesses[name] - float(np.mean(data.witnesses[name]))
    lags = [0.0] + [
        lag for lag in (3.0, 10.0, 30.0, 100.0, 300.0, 1000.0) if 2 * data.interval_s < lag < data.span_s / 5
    ]
    tries = []
    for lag in lags:
        shape = fit.whitened(lagged(witness, data.step_s, lag))
        tries.append((*_slid_score(fit, shape), lag))
    score, size, lag = max(tries, key=lambda item: abs(item[0]))
    p_value = bonferroni(two_sided(score), len(lags))
    one = amplitude_cost(1, data.n)
    terms: tuple[ThermalDrift, ...] = ()
    if p_value < 0.05:
        terms = (ThermalDrift(name, lag, score / max(size, 1e-12), one + log(len(lags))),)
        if lag == 0.0:
            terms = (*terms, ThermalDrift(name, 3 * data.interval_s, terms[0].coefficient, one + log(len(lags)) + one))
    found = [
        Evidence(
            check=f"residuals against {name}: score in deviations",
            p_value=p_value,
            observed=abs(score),
            low=0.03,
            high=float(norm.isf(0.0125 / len(lags))),
            terms=terms,
        )
    ]
    # A gain multiplies what is predicted, and the innovation as well: both halves of its score.
    reading = fit.predicted + data.origin_V / data.unit_V
    score, size = _slid_score(fit, fit.whitened(witness * reading), 2 * witness)
    p_value = two_sided(score)
    supply: tuple[SupplyCoupling, ...] = ()
    if p_value < 0.05:
        supply = (SupplyCoupling(name, score / max(size, 1e-12), one),)
    found.append(
        Evidence(
            check=f"residuals against {name} times the reading: score in deviations",
            p_value=p_value,
            observed=abs(score),
            low=0.03,
            high=2.24,
            terms=supply,
        )
    )
    return found


def _slid_score(fit: Fit, shape: Floats, louder: Floats | None = None) -> tuple[float, float]:
    """Return the score of a whitened shape, not counted above what its slid copies allow, and the score's size.

    Args:
        fit: whose residuals.
        shape: change of the residuals by a unit of the effect, shape (n,).
        louder: change of the logarithm of the innovation's variance by it, shape (n,).
    """
    used, n = fit.data.used, shape.size
    size = float(np.sum(shape**2))
    squares = np.where(used, fit.z**2 - 1, 0.0)
    if louder is not None:
        louder = np.where(used, louder - louder[used].mean(), 0.0)
        size += 0.25 * float(np.sum(louder**2)) * float(np.mean(squares[used] ** 2))
    size = sqrt(size)
    if size == 0:
        return 0.0, 1.0

    def score(slide: int) -> float:
        total = float(np.roll(shape, slide) @ fit.z)
        return (total if louder is None else total + 0.5 * float(np.roll(louder, slide) @ squares)) / size

    slides = np.linspace(0.1 * n, 0.9 * n, _SLIDES).astype(int)
    spread = sqrt(float(np.mean([score(int(slide)) ** 2 for slide in slides])))
    return score(0) / max(spread, 1.0), size
