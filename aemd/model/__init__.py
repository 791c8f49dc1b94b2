"""The generative model: what we believe makes the readings, as composable terms with physical parameters.

terms ──> sum ──> mean over the aperture ──> effects, one after the other ──> readings
"""

from aemd.model.catalogue import EFFECTS, TERMS, Effect, Model, ModelRealisation, Term, Truth
from aemd.model.converter import DeadBand, Nonlinearity, Quantiser, RangeSwitching, ReadingPattern, Saturation
from aemd.model.deterministic import Level, Sine, SquareBurst
from aemd.model.effect import EffectRealisation, Readings, Witness
from aemd.model.gauss_markov import GaussMarkov
from aemd.model.link import ClockError, Latency, MissingSamples, ReplayedBlock, StuckReadings, TimestampJitter
from aemd.model.reading_noise import DifferenceNoise, HeavyTails, SignalDependentNoise
from aemd.model.shocks import Shocks
from aemd.model.term import Realisation, Role
from aemd.model.white_noise import WhiteNoise

__all__ = [
    "EFFECTS",
    "TERMS",
    "ClockError",
    "DeadBand",
    "DifferenceNoise",
    "Effect",
    "EffectRealisation",
    "GaussMarkov",
    "HeavyTails",
    "Latency",
    "Level",
    "MissingSamples",
    "Model",
    "ModelRealisation",
    "Nonlinearity",
    "Quantiser",
    "RangeSwitching",
    "ReadingPattern",
    "Readings",
    "Realisation",
    "ReplayedBlock",
    "Role",
    "Saturation",
    "Shocks",
    "SignalDependentNoise",
    "Sine",
    "SquareBurst",
    "StuckReadings",
    "Term",
    "TimestampJitter",
    "Truth",
    "WhiteNoise",
    "Witness",
]
