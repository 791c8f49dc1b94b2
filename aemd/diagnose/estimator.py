"""The `imm` estimator that a model asks for: what is of the input, what disturbs it, and how the two are told apart.

What the estimator knows is less than what the catalogue has. Lines and resonances are parts of their own that it
follows and leaves out of the estimate. A part that it has no place for is given to the nearest process that it has, by
its variance: to the white noise if it moves within a second, else to the slow disturbance. Both keep it out of the
input, which is what a user of the estimate wants, though not as well as its own law would.
"""

from dataclasses import dataclass, field
from math import exp, inf, log, pi, sqrt
from typing import Literal

import numpy as np

from aemd import model
from aemd.config import EstimatorChoice
from aemd.diagnose.terms.lines import fold
from aemd.estimate.imm import ImmOptions

__all__ = ["estimator_for"]

_FOREVER = 100.0
"""Spans of a record: a time constant so long is a random walk's, and a disturbance so rare is none."""
_FAST_S = 1.0
"""Variation within this is met as white noise; what is slower moves with the sensor's drift."""
_LEAST_V = 1e-12
"""Of a standard deviation, which must be above 0; a tenth of the least that any meter resolves."""
_FAR = 30.0
"""Standard deviations of the noise that an abrupt disturbance has where the model has none."""
_INPUT: tuple[Literal["input"]] = ("input",)
_DISTURBANCE: tuple[Literal["disturbance"]] = ("disturbance",)
_UNSEEN = (model.MissingSamples, model.StuckReadings, model.ReplayedBlock, model.TimestampJitter, model.ClockError)
"""Effects that an estimator is told of by a reading's status or its time, or cannot know."""


@dataclass(slots=True)
class _Parts:
    """Variances as they are being gathered, V^2."""

    noise: float = 0.0
    slow: list[tuple[float, float]] = field(default_factory=list)
    """Variance and time constant of each slow process."""
    outliers: tuple[float, float] | None = None
    """Share of the readings and their standard deviation, V."""
    swinging: list[tuple[float, float, float]] = field(default_factory=list)
    """Standard deviation, V, time constant, s, and frequency, Hz, of each line and resonance."""
    memory_s: float = inf
    approximated: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)


def estimator_for(
    made: model.Model, *, interval_s: float, aperture_s: float, span_s: float
) -> tuple[EstimatorChoice | None, tuple[str, ...]]:
    """Return the estimator with a model's numbers, and what it does not model, one line each.

    Args:
        made: the model.
        interval_s: from reading to reading.
        aperture_s: of a reading; white noise depends on it.
        span_s: of the record that the model is from: what is much slower cannot be told from a random walk.

    Returns:
        None for the estimator where the model has no process for the input.
    """
    signal = [term for term in made.terms if isinstance(term, model.GaussMarkov) and term.role == "signal"]
    if not signal:
        return None, ("the model has no Markov process with role = signal, so there is no input to estimate",)
    level_V = sum(term.level_V for term in made.terms if isinstance(term, model.Level))
    parts = _Parts()
    for part in (*made.terms, *made.effects):
        _gather(part, parts, span_s=span_s, interval_s=interval_s, aperture_s=aperture_s, level_V=level_V)
    shocks = [term for term in made.terms if isinstance(term, model.Shocks)]
    if shocks and parts.outliers is not None:  # the one abrupt disturbance that it follows is the shocks'
        share, sd = parts.outliers
        parts.noise += share * sd**2
        parts.outliers = None
        parts.approximated.append("heavy_tails")
    noise_V = max(sqrt(parts.noise), _LEAST_V)
    slow_V, slow_tau_s = _join(parts.slow, span_s)
    disturbed_V, quiet_s, disturbed_s = _abrupt(shocks, parts, signal, noise_V, interval_s, span_s)
    options = ImmOptions(
        signal_V=(
            *(max(_deviation(term, span_s), _LEAST_V) for term in signal),
            *(max(sd_V, _LEAST_V) for sd_V, _, _ in parts.swinging),
        ),
        signal_tau_s=(
            *(min(term.tau_s, _FOREVER * span_s) for term in signal),
            *(tau_s for _, tau_s, _ in parts.swinging),
        ),
        signal_hz=((0.0,) * len(signal) + tuple(hz for _, _, hz in parts.swinging)),
        signal_is=(*_INPUT * len(signal), *_DISTURBANCE * len(parts.swinging)) if parts.swinging else (),
        slow_V=slow_V,
        slow_tau_s=slow_tau_s,
        origin_V=level_V,
        noise_V=noise_V,
        disturbed_V=disturbed_V,
        quiet_s=quiet_s,
        disturbed_s=disturbed_s,
        variance_memory_s=parts.memory_s,
    )
    notes = [f"met as white noise or drift of its variance, not by its own law: {name}" for name in parts.approximated]
    notes += [f"not modelled: {name}" for name in parts.left_out]
    return EstimatorChoice("imm", options), tuple(dict.fromkeys(notes))


