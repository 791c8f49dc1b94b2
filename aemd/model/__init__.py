"""The generative model: what we believe makes the readings, as composable terms with physical parameters."""

from aemd.model.catalogue import Model, ModelRealisation, Term, Truth
from aemd.model.deterministic import Level, Sine, SquareBurst
from aemd.model.gauss_markov import GaussMarkov
from aemd.model.shocks import Shocks
from aemd.model.term import Realisation, Role
from aemd.model.white_noise import WhiteNoise

__all__ = [
    "GaussMarkov",
    "Level",
    "Model",
    "ModelRealisation",
    "Realisation",
    "Role",
    "Shocks",
    "Sine",
    "SquareBurst",
    "Term",
    "Truth",
    "WhiteNoise",
]
