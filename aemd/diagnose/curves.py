"""What a picture shows of readings: each a pair of axes made alike from the data and from a simulated record."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

__all__ = ["Curve", "after_jumps", "folded", "level_changes", "levels", "running_deviation", "unwound"]

Floats = NDArray[np.float64]
Curve = Callable[[Floats, float], tuple[Floats, Floats]]
"""From readings, V, and their interval, s, to the two axes of a figure."""

_NEAR = 60  # frequencies of the record to either side of a line
_JUMPS = 40
_WINDOWS = 60


def unwound(frequency_hz: float, chirp_hz_per_s: float) -> Curve:
    """Return the spectrum after a sweep is taken off: a sweeping line stands still in it, at its first frequency."""

    def curve(y: Floats, step_s: float) -> tuple[Floats, Floats]:
        t_s = np.arange(y.size) * step_s
        taper = np.sin(np.pi * (np.arange(y.size) + 0.5) / y.size) ** 2
        still = (y - y.mean()) * taper * np.exp(-1j * np.pi * chirp_hz_per_s * t_s**2)
        power = np.abs(np.fft.fft(still)) ** 2 * 2 * step_s / np.sum(taper**2)
        f = np.fft.fftfreq(y.size, step_s)
        at = int(np.argmin(np.abs(f - frequency_hz)))
        near = np.arange(at - _NEAR, at + _NEAR) % y.size
        order = near[np.argsort(f[near])]
        return np.asarray(f[order], np.float64), np.asarray(power[order], np.float64)

    return curve


def folded(period_s: float) -> Curve:
    """Return the mean change from reading to reading over the phase of a period; drift averages out of changes."""

    def curve(y: Floats, step_s: float) -> tuple[Floats, Floats]:
        bins = int(np.clip(period_s / step_s, 4, 200))
        phase = (np.arange(1, y.size) * step_s % period_s) / period_s
        at = np.minimum((phase * bins).astype(int), bins - 1)
        counts = np.maximum(np.bincount(at, minlength=bins), 1)
        means = np.bincount(at, np.diff(y), bins) / counts
        return (np.arange(bins) + 0.5) / bins * period_s, np.cumsum(means - means.mean())

    return curve


def after_jumps(y: Floats, step_s: float) -> tuple[Floats, Floats]:
    """Return what follows the largest changes, in sizes of the change, averaged over them."""
    change = np.diff(y)
    length = min(int(4.0 / step_s), y.size // 4)
    at = np.argsort(np.abs(change[: y.size - length - 2]))[::-1][:_JUMPS]
    size = change[at]
    after = np.array([y[k + 1 : k + 1 + length] - y[k] for k in at])
    return np.asarray(np.arange(length) * step_s, np.float64), np.asarray(
        size @ after / max(float(size @ size), 1e-300), np.float64
    )


def running_deviation(y: Floats, step_s: float) -> tuple[Floats, Floats]:
    """Return the deviation of changes from reading to reading, window by window, V."""
    parts = np.array_split(np.diff(y), min(_WINDOWS, max(y.size // 20, 1)))
    middle_s = np.cumsum([part.size for part in parts]) * step_s - parts[0].size * step_s / 2
    return np.asarray(middle_s), np.array([part.std() for part in parts]) / np.sqrt(2)


def level_changes(at_s: float, width_s: float) -> Curve:
    """Return by how much the mean over a width after each instant is above that before it, near an instant, V.

    A step of the level is a triangle of its height in it, with its top at the instant; drift is next to nothing.
    """

    def curve(y: Floats, step_s: float) -> tuple[Floats, Floats]:
        count = int(np.clip(width_s / step_s, 2, y.size // 4))
        total = np.concatenate(([0.0], np.cumsum(y - y.mean())))
        change = (total[2 * count :] - 2 * total[count:-count] + total[: -2 * count]) / count
        t_s = (np.arange(change.size) + count) * step_s
        near = np.abs(t_s - at_s) < 8 * count * step_s
        if not near.any():  # the instant is at an end of the record
            near = np.abs(t_s - np.clip(at_s, t_s[0], t_s[-1])) < 8 * count * step_s
        return t_s[near], np.asarray(change[near], np.float64)

    return curve


def levels(centre_V: float, width_V: float) -> Curve:
    """Return how many readings lie at each level about one."""

    def curve(y: Floats, step_s: float) -> tuple[Floats, Floats]:  # noqa: ARG001 - one of several figures
        edges = np.linspace(centre_V - width_V, centre_V + width_V, 61)
        counts, _ = np.histogram(y, edges)
        return (edges[1:] + edges[:-1]) / 2, counts.astype(np.float64)

    return curve
