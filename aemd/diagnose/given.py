"""A stated model as the hypothesis under criticism: nothing of it is fitted.

What is deterministic goes into the mean by the model's own averages; processes become states of the filter, with what
the mean over an aperture leaves of them; what was done to the readings after all noise is undone. A part that none of
this carries is refused, because to criticise half a model would blame the data for the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from aemd import model
from aemd.diagnose.apertures import averaged_markov, averaged_pair, struck_between
from aemd.diagnose.hypothesis import Data, Fixed, Parts
from aemd.diagnose.kernels import MARKOV, PAIR, PAIR_SECOND, PREVIOUS, WHITE
from aemd.diagnose.terms.witnessed import delayed, lagged
from aemd.diagnose.undone import ABOUT_VALUES, UNDONE, doubtful, undo, wider_noise
from aemd.errors import ConfigError

__all__ = ["BOUNDED", "Given", "accept", "student"]

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
BOUNDED = ("quantisation", "saturation", "dead_band")
"""Defects that leave an interval: where the model has them, the filter knows, and no reading is left out for them."""
_NOISES = (model.DifferenceNoise, model.HeavyTails, model.SignalDependentNoise)
_MET = (model.Nonlinearity, model.SupplyCoupling, model.ReadingPattern)
"""Effects that may also come before a noise: the filter meets them by their slope at the prediction."""
_DOUBTFUL = 0.01
"""Share of the readings whose range is in doubt, from which a model that is right would be found wrong."""
_TAIL = np.array([1.0, 0.85, 0.65, 0.45, 0.25, 0.1, 0.03, 0.008, 0.002, 0.0005, 0.0])
"""Probabilities at which Student's law, as a mixture of normal laws, is cut; finer where one is rare and wide."""


def accept(stated: model.Model, place: str) -> tuple["Given", frozenset[str]]:
    """Return the hypothesis, and the defects that are part of it.

    Raises:
        ConfigError: the model has a part that the likelihood does not carry; one line that begins with `place`.
    """
    way_out = "take it out, and it is looked for instead"
    shocks = [term for term in stated.terms if isinstance(term, model.Shocks)]
    jumping = [term for term in stated.terms if isinstance(term, model.PopcornNoise)]
    for term in stated.terms:
        if isinstance(term, model.WanderingLine) and term.wander_hz_per_rt_s > 0:
            raise ConfigError(
                f"{place}: wandering_line: wander_hz_per_rt_s: no likelihood here follows a frequency that wanders at "
                "random; set it to 0"
            )
        if isinstance(term, model.Shocks) and term.after_shocks > 0:
            raise ConfigError(f"{place}: shocks: after_shocks: the likelihood has each shock come alone; set it to 0")
    if len(shocks) > 1:
        raise ConfigError(f"{place}: shocks: the likelihood carries one kind; join them")
    if len(jumping) > 1:
        raise ConfigError(f"{place}: popcorn_noise: the likelihood carries one; {way_out}")
    _, before = _split(stated.effects)
    for effect in before:
        if not isinstance(effect, (*_NOISES, *_MET)):
            raise ConfigError(
                f"{place}: {_name(effect)}: the likelihood carries it after all noise, and here "
                f"{_name(next(item for item in reversed(stated.effects) if isinstance(item, _NOISES)))} comes later; "
                "change their order"
            )
    if jumping:
        beside = [*shocks, *(item for item in stated.effects if isinstance(item, (*_NOISES[1:], *UNDONE.__args__)))]
        for part in beside:
            if not isinstance(part, (model.ReadingPattern, model.SupplyCoupling, model.Smoothing)):
                raise ConfigError(
                    f"{place}: popcorn_noise: the likelihood does not carry it beside {_name(part)}; {way_out}"
                )
    return Given(stated, place=place), frozenset(
        _DEFECTS[type(effect)] for effect in stated.effects if type(effect) in _DEFECTS
    )


def _name(part: object) -> str:
    return str(getattr(part, "term", None) or getattr(part, "effect", ""))


