"""Where the residuals are off that a model leaves: in time, in frequency, in both at once, or in their size.

Residuals of a model that is right are standard normal and independent. So the mean square of W of them is chi-square of
W degrees over W, the energy of k of their Fourier frequencies is chi-square of 2 k degrees over 2 k, and the number of
them that lie between two sizes is binomial. Each cell of a picture is judged by its own law, and what is said of one
counts how many were looked at.
"""

from dataclasses import dataclass
from math import floor, log10

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.stats import binom, chi2, norm

__all__ = ["Cells", "LeftOver", "left_over"]

Floats = NDArray[np.float64]

_TIMES = 48
_BANDS = 16
_FINE_BANDS = 48
_LEAST_READINGS = 34
"""Of a stretch of time: its Fourier frequencies fill the bands."""
_SIZES = np.array([-5.0, -4.0, -3.5, *np.arange(-3.0, 3.01, 0.5), 3.5, 4.0, 5.0])
_SIDE = 0.025
"""Of a band that holds 95 %, on either side."""
_TOLD = 1e-3
"""Probability of chance, over all cells of a picture, from which its cell is spoken of."""


@dataclass(frozen=True, slots=True)
class Cells:
    """Energies or counts over what they should be, cell by cell, with the ends between which each is in 95 %."""

    edges: Floats
    """Of the cells, in s, Hz or standard deviations; one more than there are cells."""
    ratio: Floats
    low: Floats
    high: Floats
    p_value: Floats
    """Of each cell alone, both sides."""


@dataclass(frozen=True, slots=True)
class LeftOver:
    """What the residuals hold."""

    over_time: Cells
    over_frequency: Cells
    over_size: Cells
    energy: Floats
    """Over what it should be, shape (bands, times): in the bands of `band_edges_hz` and the times of `over_time`."""
    p_value: Floats
    """Of each of these, shape (bands, times)."""
    band_edges_hz: Floats
    sentence: str
    """What stands out most."""


