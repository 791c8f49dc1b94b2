"""What the extended model's estimator should deliver: its errors beside the base's, on readings that are drawn.

A diagnosis measures how much better the extended model predicts readings. What a user runs is an estimator that knows
less than the model, and what he wants is the input and not the next reading. Neither follows from the other, so it is
tried: histories are drawn from the extended model, whose input is known, and the estimators of the base and of the
extended model, both as fitted, run over them. Each history has other figures, drawn from what the fit leaves open: how
fast the drift is, and so how much of it an estimate takes for the input, ten minutes hardly tell.
"""

from collections.abc import Iterator
from dataclasses import replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from aemd.block import READING
from aemd.diagnose.estimator import estimator_for
from aemd.diagnose.fit import Fit
from aemd.diagnose.result import Likely, Promise
from aemd.diagnose.translate import to_model
from aemd.errors import ConfigError
from aemd.estimate.imm import Imm, ImmOptions
from aemd.model import Model

__all__ = ["errors_of", "promise"]

Floats = NDArray[np.float64]

_RECORDS = 24
_LONGEST = 6000
"""Readings of each record that is drawn."""
_SETTLING = 0.06
"""Part of a record in which an estimator may settle."""
_OPEN = 20.0
"""From the lower to the upper end of what is likely: a promise as wide as that is none."""
_NO_BETTER = 0.99
"""Ratio of errors from which they are the same."""
_FAR = 2.5
"""Standard deviations that a figure is drawn off: what the fit leaves open is a normal law only that far."""


def promise(base: Fit, extended: Fit, spread: Floats, aperture_s: float) -> Promise | None:
    """Return what the extended model's estimator should deliver; none where a model has no input, or no estimator.

    Args:
        base: without what was found.
        extended: with it.
        spread: covariance of the extended fit's free numbers.
        aperture_s: of the meter.
    """
    try:
        return _try(base, extended, spread, aperture_s)
    except (ValueError, ArithmeticError, ConfigError):  # figures at the end of what a float, or an estimator, takes
        return None


def _try(base: Fit, extended: Fit, spread: Floats, aperture_s: float) -> Promise | None:
    interval_s, span_s = extended.data.interval_s, extended.data.span_s
    aperture_s = min(aperture_s, interval_s)
    options = list[ImmOptions]()
    for fit in (base, extended):
        made, _ = to_model(fit, aperture_s)
        choice, _ = estimator_for(made, interval_s=interval_s, aperture_s=aperture_s, span_s=span_s)
        if choice is None:
            return None
        options.append(choice.options)
    n = min(extended.data.n, _LONGEST)
    tried = [
        errors_of(options, drawn, n, interval_s, aperture_s)
        for drawn in _drawn(extended, spread, aperture_s, interval_s)
    ]
    errors_V, nats = np.array([each for each, _ in tried]), np.array([each for _, each in tried])
    if not (np.isfinite(errors_V).all() and np.isfinite(nats).all() and (errors_V > 0).all()):
        return None
    ratio, gain = np.exp(_further(np.log(errors_V[:, 1] / errors_V[:, 0]))), _further(nats)
    if ratio[2] > _OPEN * ratio[1]:
        return None
    # An estimator that knows only half of what was found may do worse than one that knows nothing of it.
    better = bool(ratio[0] < _NO_BETTER or gain[0] > 0)
    before_V, after_V = (float(value) for value in np.sqrt(np.mean(errors_V**2, axis=0)))
    if not better:
        after_V, ratio, gain = before_V, np.ones(3), np.zeros(3)
    return Promise(before_V, after_V, Likely(*ratio.tolist()), Likely(*gain.tolist()), n, better)


def _drawn(fit: Fit, spread: Floats, aperture_s: float, interval_s: float) -> Iterator[Model]:
    """Yield models with figures as far from the fit's as it leaves open, each with a history of its own."""
    rng = np.random.default_rng(1)
    sizes, directions = np.linalg.eigh(np.nan_to_num((spread + spread.T) / 2, posinf=0.0, neginf=0.0))
    root = directions * np.sqrt(np.maximum(sizes, 0.0))
    bounds = np.array([pair for term in fit.terms for pair in term.bounds], np.float64).reshape(-1, 2)
    for number in range(_RECORDS):
        off = root @ np.clip(rng.standard_normal(sizes.size), -_FAR, _FAR)
        moved = np.clip(fit.theta + off, *bounds.T) if off.size else fit.theta
        try:
            made, _ = to_model(replace(fit, theta=moved), aperture_s)
            read = replace(made, seed=number + 1)
            read.realise().read(np.array([0.0, interval_s]), aperture_s)
        except (ValueError, ArithmeticError):  # figures that no model can have, far from the fitted ones
            read = replace(to_model(fit, aperture_s)[0], seed=number + 1)
        yield read


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
        The root mean square error of each estimate against the model's input, V, and by how much the last one's log
        density of a reading, given those before it, is above the first one's, on average over the readings.
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
        errors_V[number] = np.sqrt(np.mean((estimates["value_V"] - input_V)[counted] ** 2))
        nats[number] = estimates["log_likelihood"][counted].mean()
    return errors_V, float(nats[-1] - nats[0])


def _further(values: Floats) -> Floats:
    """Return the mean of some records and the ends between which one more is in 95 %, by Student's law."""
    mean, spread = float(values.mean()), float(values.std(ddof=1))
    reach = float(student.ppf(0.975, values.size - 1)) * spread * sqrt(1 + 1 / values.size)
    return np.array([mean, mean - reach, mean + reach])
