"""The terms there are, and the model: a sum of terms with a seed.

    [[terms]]
    term = "sine"
    amplitude_V = 2e-3
    frequency_hz = 0.2

Pydantic is named here, and only here in the model, for its tagged union: a mistake in a term is then reported for that
term, and not once for every term there is.
"""

from dataclasses import dataclass, fields
from typing import Annotated, TypeAlias

import numpy as np
from annotated_types import Ge
from pydantic import Discriminator

from aemd.model.deterministic import Level, Sine, SquareBurst
from aemd.model.gauss_markov import GaussMarkov
from aemd.model.shocks import Shocks
from aemd.model.term import Times, Volts
from aemd.model.white_noise import WhiteNoise

__all__ = ["Model", "ModelRealisation", "Term", "Truth"]

Term: TypeAlias = Annotated[Level | Sine | SquareBurst | GaussMarkov | Shocks | WhiteNoise, Discriminator("term")]
"""Any term; its `term` says which."""


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
    """A sum of terms; with its seed, one history."""

    terms: tuple[Term, ...] = ()
    """In an order that belongs to the history: each term draws from a stream of its own, numbered by its place."""
    seed: Annotated[int, Ge(0)] = 1

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
