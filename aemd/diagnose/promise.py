"""What the extended model's estimator should deliver: its errors beside the base's, on readings that are drawn.

A diagnosis measures how much better the extended model predicts readings. What a user runs is an estimator that knows
less than the model, and what he wants is the input and not the next reading. Neither follows from the other, so it is
tried: histories are drawn from the extended model, whose input is known, and the estimators of the base and of the
extended model, both as fitted, run over them. Each history has other figures, drawn from what the readings leave open:
how slow and how large the drift is, and so how much of it an estimate takes for the input, ten minutes hardly tell.
"""

from dataclasses import replace
from math import inf, log, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from aemd.block import READING
from aemd.diagnose.estimator import estimator_for
from aemd.diagnose.fit import Fit, densities
from aemd.diagnose.hypothesis import Base, signal_and_drift
from aemd.diagnose.result import Likely, Promise
from aemd.diagnose.translate import Told, to_model
from aemd.errors import ConfigError
from aemd.estimate.imm import Imm, ImmOptions
from aemd.model import Model

__all__ = ["errors_of", "promise"]

Floats = NDArray[np.float64]

_RECORDS = 79
"""From the second least to the second largest of so many draws of any law one more is in 76 cases of 80, 95 %."""
_LONGEST = 6000
"""Readings of each record that is drawn."""
_SETTLING = 0.06
"""Part of a record in which an estimator may settle."""
_OPEN = 20.0
"""From the lower to the upper end of what is likely: a promise as wide as that is none."""
_NO_BETTER = 0.99
"""Ratio of errors from which they are the same."""
_FAR = 2.5
"""Standard deviations that a figure is drawn off, where a normal law stands for what the fit leaves open."""
_LONG = 10_000
"""Readings beyond which it does: the drift has turned often enough."""
_TRIED = 200
"""Draws whose likelihood is asked; some 60 of them then count."""
_DOF = 6.0
"""Of Student's law that they come from, which has wider tails than what is left open."""
_FARTHER, _WIDER, _WIDEST = 0.6, 1.3, 1.0
"""Of the drift's time constant: deviations that its draws are above the most likely one, which is most often too
short; times its deviation that they are apart; and the most that this deviation may be, a natural logarithm."""
_RULED_OUT = 1e-4
"""Probability of what the readings rule out, by the chi-square law of the likelihood's ratio."""
_HALVINGS = 8
_NOTHING = 1e-13
"""Of the largest variance."""
_LEVEL = 5
"""Of the base's free numbers."""
_SLOWEST = 2.0
"""Spans of the record: a drift that is slower looks the same."""


def promise(base: Fit, extended: Fit, spread: Floats, aperture_s: float, told: Told) -> Promise | None:
    """Return what the extended model's estimator should deliver; none where a model has no input, or no estimator.

    Args:
        base: without what was found.
        extended: with it.
        spread: covariance of the extended fit's free numbers.
        aperture_s: of the meter.
        told: what is reported of the extended fit's terms; see `to_model`.
    """
    try:
        return _try(base, extended, spread, aperture_s, told)
    except (ValueError, ArithmeticError, ConfigError):  # figures at the end of what a float, or an estimator, takes
        return None


def _try(base: Fit, extended: Fit, spread: Floats, aperture_s: float, told: Told) -> Promise | None:
    interval_s, span_s = extended.data.interval_s, extended.data.span_s
    aperture_s = min(aperture_s, interval_s)
    options = list[ImmOptions]()
    for fit in (base, extended):
        made, _ = to_model(fit, aperture_s, told if fit is extended else {})
        choice, _ = estimator_for(made, interval_s=interval_s, aperture_s=aperture_s, span_s=span_s)
        if choice is None:
            return None
        options.append(choice.options)
    n = min(extended.data.n, _LONGEST)
    tried = [
        _errors_on(extended, theta, seed, options, n, aperture_s, told)
        for seed, theta in enumerate(_left_open(extended, spread, np.random.default_rng(1)), start=1)
    ]
    errors_V, nats = np.array([each for each, _ in tried]), np.array([each for _, each in tried])
    if not (np.isfinite(errors_V).all() and np.isfinite(nats).all() and (errors_V > 0).all()):
        return None
    ratio, gain = _further(errors_V[:, 1] / errors_V[:, 0]), _further(nats)
    if ratio[2] > _OPEN * ratio[1]:
        return None
    # An estimator that knows only half of what was found may do worse than one that knows nothing of it.
    better = bool(ratio[0] < _NO_BETTER or (ratio[0] <= 1 and gain[0] > 0))
    before_V, after_V = (float(value) for value in np.sqrt(np.mean(errors_V**2, axis=0)))
    if not better:
        after_V, ratio, gain = before_V, np.ones(3), np.zeros(3)
    return Promise(before_V, after_V, Likely(*ratio.tolist()), Likely(*gain.tolist()), n, better)


