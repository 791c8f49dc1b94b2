"""What a second instrument saw: regressed on as it is, late, through a lag, and as a gain."""

from math import log, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate
from scipy.stats import chi2

from aemd import model
from aemd.diagnose.climb import Climb, race
from aemd.diagnose.evidence import Evidence, bonferroni, two_sided
from aemd.diagnose.fit import Fit, residuals
from aemd.diagnose.given import Given
from aemd.diagnose.hypothesis import Base, Data
from aemd.diagnose.terms.lines import amplitude_cost
from aemd.diagnose.terms.witnessed import Latency, SupplyCoupling, ThermalDrift, lagged, odds_against

__all__ = ["check_witness", "gains_like_noise"]

Floats = NDArray[np.float64]

_SLIDES = 40
_LAGS_S = (3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
_LESS_DRIFT = (0.0, 2.0)
"""By how much the drift's logarithm of its rate is lowered, where it may have grown for what the witness explains."""
_FEW_TURNS = 1.3
_LONGEST_DELAY = 600
"""Readings, either way."""


def check_witness(fit: Fit, name: str) -> list[Evidence]:
    """Regress the readings on a witness, through a lag and late, and the residuals on its product with the reading.

    The drift of who does not know the witness has grown until it follows what the witness does, and then nothing is
    left of it in the residuals. So the first two are likelihood ratios, the drift fitted again beside each.
    """
    data = fit.data
    witness = data.witnesses[name] - float(np.mean(data.witnesses[name]))
    one = amplitude_cost(1, data.n)
    unusual = odds_against("thermal_drift", name)
    known = _has(fit, name)
    lags = [0.0] + [lag for lag in _LAGS_S if 2 * data.interval_s < lag < data.span_s / 5]
    through = [lagged(witness, data.step_s, lag) for lag in lags]
    at_lag, size = _best(fit, through)
    terms: list[ThermalDrift | Latency] = []
    thermal = ThermalDrift(name, lags[at_lag], size, (2 if lags[at_lag] else 1) * one + unusual)
    gains = {"thermal_drift": _gained(fit, thermal)}
    terms.append(thermal)
    if lags[at_lag] == 0.0:
        terms.append(ThermalDrift(name, 3 * data.interval_s, size, 2 * one + unusual))
    delay, size, delays = _best_delay(fit, witness)
    if delay:
        terms.append(Latency(name, delay, size, known, one + log(delays)))
        gains["latency"] = _gained(fit, terms[-1])
    # A gain multiplies what is predicted, and the innovation as well: both halves of its score.
    reading = fit.predicted + data.origin_V / data.unit_V
    score, strength = _slid_score(fit, fit.whitened(witness * reading), 2 * witness)
    cost = one + odds_against("supply_coupling", name)
    # The drift may have grown for it until nothing is left; then the offset that the witness brings tells the gain.
    level = float(np.mean(reading[data.used]))
    sizes = [score / max(strength, 1e-12), *([thermal.coefficient / level] if abs(level) > 1 else [])]
    coupled = [SupplyCoupling(name, size, cost) for size in sizes]
    found = []
    for cause, trials in (("latency", delays), ("thermal_drift", len(lags))):
        if cause not in gains or (known and cause == "thermal_drift"):
            continue
        # Where the drift has few turns in the record, twice the gain is a little larger than chi-square.
        p_value = bonferroni(float(chi2.sf(2 * max(gains[cause], 0.0) / _FEW_TURNS, 1)), trials)
        how = "late or early" if cause == "latency" else "as it is or through a lag"
        found.append(
            Evidence(
                check=f"readings on {name}, {how}: log-likelihood gained, nats",
                p_value=p_value,
                observed=gains[cause],
                low=0.0,
                high=_FEW_TURNS * float(chi2.isf(0.025 / trials, 1)) / 2,
                terms=(*terms, *coupled) if p_value < 0.05 else (),
            )
        )
    p_value = two_sided(score)
    found.append(
        Evidence(
            check=f"residuals against {name} times the reading: score in deviations",
            p_value=p_value,
            observed=abs(score),
            low=0.03,
            high=2.24,
            terms=(*coupled, *(() if known else terms)) if p_value < 0.05 else (),
        )
    )
    return found


def gains_like_noise(fit: Fit) -> list[SupplyCoupling]:
    """Return the gains by which all that varies would swell with each witness as the residuals' squares do.

    Of readings about 0 V a gain leaves hardly more than that: rivals of a noise that swells, and no check.
    """
    data, squares = fit.data, np.where(fit.data.used, fit.z**2 - 1, 0.0)
    found = []
    for name, values in data.witnesses.items():
        witness = values - float(np.mean(values))
        strength = 2 * float(witness @ witness)
        if strength > 0 and not _has(fit, name):
            cost = amplitude_cost(1, data.n) + odds_against("supply_coupling", name)
            found.append(SupplyCoupling(name, float(squares @ witness) / strength, cost))
    return found


def _best(fit: Fit, shapes: list[Floats]) -> tuple[int, float]:
    """Return which shape explains most, and its size, whether the drift stays as it is or is small again."""
    tries = []
    for less in _LESS_DRIFT if isinstance(fit.terms[0], Base) else (0.0,):
        theta = fit.theta.copy()
        if less:
            theta[3] -= less
        trial = residuals(fit.terms, theta, fit.data) if less else fit
        for number, shape in enumerate(shapes):
            left = trial.whitened(shape)
            size = max(float(left @ left), 1e-300)
            score = float(left @ trial.z)
            tries.append((trial.log_likelihood + 0.5 * score**2 / size, number, score / size))
    _, number, size = max(tries)
    return number, size


def _best_delay(fit: Fit, witness: Floats) -> tuple[float, float, int]:
    """Return the delay, s, at which the witness explains most, its size, and how many delays were tried.

    The filter does to a late witness what it does to a punctual one, later; so one correlation serves all delays.
    """
    data = fit.data
    most = min(_LONGEST_DELAY, data.y.size // 5)
    tries = []
    for less in _LESS_DRIFT if isinstance(fit.terms[0], Base) else (0.0,):
        theta = fit.theta.copy()
        if less:
            theta[3] -= less
        trial = residuals(fit.terms, theta, data) if less else fit
        left = trial.whitened(witness)
        size = max(float(left @ left), 1e-300)
        # On the grid: a delay of so many intervals is one of fewer readings where some are lost.
        z, shape = (_on_grid(data, values) for values in (trial.z, left))
        together = correlate(z, shape, mode="full", method="fft")[shape.size - 1 - most : shape.size + most]
        together[most - 1 : most + 2] = 0.0  # that is no delay
        at = int(np.argmax(np.abs(together)))
        score = float(together[at])
        tries.append((trial.log_likelihood + 0.5 * score**2 / size, (at - most) * data.interval_s, score / size))
    _, delay, size = max(tries)
    return delay, size, 2 * most


def _on_grid(data: Data, values: Floats) -> Floats:
    """Return values at the places of their readings, 0 where one is missing, shape (places,)."""
    even = np.zeros(int(data.slot[-1]) + 1)
    even[data.slot] = values
    return even


def _gained(fit: Fit, term: ThermalDrift | Latency) -> float:
    """Return the log-likelihood that a witness adds once all is fitted again, nats."""
    starts = []
    for less in _LESS_DRIFT if isinstance(fit.terms[0], Base) else (0.0,):
        theta = np.concatenate((fit.theta, term.start))
        if less:
            theta[3] -= less
        starts.append(Climb([*fit.terms, term], theta, fit.data))
    return race(starts, 6)[0].value - fit.log_likelihood


def _has(fit: Fit, name: str) -> bool:
    """Return whether the model has the witness already."""
    return any(
        (isinstance(term, ThermalDrift) and term.witness == name)
        or (
            isinstance(term, Given)
            and (
                any(isinstance(part, model.ThermalDrift) and part.witness == name for part in term.stated.terms)
                or any(
                    isinstance(part, model.SupplyCoupling) and part.witness == name and part.coefficient_V_per_V != 0
                    for part in term.stated.effects
                )
            )
        )
        for term in fit.terms
    )


def _slid_score(fit: Fit, shape: Floats, louder: Floats | None = None) -> tuple[float, float]:
    """Return the score of a whitened shape, not counted above what its slid copies allow, and the score's size.

    Args:
        fit: whose residuals.
        shape: change of the residuals by a unit of the effect, shape (n,).
        louder: change of the logarithm of the innovation's variance by it, shape (n,).
    """
    used, n = fit.data.used, shape.size
    size = float(np.sum(shape**2))
    # Without what the shape itself explains, or a witness that repeats would be its own slid copy.
    z = fit.z - shape * (float(shape @ fit.z) / float(shape @ shape)) if shape.any() else fit.z
    squares = np.where(used, fit.z**2 - 1, 0.0)
    if louder is not None:
        louder = np.where(used, louder - louder[used].mean(), 0.0)
        size += 0.25 * float(np.sum(louder**2)) * float(np.mean(squares[used] ** 2))
    size = sqrt(size)
    if size == 0:
        return 0.0, 1.0

    def score(slide: int, left: Floats) -> float:
        total = float(np.roll(shape, slide) @ left)
        return (total if louder is None else total + 0.5 * float(np.roll(louder, slide) @ squares)) / size

    slides = np.linspace(0.1 * n, 0.9 * n, _SLIDES).astype(int)
    spread = sqrt(float(np.mean([score(int(slide), z) ** 2 for slide in slides])))
    return score(0, fit.z) / max(spread, 1.0), size
