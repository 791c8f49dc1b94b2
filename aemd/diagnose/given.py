"""A stated model as the hypothesis under criticism: nothing of it is fitted.

What is deterministic goes into the mean by the model's own averages; processes become states of the filter. A process
whose history the filter cannot follow is refused, because to criticise half a model would blame the data for the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from aemd import model
from aemd.diagnose.hypothesis import Bounds, Data, Parameter, Parts
from aemd.diagnose.kernels import MARKOV, PAIR, PAIR_SECOND, PREVIOUS, WHITE
from aemd.diagnose.terms.noise import flicker_processes
from aemd.diagnose.terms.witnessed import lagged
from aemd.errors import ConfigError

__all__ = ["Given", "accept"]

Floats = NDArray[np.float64]

_MEANS = (model.Level, model.Step, model.WarmUp, model.Sine, model.PeriodicPulse, model.SquareBurst)
_DEFECTS: dict[type, str] = {
    model.Quantiser: "quantisation",
    model.Saturation: "saturation",
    model.StuckReadings: "stuck_readings",
    model.ReplayedBlock: "replayed_block",
    model.MissingSamples: "missing_samples",
    model.TimestampJitter: "timestamp_jitter",
    model.ClockError: "clock_error",
    model.DeadBand: "dead_band",
}
"""Effects that are looked for in the readings themselves; those that the model has are no finding."""
_FOLLOWED = (
    *_MEANS,
    model.GaussMarkov,
    model.WhiteNoise,
    model.Shocks,
    model.Resonance,
    model.FlickerNoise,
    model.ThermalDrift,
    model.DifferenceNoise,
    model.Smoothing,
    model.HeavyTails,
    model.SignalDependentNoise,
    model.Nonlinearity,
    model.ReadingPattern,
    model.SupplyCoupling,
    model.WanderingLine,
    *_DEFECTS,
)


def accept(stated: model.Model, place: str) -> tuple["Given", frozenset[str]]:
    """Return the hypothesis, and the defects that are part of it.

    Raises:
        ConfigError: the model has a part that the filter cannot follow; `place` begins the message.
    """
    for part in (*stated.terms, *stated.effects):
        if not isinstance(part, _FOLLOWED):
            name = getattr(part, "term", None) or getattr(part, "effect", "")
            raise ConfigError(f"{place}: {name}: cannot be criticised yet; take it out, and it is looked for instead")
    for term in stated.terms:
        if isinstance(term, model.WanderingLine) and term.wander_hz_per_rt_s > 0:
            raise ConfigError(f"{place}: wandering_line: wander_hz_per_rt_s cannot be criticised yet; set it to 0")
        if isinstance(term, model.Shocks) and term.second_fraction + term.ring_fraction + term.after_shocks > 0:
            keys = "second_fraction, ring_fraction and after_shocks"
            raise ConfigError(f"{place}: shocks: {keys} cannot be criticised yet; set them to 0")
    if sum(isinstance(term, model.Shocks) for term in stated.terms) > 1:
        raise ConfigError(f"{place}: shocks: more than one kind cannot be criticised; join them")
    return Given(stated), frozenset(_DEFECTS[type(effect)] for effect in stated.effects if type(effect) in _DEFECTS)


@dataclass(frozen=True, slots=True)
class Given:
    """All parts of a stated model; it has no free numbers."""

    stated: model.Model
    aperture_s: float = 0.02
    cause: str = "base"
    cost_nats: float = 0.0

    @property
    def start(self) -> Floats:
        """Nothing."""
        return np.empty(0)

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Nothing."""
        return []

    def parameters(self, data: Data) -> Sequence[Parameter]:  # noqa: ARG002 - a Term's
        """Nothing was estimated."""
        return []

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:  # noqa: ARG002 - a Term's
        """Put every part where it belongs."""
        start_s = data.t_s + data.slot[0] * data.interval_s
        rng = np.random.default_rng(0)  # what is deterministic draws nothing
        mean_V = np.zeros(data.y.size)
        for term in self.stated.terms:
            if isinstance(term, (*_MEANS, model.WanderingLine)):
                mean_V += term.realise(rng).average(start_s, self.aperture_s)
            else:
                self._process(term, data, parts, start_s)
        parts.mean += (mean_V - data.origin_V) / data.unit_V
        for effect in self.stated.effects:
            self._effect(effect, data, parts)

    def _process(self, term: object, data: Data, parts: Parts, start_s: Floats) -> None:
        unit = data.unit_V
        match term:
            case model.GaussMarkov(tau_s=tau, rate_V_per_rt_s=rate):
                begin = rate * sqrt(tau / 2) if np.isfinite(tau) else 0.0
                if term.start_V is not None:
                    parts.mean += term.start_V / unit * np.exp(-start_s / tau)
                    begin = 0.0
                parts.states.append((MARKOV, tau, 0.0, rate / unit, begin / unit, 1.0))
            case model.WhiteNoise():
                there = (start_s >= term.start_s) & (start_s < term.start_s + term.duration_s)
                parts.noise_var += there * (term.sd(self.aperture_s) / unit) ** 2
            case model.Shocks(rate_per_s=rate, sd_V=sd, decay_s=decay):
                parts.shocks = np.array([rate, (sd / unit) ** 2, float(len(parts.states))])
                parts.extras[5] = float(np.clip(2 * term.positive_fraction - 1, -0.9999, 0.9999))
                parts.states.append((MARKOV, max(decay, 1e-3 * data.interval_s), 0.0, 0.0, 0.0, 1.0))
            case model.Resonance(frequency_hz=frequency, quality=quality, sd_V=sd):
                tau = quality / (np.pi * frequency)
                omega = 2 * np.pi * frequency * sqrt(1 - 1 / (4 * quality**2))
                parts.states.append((PAIR, tau, omega, sd / unit, sd / unit, 1.0))
                parts.states.append((PAIR_SECOND, tau, omega, sd / unit, sd / unit, 0.0))
            case model.FlickerNoise(amplitude_V=amplitude, low_hz=low, high_hz=high):
                for tau, variance in zip(*flicker_processes(low, high), strict=True):
                    sd = amplitude / unit * sqrt(variance)
                    parts.states.append((MARKOV, tau, 0.0, sd * sqrt(2 / tau), sd, 1.0))
            case model.ThermalDrift(witness=witness, coefficient_V_per_C=coefficient, lag_s=lag, mean_C=mean):
                if witness in data.witnesses:
                    parts.mean += coefficient / unit * lagged(data.witnesses[witness] - mean, data.step_s, lag)

    def _effect(self, effect: object, data: Data, parts: Parts) -> None:
        unit = data.unit_V
        match effect:
            case model.DifferenceNoise(sd_V=sd):
                parts.states.append((WHITE, 1.0, 0.0, sd / unit, sd / unit, 1.0))
                parts.states.append((PREVIOUS, 1.0, 0.0, 0.0, sd / unit, -1.0))
            case model.Smoothing(kept=kept):
                parts.kept = kept
            case model.Quantiser(step_V=step):
                parts.noise_var += (step / unit) ** 2 / 12
            case model.HeavyTails(sd_V=sd, dof=dof):
                # Two Gaussians with the variance and, where it has one, the kurtosis of Student's law.
                excess = 6 / (dof - 4) if dof > 4.5 else 12.0
                fraction = 3 / (3 + excess)
                parts.extras[2], parts.extras[3] = fraction, (sd / unit) ** 2 / fraction
            case model.SignalDependentNoise(fraction=fraction):
                parts.extras[0] = fraction**2
                parts.extras[4] = float(parts.mean[0]) + data.origin_V / unit
            case model.Nonlinearity(coefficient_per_V=coefficient, centre_V=centre):
                # About the level x, the bent scale has the slope 1 + 2 b (x - centre).
                away = float(parts.mean.mean()) + (data.origin_V - centre) / unit
                bend = coefficient * unit
                parts.mean += bend * away**2
                parts.scale = parts.scale * (1 + 2 * bend * away)
                parts.extras[1] = bend
            case model.ReadingPattern(offsets_V=offsets, first=first):
                parts.mean += np.array(offsets)[(data.slot + first) % len(offsets)] / unit
            case model.SupplyCoupling(witness=witness, coefficient_per_V=coefficient, mean_V=mean):
                if witness in data.witnesses:
                    gain = 1 + coefficient * (data.witnesses[witness] - mean)
                    zero = data.origin_V / unit
                    parts.mean = (parts.mean + zero) * gain - zero
                    parts.scale = parts.scale * gain
                    parts.noise_var = parts.noise_var * gain**2
