"""The generative model: what we believe makes the readings, as composable terms with physical parameters.

terms ──> sum ──> mean over the aperture ──> effects, one after the other ──> readings
"""

from aemd.model.catalogue import EFFECTS, TERMS, Effect, Model, ModelRealisation, Term, Truth
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
from aemd.model.effect import EffectRealisation, Readings, Witness
from aemd.model.flicker import FlickerNoise
from aemd.model.gauss_markov import GaussMarkov
from aemd.model.link import ClockError, Latency, MissingSamples, ReplayedBlock, StuckReadings, TimestampJitter
from aemd.model.popcorn import PopcornNoise
from aemd.model.reading_noise import DifferenceNoise, HeavyTails, SignalDependentNoise
from aemd.model.resonance import Resonance
from aemd.model.shocks import Shocks
from aemd.model.term import Realisation, Role
from aemd.model.wandering_line import WanderingLine
from aemd.model.white_noise import WhiteNoise
from aemd.model.witnessed import SupplyCoupling, ThermalDrift

__all__ = [
    "EFFECTS",
    "TERMS",
    "ClockError",
    "DeadBand",
    "DifferenceNoise",
    "Effect",
    "EffectRealisation",
    "FlickerNoise",
    "GaussMarkov",
    "HeavyTails",
    "Latency",
    "Level",
    "MissingSamples",
    "Model",
    "ModelRealisation",
    "Nonlinearity",
    "PeriodicPulse",
    "PopcornNoise",
    "Quantiser",
    "RangeSwitching",
    "ReadingPattern",
    "Readings",
    "Realisation",
    "ReplayedBlock",
    "Resonance",
    "Role",
    "Saturation",
    "Shocks",
    "SignalDependentNoise",
    "Sine",
    "Smoothing",
    "SquareBurst",
    "Step",
    "StuckReadings",
    "SupplyCoupling",
    "Term",
    "ThermalDrift",
    "TimestampJitter",
    "Truth",
    "WanderingLine",
    "WarmUp",
    "WhiteNoise",
    "Witness",
]
