"""What a term of the generative model is: frozen parameters with units, and a realisation asked forward in time.

A meter never sees its input at an instant but the mean over its aperture, so that mean is what a term answers, exactly
where a closed form exists. A deterministic term is its own realisation; a random one keeps its generator and its state.
A new mechanism is one more frozen dataclass with a `term` tag, a `role` and `realise`, and its name in catalogue.py.
"""

from math import inf
from typing import Annotated, Literal, Protocol, TypeAlias

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

__all__ = ["Finite", "NonNegative", "Positive", "PositiveOrInfinite", "Realisation", "Role", "Times", "Volts"]

Times: TypeAlias = NDArray[np.float64]
"""Instants, s, shape (n,), sorted."""

Volts: TypeAlias = NDArray[np.float64]
"""Voltages, V, shape (n,)."""

Role: TypeAlias = Literal["signal", "internal", "external", "noise"]
"""What a term is to an estimator: the true input s, the slow disturbance u_in, the abrupt one u_ex, or noise w."""

Finite: TypeAlias = Annotated[float, Interval(gt=-inf, lt=inf)]
NonNegative: TypeAlias = Annotated[float, Interval(ge=0, lt=inf)]
Positive: TypeAlias = Annotated[float, Interval(gt=0, lt=inf)]
PositiveOrInfinite: TypeAlias = Annotated[float, Interval(gt=0, le=inf)]


class Realisation(Protocol):
    """One history of a term; how it is cut into requests does not change it."""

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return the mean over each aperture [start, start + aperture), V, shape (n,).

        Args:
            start_s: beginnings of the apertures, s >= 0, shape (n,); apertures do not overlap and none begins before
                the end of one that was asked for earlier.
            aperture_s: their common length, s, > 0.
        """
