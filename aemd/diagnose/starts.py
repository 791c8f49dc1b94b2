"""Where a fit of the base begins: by its spectrum, by its usual change, with its jumps cut off."""

from dataclasses import replace
from itertools import combinations
from math import log, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from aemd.diagnose.hypothesis import Data

__all__ = ["spectral_starts", "usual_starts", "with_drift", "without_jumps"]

Floats = NDArray[np.float64]

_LARGE = 4.0  # usual changes that a change must be to be a jump


def spectral_starts(data: Data, *, rising: bool = False) -> list[Floats]:
    """Return starts for the base, best first: pairs of time constants, their levels by weighted least squares.

    Whittle's approximation on averaged bins of the periodogram; it judges nothing, it only says where to begin.

    Args:
        data: the readings.
        rising: beside a difference noise, the logarithm of whose deviation comes last in each start.
    """
    slots = data.slot[data.used]
    even = np.interp(np.arange(slots[-1] + 1), slots, data.y[data.used])
    step = data.interval_s
    n = even.size
    line = np.linspace(even[: max(n // 20, 1)].mean(), even[-max(n // 20, 1) :].mean(), n)  # what leaks the most
    taper = np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2
    power = np.abs(np.fft.rfft((even - line) * taper))[1:] ** 2 / np.sum(taper**2) * step  # two-sided, units^2 s
    f = np.fft.rfftfreq(n, step)[1:]
    edges = np.unique(np.geomspace(1, f.size + 1, 61).astype(int)) - 1
    counts = np.diff(edges)
    # The logarithm's mean and not the power's, so that a line does not pull its bin up; Euler's constant makes it even.
    bins = np.exp(np.add.reduceat(np.log(np.maximum(power, 1e-300)), edges[:-1]) / counts + np.euler_gamma)
    centre = np.add.reduceat(f, edges[:-1]) / counts
    counts = counts * 0.5  # the taper correlates neighbours
    taus = np.geomspace(step, 3 * data.span_s, 12)
    shapes = [_markov_spectrum(centre, tau, step) for tau in taus]
    others = [np.full(centre.size, step)]
    if rising:
        others.append(step * 4 * np.sin(np.pi * centre * step) ** 2)
    found: list[tuple[float, Floats]] = []
    typical = max(data.span_s, step)
    for fast, slow in combinations(range(taus.size), 2):
        design = np.column_stack((shapes[fast], shapes[slow], *others))
        model = bins.copy()
        levels = np.ones(design.shape[1])
        for _ in range(4):
            weight = np.sqrt(counts) / np.maximum(model, 1e-12 * bins.max())
            levels, _ = nnls(design * weight[:, None], bins * weight)
            model = np.maximum(design @ levels, 1e-9 * bins.max())
        cost = float(np.sum(counts * (np.log(model) + bins / model)))
        rate_s, rate_d = (sqrt(max(level, 1e-8 / typical)) for level in levels[:2])
        noise = [0.5 * log(max(level, 1e-3)) for level in levels[2:]]
        start = [log(taus[fast]), log(rate_s), log(taus[slow]), log(rate_d), noise[0], 0.0, *noise[1:]]
        found.append((cost, np.array(start)))
    found.sort(key=lambda item: item[0])
    kept: list[Floats] = []
    for _, theta in found:  # starts that differ
        if all(np.abs(theta[[0, 2]] - other[[0, 2]]).max() > 1.5 for other in kept):
            kept.append(theta)
    return kept


def usual_starts(data: Data) -> list[Floats]:
    """Return starts for the base that share the usual change between readings out among signal and noise."""
    usual = _usual_change(np.diff(data.y))
    step = data.interval_s
    return [
        np.array(
            [
                log(tau_steps * step),
                log(share * usual / sqrt(step)),
                log(min(1000 * step, data.span_s)),
                log(0.1 * usual / sqrt(step)),
                log(sqrt(1 - share**2) * usual / sqrt(2)),
                0.0,
            ]
        )
        for tau_steps in (3.0, 15.0, 75.0)
        for share in (0.3, 0.7, 0.95)
    ]


def without_jumps(data: Data) -> tuple[Data, float, float]:
    """Return the readings with their large changes cut off, how many jumps there were per second, and their size.

    Where shocks dwarf everything, what is fitted without them describes nothing. A jump and the steep part of its decay
    are large changes both; cut to what is usual, their sum leaves a record of the rest, good enough to begin with.
    """
    change = np.diff(data.y)
    usual = _usual_change(change[data.used[1:] & data.used[:-1]])
    large = np.abs(change) > _LARGE * usual
    calm = np.concatenate(([0.0], np.cumsum(np.clip(change, -_LARGE * usual, _LARGE * usual))))
    first = large & ~np.concatenate(([False], large[:-1]))
    if not first.any():
        return data, 0.0, 0.0
    size = float(np.sqrt(np.mean(change[first] ** 2)))
    return replace(data, y=calm), int(np.count_nonzero(first)) / data.span_s, size


def with_drift(theta: Floats, data: Data) -> Floats:
    """Return a start with a slow drift beside the signal: the larger of the two processes becomes the signal."""
    start = theta.copy()
    if theta[3] + theta[2] / 2 > theta[1] + theta[0] / 2:
        start[:2] = theta[2:4]
    start[2] = log(data.span_s / 5)
    start[3] = start[1] + log(0.1)
    return start


def _usual_change(change: Floats) -> float:
    """Return what deviation most changes tell of; on a coarse lattice most are 0, and then their rms."""
    return 1.4826 * float(np.median(np.abs(change))) or float(np.sqrt(np.mean(change**2)))


def _markov_spectrum(f: Floats, tau_s: float, step_s: float) -> Floats:
    """Return the two-sided spectrum of a sampled first-order process of unit rate, s (units^2 s for rate 1)."""
    phi = np.exp(-step_s / tau_s)
    sd2 = tau_s / 2
    return np.asarray(sd2 * step_s * (1 - phi**2) / (1 - 2 * phi * np.cos(2 * np.pi * f * step_s) + phi**2))