def left_over(z: Floats, slot: NDArray[np.int64], used: NDArray[np.bool_], interval_s: float) -> LeftOver:
    """Return where residuals are off.

    Args:
        z: standard normal if the model is right, shape (n,).
        slot: place of each on the grid of whole intervals, shape (n,).
        used: which of them there are, shape (n,).
        interval_s: of the grid.
    """
    n = int(slot[-1]) + 1
    there, even = np.zeros(n), np.zeros(n)
    there[slot[used]], even[slot[used]] = 1.0, z[used]
    length = max(n // _TIMES, _LEAST_READINGS)
    count = max(n // length, 1)
    rows = even[: count * length].reshape(count, length)
    present = there[: count * length].reshape(count, length).sum(axis=1)
    times = _cells(np.arange(count + 1, dtype=np.float64) * length * interval_s, (rows**2).sum(axis=1), present)
    power = np.abs(np.fft.rfft(rows, axis=1)[:, 1 : (length + 1) // 2]) ** 2 / np.maximum(present, 1.0)[:, None]
    edges = np.unique(np.linspace(0, power.shape[1], _BANDS + 1).astype(int))
    bins = np.diff(edges)
    energy = np.add.reduceat(power, edges[:-1], axis=1).T / bins[:, None]
    p_value = np.where(present > length / 2, _both_sides(energy, 2 * bins[:, None]), 1.0)
    whole = np.abs(np.fft.rfft(even)[1 : (n + 1) // 2]) ** 2 / max(there.sum(), 1.0)
    fine = np.unique(np.linspace(0, whole.size, _FINE_BANDS + 1).astype(int))
    frequencies = _cells((fine + 0.5) / (n * interval_s), 2 * np.add.reduceat(whole, fine[:-1]), 2.0 * np.diff(fine))
    sizes = _sizes(z[used])
    band_edges_hz = (edges + 0.5) / (length * interval_s)
    sentence = _say(times, frequencies, sizes, energy, p_value, band_edges_hz)
    return LeftOver(times, frequencies, sizes, energy, p_value, band_edges_hz, sentence)


def _both_sides(ratio: Floats, degrees: Floats) -> Floats:
    below = chi2.cdf(ratio * degrees, degrees)
    above = chi2.sf(ratio * degrees, degrees)
    return np.asarray(np.minimum(2 * np.minimum(below, above), 1.0))


def _cells(edges: Floats, squares: Floats, degrees: Floats) -> Cells:
    known = np.maximum(degrees, 1.0)
    low, high = (chi2.ppf(side, known) / known for side in (_SIDE, 1 - _SIDE))
    ratio = np.where(degrees > 0, squares / known, 1.0)
    return Cells(edges, ratio, low, high, np.where(degrees > 0, _both_sides(ratio, known), 1.0))


def _sizes(z: Floats) -> Cells:
    counts = np.histogram(np.clip(z, _SIZES[0], _SIZES[-1]), _SIZES)[0]
    share = np.diff(norm.cdf(np.concatenate(([-np.inf], _SIZES[1:-1], [np.inf]))))
    expected = z.size * share
    low, high = (binom.ppf(side, z.size, share) / expected for side in (_SIDE, 1 - _SIDE))
    beyond = np.minimum(binom.cdf(counts, z.size, share), binom.sf(counts - 1, z.size, share))
    return Cells(_SIZES, counts / expected, low, high, np.minimum(2 * beyond, 1.0))


def _say(times: Cells, frequencies: Cells, sizes: Cells, energy: Floats, p_value: Floats, band_edges_hz: Floats) -> str:
    """Return what stands out most, over all cells that were looked at."""
    found = list[tuple[float, str]]()
    chance = 4 * float(p_value.min()) * p_value.size  # four pictures are looked at
    if chance < _TOLD:
        patches, _ = label(p_value < _TOLD / p_value.size * 10, np.ones((3, 3)))
        patch = patches == patches[np.unravel_index(np.argmin(p_value), p_value.shape)]
        rows, columns = np.flatnonzero(patch.any(axis=1)), np.flatnonzero(patch.any(axis=0))
        where = (
            f"Between {_instant(times, columns[0])} s and {_instant(times, columns[-1] + 1)} s, at "
            f"{band_edges_hz[rows[0]]:.3g} to {band_edges_hz[rows[-1] + 1]:.3g} Hz,"
        )
        return (
            f"{where} the residuals hold {_many(energy[patch].mean())} times the energy that they should{_by(chance)}."
        )
    for cells, what, unit in ((times, "Between", "s"), (frequencies, "At", "Hz")):
        at = int(np.argmin(cells.p_value))
        chance = float(cells.p_value[at]) * cells.p_value.size
        low, high = f"{cells.edges[at]:.4g}", f"{cells.edges[at + 1]:.4g} {unit}"
        where = f"Between {low} s and {high}" if what == "Between" else f"At {low} to {high}, over the whole record,"
        found.append((chance, f"{where} the residuals hold {_many(cells.ratio[at])} times the energy that they should"))
    at = int(np.argmin(sizes.p_value))
    low, high = (f"{edge:.2g}" for edge in sizes.edges[at : at + 2])
    where = f"beyond {high if at == 0 else low}" if at in (0, sizes.ratio.size - 1) else f"between {low} and {high}"
    found.append(
        (
            float(sizes.p_value[at]) * sizes.p_value.size,
            f"Residuals {where} of their standard deviations come {_many(sizes.ratio[at])} times as often as they "
            "should",
        )
    )
    chance, text = min(found)
    if 4 * chance >= _TOLD:
        return (
            "As coarsely as is shown here, the residuals are spread over time, frequency and size as they should be; "
            "what was found is narrower than these cells."
        )
    return f"{text}{_by(4 * chance)}."


def _instant(times: Cells, edge: int) -> str:
    """Return when a cell begins, s, as finely as the cells are long."""
    length_s = float(times.edges[1] - times.edges[0])
    return f"{times.edges[edge]:.{0 if length_s >= 1 else 1 - floor(log10(length_s))}f}"


def _by(chance: float) -> str:
    """Return how often chance does that.

    >>> _by(2.1e-7), _by(0.0)
    (' (by chance, anywhere in the pictures: 2e-07)', ' (by chance, anywhere in the pictures: less than 1e-300)')
    """
    return f" (by chance, anywhere in the pictures: {f'{chance:.0e}' if chance > 1e-300 else 'less than 1e-300'})"


def _many(ratio: float) -> str:
    """Return a ratio with two digits, and never as a power.

    >>> _many(0.123), _many(3.21), _many(1234.5)
    ('0.12', '3.2', '1234')
    """
    return f"{ratio:.2g}" if ratio < 100 else f"{ratio:.0f}"