def _gather(
    part: object, parts: _Parts, *, span_s: float, interval_s: float, aperture_s: float, level_V: float
) -> None:
    """Put one part where it belongs."""
    match part:
        case model.Level() | model.Shocks():
            return
        case model.GaussMarkov(role="signal"):
            return
        case model.GaussMarkov():
            parts.slow.append((_deviation(part, span_s) ** 2, min(part.tau_s, _FOREVER * span_s)))
        case model.WhiteNoise():
            there = min(part.duration_s, span_s) / span_s
            parts.noise += part.sd(aperture_s) ** 2 * min(there, 1.0)
            if there < 1:  # its factor is followed, fast enough to have learnt it within a fifth of its stay
                parts.memory_s = min(parts.memory_s, max(part.duration_s / 5, 20 * interval_s))
        case model.Sine(role=role, amplitude_V=amplitude, frequency_hz=hz) if role != "signal":
            # As the readings show it, of a phase that the next record will have to find: it forgets within the span.
            parts.swinging.append(
                (abs(amplitude * np.sinc(hz * aperture_s)) / sqrt(2), span_s, fold(hz, 1 / interval_s))
            )
        case model.Resonance(role=role, sd_V=sd, frequency_hz=hz, quality=quality) if (
            role != "signal" and hz < 0.5 / interval_s
        ):
            parts.swinging.append((sd, quality / (pi * hz), hz * sqrt(1 - 1 / (4 * quality**2))))
        case model.WanderingLine(role=role, amplitude_V=amplitude, frequency_hz=hz, chirp_hz_per_s=chirp) if (
            role != "signal" and 0 < hz + chirp * span_s / 2 < 0.5 / interval_s
        ):
            # As wide as it wanders: its phase is lost within the time that its frequencies take to part.
            wandered = abs(chirp) * span_s + part.wander_hz_per_rt_s * sqrt(span_s)
            middle_hz = hz + chirp * span_s / 2
            passed = float(np.sinc(middle_hz * aperture_s))
            parts.swinging.append((abs(amplitude * passed) / sqrt(2), min(span_s, 1 / (pi * wandered)), middle_hz))
        case model.ReadingPattern(offsets_V=(first, second)):
            parts.swinging.append((abs(first - second) / 2, span_s, 0.5 / interval_s))
        case model.Quantiser(step_V=step):
            parts.noise += step**2 / 12
        case model.HeavyTails(sd_V=sd, dof=dof):
            # As two Gaussians with Student's variance and kurtosis; the wide one's share p has 3 (1/p - 1) = 6/(dof-4).
            excess = 6 / (dof - 4) if dof > 4.5 else 12.0
            share = 3 / (3 + excess)
            parts.outliers = (share, sd / sqrt(share))
        case model.FlickerNoise(amplitude_V=amplitude, low_hz=low, high_hz=high):
            # Equal variance in each octave: those above 1/(2 pi) Hz are noise, the others drift at their middle.
            edge = min(max(1 / (2 * pi * _FAST_S), low), high)
            parts.noise += amplitude**2 * log(high / edge)
            if edge > low:
                parts.slow.append((amplitude**2 * log(edge / low), 1 / (2 * pi * sqrt(edge * low))))
            parts.approximated.append("flicker_noise")
        case _:
            _approximate(part, parts, level_V, span_s)


