"""The lattice that readings lie on where something rounded them."""

from math import floor, inf, log10

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.series import Series

__all__ = ["coarser_beyond", "find_lattice", "find_lattice_within"]

Floats = NDArray[np.float64]

_DISTINCT = 0.9
"""Part of the values that may be distinct, at most, on a lattice."""
_PATTERNS = (2, 3, 4, 5)
"""Periods, readings, of what may have been added to a lattice."""
_UNEVEN = 0.1
_FITTING = 0.95
_A_DIGIT = (9.0, 11.0)
"""Steps of a lattice that one of a digit less has."""


def find_lattice(values: Floats) -> float:
    """Return the step of the lattice that the values lie on; 0 if there is none.

    The steps between neighbouring distinct values must be whole multiples of their typical one, to a tenth: a meter's
    lattice that a log rounded to decimals is not exact. Values that hardly ever repeat have no lattice that matters.

    >>> find_lattice(np.array([0.3, 0.1, 0.7, 0.4, 0.2] * 20))
    0.1
    """
    distinct, counts = np.unique(values, return_counts=True)
    if distinct.size < 2 or distinct.size > _DISTINCT * values.size:
        return 0.0
    steps = np.diff(distinct)
    near = np.minimum(np.concatenate((steps, [inf])), np.concatenate(([inf], steps)))
    order = np.argsort(near)
    q = float(near[order][np.searchsorted(np.cumsum(counts[order]), 0.5 * values.size)])
    multiples = np.maximum(np.rint(steps / q), 1.0)
    if np.mean(np.abs(steps / q - multiples) < _UNEVEN * np.sqrt(multiples)) < _FITTING:
        return 0.0
    q = float(steps.sum() / multiples.sum())
    short = float(f"{q:.3g}")
    return short if abs(short - q) * float(multiples.sum()) < 0.1 * q else q


def find_lattice_within(series: Series) -> float:
    """Return the step of a lattice to which a pattern of some readings' period was added; 0 if there is none.

    Together its phases are as many lattices beside each other, with uneven steps between; each alone is one, of the
    same step.
    """
    values, slot = series.value_V[series.used], series.slot[series.used]
    if np.unique(values).size > _DISTINCT * values.size:
        return 0.0
    for period in _PATTERNS:
        steps = [find_lattice(values[slot % period == phase]) for phase in range(period)]
        if 0 < max(steps) < (1 + _UNEVEN) * min(steps):
            return float(np.median(steps))
    return 0.0


def coarser_beyond(values: Floats, q_V: float) -> float:
    """Return the step of the lattice beyond the largest power of ten among the magnitudes, where it is coarser there.

    A log of so many significant digits leaves out one more from there on. What comes next to the power of ten on its
    far side is a coarse step away, and no value is missing. Of readings on one side of it alone, or of one lattice, it
    is the step that they have, `q_V`.

    >>> coarser_beyond(np.array([9.99, 9.98, 9.97, 10.1, 10.2, 10.0] * 20), 0.01)
    0.1
    """
    sizes = np.abs(values)
    if not sizes.max(initial=0.0) > 0:
        return q_V
    far = sizes >= 10.0 ** floor(log10(sizes.max()))
    beyond = find_lattice(values[far])
    if far.all() or beyond <= q_V or abs(log10(beyond) - round(log10(beyond))) > 1e-3:
        return q_V
    before = find_lattice(values[~far])
    return beyond if before == 0 or _A_DIGIT[0] < beyond / before < _A_DIGIT[1] else q_V