def _errors_on(
    fit: Fit, theta: Floats, seed: int, options: list[ImmOptions], n: int, aperture_s: float, told: Told
) -> tuple[Floats, float]:
    """Run the estimators over a history of the model with these figures; with the fit's where no model has them."""
    try:
        made, _ = to_model(replace(fit, theta=theta), aperture_s, told)
        return errors_of(options, replace(made, seed=seed), n, fit.data.interval_s, aperture_s)
    except (ValueError, ArithmeticError):  # far from the fitted ones
        made, _ = to_model(fit, aperture_s, told)
        return errors_of(options, replace(made, seed=seed), n, fit.data.interval_s, aperture_s)


def _left_open(fit: Fit, spread: Floats, rng: np.random.Generator) -> Floats:
    """Return free numbers that the readings leave open, one row for each record."""
    low, high = np.array([pair for term in fit.terms for pair in term.bounds], np.float64).reshape(-1, 2).T
    spread = np.nan_to_num((spread + spread.T) / 2, posinf=0.0, neginf=0.0)
    if fit.theta.size and fit.data.n <= _LONG and isinstance(fit.terms[0], Base):
        tried, log_weights = _weighed(fit, spread, low, high, rng)
        best = float(log_weights.max())
        if best > -inf:
            weights = np.exp(log_weights - best)
            # Few draws whose weights are by far the largest say more of luck than of the readings (Ionides, Journal of
            # Computational and Graphical Statistics 17, 295, 2008).
            weights = np.minimum(weights, weights.mean() * sqrt(weights.size))
            at = np.searchsorted(np.cumsum(weights) / weights.sum(), (np.arange(_RECORDS) + rng.random()) / _RECORDS)
            return np.asarray(tried[np.minimum(at, weights.size - 1)])
    root = _root(spread)
    off = np.clip(rng.standard_normal((_RECORDS, root.shape[1])), -_FAR, _FAR) @ root.T
    least = _least(fit, root.shape[1])
    return np.array([_nearer(fit, each, low, high, least) for each in off])


def _nearer(fit: Fit, off: Floats, low: Floats, high: Floats, least: float) -> Floats:
    """Return the fitted numbers and what is off them, by halves of it, until the readings do not rule it out.

    A drift that is hardly there leaves its rate open downwards alone, and a covariance leaves it open upwards, too.
    """
    for _ in range(_HALVINGS):
        tried = np.clip(fit.theta + off, low, high)
        if float(densities(fit.terms, tried, fit.data).sum()) >= least:
            return np.asarray(tried)
        off = off / 2
    return fit.theta