def _approximate(part: object, parts: _Parts, level_V: float, span_s: float) -> None:
    """Give the variance of what has no place to the noise or to the slow part."""
    match part:
        case (
            model.Sine(amplitude_V=amplitude, frequency_hz=hz)
            | model.WanderingLine(amplitude_V=amplitude, frequency_hz=hz)
        ):
            variance, period_s = amplitude**2 / 2, 1 / hz
        case model.Resonance(sd_V=sd, frequency_hz=hz):
            variance, period_s = sd**2, 1 / hz
        case model.DifferenceNoise(sd_V=sd):
            variance, period_s = 2 * sd**2, 0.0
        case model.SignalDependentNoise(fraction=fraction):
            variance, period_s = (fraction * level_V) ** 2, 0.0
        case model.ReadingPattern(offsets_V=offsets):
            variance, period_s = sum(value**2 for value in offsets) / len(offsets), 0.0
        case model.PeriodicPulse(amplitude_V=amplitude, width_s=width, period_s=period):
            variance, period_s = amplitude**2 * width / period * (1 - min(width / period, 1.0)), 0.0
        case model.ThermalDrift(coefficient_V_per_C=coefficient, sd_C=sd, tau_s=tau):
            variance, period_s = (coefficient * sd) ** 2, 2 * pi * tau
        case model.SupplyCoupling(coefficient_per_V=gain, coefficient_V_per_V=offset, sd_V=sd, tau_s=tau):
            variance, period_s = ((gain * level_V + offset) * sd) ** 2, 2 * pi * tau
        case model.PopcornNoise(step_V=step, dwell_low_s=low, dwell_high_s=high):
            share = high / (low + high)
            variance, period_s = step**2 * share * (1 - share), 2 * pi / (1 / low + 1 / high)
        case model.WarmUp(amplitude_V=amplitude, tau_s=tau):
            variance, period_s = amplitude**2 * min(tau / (2 * span_s), 1.0), 2 * pi * tau
        case _:
            if not isinstance(part, _UNSEEN):
                parts.left_out.append(str(getattr(part, "term", None) or getattr(part, "effect", "")))
            return
    parts.approximated.append(str(getattr(part, "term", None) or getattr(part, "effect", "")))
    if period_s < 2 * pi * _FAST_S:
        parts.noise += variance
    elif variance > 0:
        parts.slow.append((variance, min(period_s / (2 * pi), _FOREVER * span_s)))


def _deviation(process: model.GaussMarkov, span_s: float) -> float:
    """Return the standard deviation that a process comes to; a random walk's after so long that it is one, V."""
    return process.rate_V_per_rt_s * sqrt(min(process.tau_s, _FOREVER * span_s) / 2)


def _join(slow: list[tuple[float, float]], span_s: float) -> tuple[float, float]:
    """Return deviation and time constant of one process for all slow ones: their variance, and their rate of change."""
    variance = sum(item[0] for item in slow)
    if variance <= 0:
        return _LEAST_V, _FOREVER * span_s
    rate = sum(item[0] / item[1] for item in slow)
    return max(sqrt(variance), _LEAST_V), variance / rate


def _abrupt(
    shocks: list[model.Shocks],
    parts: _Parts,
    signal: list[model.GaussMarkov],
    noise_V: float,
    interval_s: float,
    span_s: float,
) -> tuple[float, float, float]:
    """Return the deviation of an abrupt disturbance while there is one, and the mean quiet and disturbed times.

    A shock of size A that decays in d is one until it is lost in what the next reading may do anyhow, c: for
    d log(A / c), over which its mean square is A^2 d / (2 T).
    """
    change = noise_V**2 + sum(interval_s * term.rate_V_per_rt_s**2 for term in signal)
    if shocks:
        rate = sum(term.rate_per_s for term in shocks)
        size = sqrt(sum(term.rate_per_s * term.sd_V**2 for term in shocks) / rate)
        decay_s = sum(term.rate_per_s * term.decay_s for term in shocks) / rate
        lasts_s = max(decay_s * max(log(size / sqrt(change)), 1.0), interval_s)
        left = exp(-2 * lasts_s / decay_s) if decay_s > 0 else 0.0
        mean_square = size**2 * min(decay_s / (2 * lasts_s) * (1 - left) if decay_s > 0 else 1.0, 1.0)
        return sqrt(mean_square + change), 1 / rate, lasts_s
    if parts.outliers is not None:
        share, sd = parts.outliers
        return sd, interval_s * (1 / share - 1) if share < 0.99 else interval_s, interval_s
    return _FAR * sqrt(change), _FOREVER * span_s, interval_s
