"""The terms and effects there are, and the model: a sum of terms, then effects one after the other, with a seed.

    [[terms]]
    term = "sine"
    amplitude_V = 2e-3
    frequency_hz = 0.2

    [[effects]]
    effect = "quantiser"
    step_V = 1e-6

Pydantic is named here, and only here in the model, for its tagged union: a mistake in a term is then reported for that
term, and not once for every term there is.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, TypeAlias, get_args

import numpy as np
from annotated_types import Ge
from pydantic import Discriminator

from aemd.model.converter import (
    DeadBand,
    Nonlinearity,
    Quantiser,
    RangeSwitching,
    ReadingPattern,
    Saturation,
    Smoothing,
)
from aemd.model.deterministic import Level, PeriodicPulse, Sine, SquareBurst, Step, WarmUp
from aemd.model.effect import Readings, Witness
from aemd.model.flicker import FlickerNoise
from aemd.model.gauss_markov import GaussMarkov
from aemd.model.link import ClockError, Latency, MissingSamples, ReplayedBlock, StuckReadings, TimestampJitter
from aemd.model.popcorn import PopcornNoise
from aemd.model.reading_noise import DifferenceNoise, HeavyTails, SignalDependentNoise
from aemd.model.resonance import Resonance
from aemd.model.shocks import Shocks
from aemd.model.term import Times, Volts
from aemd.model.wandering_line import WanderingLine
from aemd.model.white_noise import WhiteNoise
from aemd.model.witnessed import SupplyCoupling, ThermalDrift, ThermalDriftRealisation

__all__ = ["EFFECTS", "TERMS", "Effect", "Model", "ModelRealisation", "Term", "Truth"]

Term: TypeAlias = Annotated[
    Level
    | Step
    | WarmUp
    | Sine
    | WanderingLine
    | PeriodicPulse
    | SquareBurst
    | GaussMarkov
    | FlickerNoise
    | PopcornNoise
    | Resonance
    | ThermalDrift
    | Shocks
    | WhiteNoise,
    Discriminator("term"),
]
"""Any term; its `term` says which."""

Effect: TypeAlias = Annotated[
    DifferenceNoise
    | HeavyTails
    | SignalDependentNoise
    | SupplyCoupling
    | Nonlinearity
    | DeadBand
    | RangeSwitching
    | ReadingPattern
    | Smoothing
    | Saturation
    | Quantiser
    | StuckReadings
    | ReplayedBlock
    | MissingSamples
    | TimestampJitter
    | ClockError
    | Latency,
    Discriminator("effect"),
]
"""Any effect; its `effect` says which."""

# The tag is the first field's default; a class with slots does not have it as an attribute.
TERMS: Mapping[str, type[Term]] = {str(fields(kind)[0].default): kind for kind in get_args(get_args(Term)[0])}
EFFECTS: Mapping[str, type[Effect]] = {str(fields(kind)[0].default): kind for kind in get_args(get_args(Effect)[0])}

_EFFECT_STREAMS = 1 << 31  # number of the first effect's stream; no model has so many terms


@dataclass(frozen=True, slots=True)
class Truth:
    """What really was at the input: means over each aperture, V, each of shape (n,)."""

    signal_V: Volts
    """The true input s."""
    internal_V: Volts
    """The slow disturbance u_in."""
    external_V: Volts
    """The abrupt disturbance u_ex."""
    noise_V: Volts
    """Noise of the input; the meter's own is not in it."""

    @property
    def total(self) -> Volts:
        """Their sum, V, shape (n,)."""
        return np.asarray(self.signal_V + self.internal_V + self.external_V + self.noise_V)


@dataclass(frozen=True, slots=True)
class Model:
    """A sum of terms, then effects; with its seed, one history."""

    terms: tuple[Term, ...] = ()
    """In an order that belongs to the history: each term draws from a stream of its own, numbered by its place."""
    seed: Annotated[int, Ge(0)] = 1
    effects: tuple[Effect, ...] = ()
    """In the order in which they meet a reading."""

    @property
    def witnesses(self) -> dict[str, str]:
        """Unit of each further quantity that a reading comes with, by its name."""
        return {
            part.witness: "V" if isinstance(part, SupplyCoupling) else "\N{DEGREE SIGN}C"
            for part in (*self.terms, *self.effects)
            if isinstance(part, ThermalDrift | SupplyCoupling)
        }

    def __post_init__(self) -> None:
        """Refuse two parts that would be witnessed under one name."""
        for kind in (ThermalDrift, SupplyCoupling):
            if sum(isinstance(part, kind) for part in (*self.terms, *self.effects)) > 1:
                raise ValueError(f"{fields(kind)[0].default}: at most one, since it is recorded under one name")

    def realise(self) -> "ModelRealisation":
        """Return the model's one history, at t = 0."""
        return ModelRealisation(self)


class ModelRealisation:
    """One history of a model, asked forward in time; how it is cut into requests does not change a bit of it."""

    def __init__(self, model: Model) -> None:
        streams = np.random.SeedSequence(model.seed).spawn(len(model.terms))
        self._terms = [
            (term.role, term.realise(np.random.default_rng(stream)))
            for term, stream in zip(model.terms, streams, strict=True)
        ]
        self._effects = [
            effect.realise(np.random.default_rng(np.random.SeedSequence(model.seed, spawn_key=(number,))))
            for number, effect in enumerate(model.effects, start=_EFFECT_STREAMS)
        ]
        self._readings = 0

    def average(self, start_s: Times, aperture_s: float) -> Truth:
        """Return the means over each aperture [start, start + aperture), by role.

        Args:
            start_s: beginnings of the apertures, s >= 0, shape (n,), sorted, not overlapping, never going back.
            aperture_s: their common length, s, > 0.
        """
        truth = Truth(*(np.zeros(start_s.size) for _ in fields(Truth)))
        by_role = {
            "signal": truth.signal_V,
            "internal": truth.internal_V,
            "external": truth.external_V,
            "noise": truth.noise_V,
        }
        for role, realisation in self._terms:
            by_role[role] += realisation.average(start_s, aperture_s)
        return truth

    def read(self, start_s: Times, aperture_s: float) -> Readings:
        """Return the readings that a meter with these apertures delivers, after all effects.

        Args:
            start_s: as of `average`; call one or the other.
            aperture_s: as of `average`.
        """
        index = np.arange(self._readings, self._readings + start_s.size)
        self._readings += start_s.size
        middle_s = start_s + aperture_s / 2
        value_V = self.average(start_s, aperture_s).total
        witnesses: dict[str, Witness] = {
            term.name: Witness(middle_s, term.temperature_C)
            for _, term in self._terms
            if isinstance(term, ThermalDriftRealisation)
        }
        readings = Readings(index, middle_s, value_V, witnesses)
        for effect in self._effects:
            readings = effect.apply(readings)
        return readings