def _weighed(fit: Fit, spread: Floats, low: Floats, high: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return draws of the free numbers and the logarithm of how much each counts, of what the readings leave open.

    A record of some turns of the drift fits a short one best, and leaves open a much longer one, whose mean it knows
    far less: no normal law. So draws of a wide one are weighed by their likelihood (importance sampling), under a prior
    that is even in the logarithms of time constants and sizes, but even in the drift's rate, which may be none.
    """
    slow = signal_and_drift(fit.theta)[1]
    centre, span_s = fit.theta.copy(), fit.data.span_s
    centre[slow] = min(centre[slow], log(span_s))
    sd = sqrt(max(float(spread[slow, slow]), 0.0))
    scale = np.ones(centre.size)
    scale[[slow, slow + 1]] = np.minimum(1.0, _WIDEST / np.maximum(np.sqrt(np.diag(spread)[[slow, slow + 1]]), 1e-9))
    spread = spread * np.outer(scale, scale)
    if sd == 0:  # on a bound
        spread[slow, slow] = _WIDEST**2
    sd = sqrt(float(spread[slow, slow]))
    root = _root(spread)
    free = root.shape[1]
    student = rng.standard_normal((_TRIED, free)) * np.sqrt(_DOF / rng.chisquare(_DOF, (_TRIED, 1)))
    off = student @ root.T
    off[:, slow] = _WIDER * off[:, slow] + _FARTHER * sd
    drawn = centre + off * (high > low)  # rounding may have moved what is held
    # The level is known as well as the drift's mean is over the span T: to rate tau / sqrt(T + 2 tau).
    # What is not possible is left out below, and may be beyond all numbers.
    tau_s, rate = (np.exp(np.clip(drawn[:, at], low[at], high[at])) for at in (slow, slow + 1))
    known = sqrt(max(float(spread[_LEVEL, _LEVEL]), 0.0))
    stretch = np.clip(rate * tau_s / np.sqrt(span_s + 2 * tau_s) / known, 0.3, 20.0) if known > 0 else np.ones(_TRIED)
    drawn[:, _LEVEL] = centre[_LEVEL] + off[:, _LEVEL] * stretch
    density = -(_DOF + free) / 2 * np.log1p(np.sum(student**2, axis=1) / _DOF) - np.log(stretch)
    possible = ((drawn >= low) & (drawn <= high)).all(axis=1) & (drawn[:, slow] <= log(_SLOWEST * span_s))
    likely = np.array(
        [
            float(densities(fit.terms, theta, fit.data).sum()) if within else -inf
            for theta, within in zip(drawn, possible, strict=True)
        ]
    )
    likely[likely < _least(fit, free)] = -inf
    return drawn, likely + drawn[:, slow + 1] - density


def _least(fit: Fit, free: int) -> float:
    """Return the log-likelihood below which the readings rule out what differs from the fit in so many numbers."""
    return float(fit.log_likelihood - chi2.isf(_RULED_OUT, max(free, 1)) / 2)


def _root(spread: Floats) -> Floats:
    """Return a root of a covariance, shape (k, what is free); what rounding made of nothing is nothing."""
    sizes, directions = np.linalg.eigh(spread)
    free = sizes > _NOTHING * sizes.max(initial=0.0)
    return np.asarray(directions[:, free] * np.sqrt(sizes[free]))


def errors_of(
    options: list[ImmOptions], made: Model, n: int, interval_s: float, aperture_s: float
) -> tuple[Floats, float]:
    """Run estimators over one history of a model.

    Args:
        options: of each estimator.
        made: the model, whose seed draws the history.
        n: readings.
        interval_s: from reading to reading.
        aperture_s: of each.

    Returns:
        The root mean square error of each estimate against the model's input, V, but for a constant, and by how much
        the last one's log density of a reading, given those before it, is above the first one's, on average over the
        readings. The constant is what a drift that is slower than the record adds to all of it: no estimator can tell
        it from the level, and with it an error may be larger than all that the readings differ by.
    """
    start_s = np.arange(n, dtype=np.float64) * interval_s
    read = made.realise().read(start_s, aperture_s)
    block = np.zeros(read.value_V.size, READING)
    block["index"], block["value_V"] = read.index, read.value_V
    block["t_ns"] = np.rint(read.stamp_s * 1e9)
    # Readings that were lost without being counted are known by their stamps alone.
    at = np.arange(n) if block.size == n else np.rint((read.stamp_s - aperture_s / 2) / interval_s).astype(np.int64)
    input_V = made.realise().average(start_s, aperture_s).signal_V[np.clip(at, 0, n - 1)]
    counted = np.arange(block.size) >= _SETTLING * n
    errors_V, nats = np.empty(len(options)), np.empty(len(options))
    for number, option in enumerate(options):
        estimates = Imm(option, interval_s).push(block)
        errors_V[number] = np.std((estimates["value_V"] - input_V)[counted])
        nats[number] = estimates["log_likelihood"][counted].mean()
    return errors_V, float(nats[-1] - nats[0])


def _further(values: Floats) -> Floats:
    """Return the median of some records' figures and the ends between which one more's is in 95 %."""
    low, high = np.sort(values)[[1, -2]]
    return np.array([np.median(values), low, high])