def _split(effects: Sequence[object]) -> tuple[tuple[object, ...], tuple[object, ...]]:
    """Return the effects on values after the last noise, and those up to it."""
    changing = [effect for effect in effects if isinstance(effect, ABOUT_VALUES)]
    last = max((number for number, effect in enumerate(changing, start=1) if isinstance(effect, _NOISES)), default=0)
    return tuple(changing[last:]), tuple(changing[:last])


def student(variance: float, dof: float) -> tuple[Floats, Floats]:
    """Return probabilities and variances of normal laws that mix to Student's law of this variance, narrowest first.

    Student's number is a normal one over the root of X/dof, X chi-square of dof degrees; the mean of 1/X over a part of
    its law is that part's probability under dof - 2 degrees, over dof - 2 (its density is x times that law's).
    """
    edges = chi2.ppf(_TAIL, dof)
    shares = -np.diff(_TAIL)
    inverse = -np.diff(chi2.cdf(edges, dof - 2)) / shares  # mean of (dof - 2)/X
    return shares, np.asarray(variance * inverse)


@dataclass(frozen=True, slots=True)
class Given(Fixed):
    """All parts of a stated model; it has no free numbers."""

    stated: model.Model
    aperture_s: float = 0.02
    cause: str = "base"
    cost_nats: float = 0.0
    place: str = ""
    """Where the model stands, for a refusal."""

    def refuse(self, data: Data) -> None:
        """Refuse what the likelihood does not carry of these readings, though it does of others.

        Raises:
            ConfigError: the range of too many readings cannot be told.
        """
        share = doubtful(_split(self.stated.effects)[0], data)
        if share > _DOUBTFUL:
            raise ConfigError(
                f"{self.place}: range_switching: sd_V: with that noise {100 * share:.0f} % of the readings may be of "
                "either range, and the likelihood cannot carry it; take it out, and it is looked for instead"
            )

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
        after, before = _split(self.stated.effects)
        for effect in before:
            self._effect(effect, data, parts)
        if after:
            parts.noise_var += wider_noise(after, data) / data.unit_V**2
            parts.undo = lambda seen: undo(seen, after, data)

    def _process(self, term: object, data: Data, parts: Parts, start_s: Floats) -> None:
        unit, aperture_s = data.unit_V, self.aperture_s
        match term:
            case model.GaussMarkov(tau_s=tau, rate_V_per_rt_s=rate):
                kept, lost = averaged_markov(tau, rate / unit, aperture_s)
                begin = kept * sqrt(tau / 2) if np.isfinite(tau) else kept * sqrt(start_s[0] + aperture_s / 2)
                if term.start_V is not None:
                    faded = np.exp(-start_s / tau) * (
                        -np.expm1(-aperture_s / tau) * tau / aperture_s if tau < 1e9 else 1
                    )
                    parts.mean += term.start_V / unit * faded
                    begin = kept * sqrt(start_s[0] + aperture_s / 2)
                parts.states.append((MARKOV, tau, 0.0, kept, begin, 1.0))
                parts.average_out(lost)
            case model.WhiteNoise():
                there = (start_s >= term.start_s) & (start_s < term.start_s + term.duration_s)
                parts.noise_var += there * (term.sd(aperture_s) / unit) ** 2
            case model.Shocks():
                self._shocks(term, data, parts)
            case model.Resonance(frequency_hz=frequency, quality=quality, sd_V=sd):
                tau = quality / (np.pi * frequency)
                omega = 2 * np.pi * frequency * sqrt(1 - 1 / (4 * quality**2))
                kept, lost = averaged_pair(tau, omega, sd / unit, aperture_s)
                parts.states.append((PAIR, tau, omega, kept, kept, 1.0))
                parts.states.append((PAIR_SECOND, tau, omega, kept, kept, 0.0))
                parts.average_out(lost)
            case model.FlickerNoise():
                for process in term.processes:
                    self._process(process, data, parts, start_s)
            case model.PopcornNoise(step_V=step, dwell_low_s=low, dwell_high_s=high):
                if step < 0:  # the same from the lower level
                    parts.mean += step / unit
                    low, high = high, low
                parts.telegraph = np.array([abs(step) / unit, low, high])
            case model.ThermalDrift(witness=witness, coefficient_V_per_C=coefficient, lag_s=lag, mean_C=mean):
                if witness in data.witnesses:
                    late_s = sum(item.lag_s for item in self.stated.effects if isinstance(item, model.Latency))
                    then = delayed(data.witnesses[witness], data.t_s, late_s) if late_s else data.witnesses[witness]
                    parts.mean += coefficient / unit * lagged(then - mean, data.step_s, lag)

    def _shocks(self, shocks: model.Shocks, data: Data, parts: Parts) -> None:
        """Add the states that a shock strikes: its decay, and where it has them a second decay and a ring."""
        at, step_s = len(parts.states), data.interval_s
        rate, size = shocks.rate_per_s, shocks.sd_V / data.unit_V
        if shocks.decay_s < 1e-3 * step_s:  # without shape it must fall into an aperture to be seen at all
            rate *= self.aperture_s / step_s
        shares = [1 - shocks.second_fraction]
        decays = [max(shocks.decay_s, 1e-3 * step_s)]
        if shocks.second_fraction > 0:
            shares.append(shocks.second_fraction)
            decays.append(shocks.second_decay_s)
        seen = [struck_between(decay_s, step_s) if decay_s > 1e-3 * step_s else 1.0 for decay_s in decays]
        for decay_s in decays:
            parts.states.append((MARKOV, decay_s, 0.0, 0.0, 0.0, 1.0))
        struck = [share * part for share, part in zip(shares, seen, strict=True)]
        if shocks.ring_fraction > 0:
            tau, omega = shocks.ring_decay_s, 2 * np.pi * shocks.ring_hz
            passed = float(np.sinc(shocks.ring_hz * self.aperture_s)) * shocks.ring_fraction
            # Struck in the one, the other of the pair swings as the negative sine; half a step has passed on average.
            turned, left = omega * step_s / 2, struck_between(tau, step_s)
            parts.states.append((PAIR, tau, omega, 0.0, 0.0, 0.0))
            parts.states.append((PAIR_SECOND, tau, omega, 0.0, 0.0, -passed))
            struck += [left * np.cos(turned), -left * np.sin(turned)]
        parts.shocks = np.array([rate, size**2, at])
        parts.struck = [0.0] * at + struck
        parts.extras[5] = float(np.clip(2 * shocks.positive_fraction - 1, -0.9999, 0.9999))

    def _effect(self, effect: object, data: Data, parts: Parts) -> None:
        """Add a noise, or what comes before one."""
        unit = data.unit_V
        match effect:
            case model.DifferenceNoise(sd_V=sd):
                parts.states.append((WHITE, 1.0, 0.0, sd / unit, sd / unit, 1.0))
                parts.states.append((PREVIOUS, 1.5 * data.interval_s, 0.0, sd / unit, sd / unit, -1.0))
            case model.HeavyTails(sd_V=sd, dof=dof):
                shares, variances = student((sd / unit) ** 2, dof)
                parts.noise_var += variances[0]
                parts.tails += zip(shares[1:].tolist(), (variances[1:] - variances[0]).tolist(), strict=True)
            case model.SignalDependentNoise(fraction=fraction):
                parts.extras[0] = -(fraction**2)
                parts.extras[4] = data.origin_V / unit
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
                    apart = data.witnesses[witness] - mean
                    gain = 1 + coefficient * apart
                    zero = data.origin_V / unit
                    parts.mean = (parts.mean + zero) * gain - zero
                    parts.scale = parts.scale * gain
                    parts.noise_var, parts.averaged = parts.noise_var * gain**2, parts.averaged * gain**2
                    parts.mean += effect.coefficient_V_per_V / unit * lagged(apart, data.step_s, effect.lag_s)
