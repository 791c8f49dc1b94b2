"""What comes for a while and goes again, without a mechanism: a tone on a track in time and frequency, teeth of a saw.

Both may be anywhere in the record, so both look at millions of places, and both have exact laws for one of them: powers
of white noise in spans that do not overlap are independent and exponential, and a sum of residuals is normal. Residuals
are limited first, so that a few large ones, which have checks of their own, make neither.
"""

from math import sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.signal import fftconvolve
from scipy.special import gammaincc, gammainccinv
from scipy.stats import norm

from aemd.diagnose.checks.shapes import settled_response
from aemd.diagnose.evidence import Evidence, two_sided
from aemd.diagnose.fit import Fit

__all__ = ["check_teeth", "check_tracks"]

Floats = NDArray[np.float64]
Powers = NDArray[np.float32]

_LIMIT = 4.0
"""Deviations; of 9,000 normal residuals one is beyond in half the records."""
_FINER = 2
"""Frequencies for each that is independent, and spans that begin within each other: a tone between two is not lost."""
_SPANS = {16: ((4, 8), 1), 32: ((4, 8, 16), 2), 64: ((1, 2, 4, 8, 12), 3), 128: ((2, 4, 8), 4)}
"""By readings of a span: how many spans make a track, and the steepest tone within one, in units of its bandwidth."""
_TEETH = (4, 6)
_SHORTEST, _LONGEST = 8, 100
"""Readings of a tooth. Shorter ones are a line for a while, longer ones some steps."""
_ALIKE = 1.08
"""Ratio of teeth that are sought with one shape; they still come at their own distance."""
_LONG = 60_000
"""Readings that are looked at; of a longer record, the first so many."""


def check_tracks(fit: Fit) -> Evidence:
    """Add powers of consecutive spans along straight and along geometric courses of the frequency.

    A sum of k powers is gamma distributed with shape k if the model is right; p counts every sum that is tried. Within
    a span the tone may move as well: each is turned back by some rates before its powers are taken.
    """
    z = np.clip(_even(fit), -_LIMIT, _LIMIT)
    tries, trials = [(1.0, 0.0, 1, "")], 0.0
    for length, (counts, steepest) in _SPANS.items():
        for offset in range(0, length, length // _FINER):
            if (z.size - offset) // length < 2 * min(counts):
                continue
            powers = _powers(z[offset:], length, steepest)
            for count in counts:
                for geometric in (0, 1) if count > 2 else (0,):
                    if powers.shape[2] < 2 * count:
                        continue
                    most, at, first, last, tried = _best_track(powers, count, geometric, _FINER, steepest, _FINER)
                    trials += tried
                    begin_s = (offset + at * length) * fit.data.interval_s
                    hz = [(_FINER + place) / (_FINER * length * fit.data.interval_s) for place in (first, last)]
                    words = _say_tone(begin_s, begin_s + count * length * fit.data.interval_s, *hz)
                    tries.append((float(gammaincc(count, most)), float(most), count, words))
    p_value, most, count, words = min(tries)
    return Evidence(
        check="strongest tone for a while in the residuals: power over its mean",
        p_value=min(1.0, p_value * max(trials, 1.0)),
        observed=most / count,
        low=1.0,
        high=float(gammainccinv(count, 0.025 / max(trials, 1.0))) / count,
        looks=words,
    )


def check_teeth(fit: Fit) -> Evidence:
    """Add what a tooth leaves in the residuals over some evenly spaced ones, anywhere and at any distance.

    One tooth is a fall between two halves of an even rise, as the filter leaves it; the sum over some of them is normal
    with the variance that their overlap gives.
    """
    z = np.clip(_even(fit), -_LIMIT, _LIMIT)
    n = z.size
    longest = min(_LONGEST, n // (2 * max(_TEETH)))
    step = settled_response(fit, min(n, 3 * _LONGEST))
    ramp = np.cumsum(step)
    best, trials, about = (0.0, 0, 0, 0.0), 0.0, float(_SHORTEST)
    while about < longest:
        length = 2 * round(about * sqrt(_ALIKE) / 2)
        tooth = ramp[: 2 * length] / length
        tooth[length // 2 :] -= step[: tooth.size - length // 2]
        tooth[length:] -= ramp[: tooth.size - length] / length
        scores = fftconvolve(z, tooth[::-1])[tooth.size - 1 :][:n].astype(np.float32)
        shared = fftconvolve(tooth, tooth[::-1])[tooth.size - 1 :]
        for count in _TEETH:
            for apart in np.arange(about, min(about * _ALIKE, longest), 1.5 / count):
                places = np.floor(np.arange(count) * apart + 0.5).astype(np.int64)
                near = places[places < shared.size]
                overlaps = float((count - np.arange(near.size))[1:] @ shared[near[1:]])
                size = sqrt(max(count * float(shared[0]) + 2 * overlaps, 0.2 * count * float(shared[0])))
                sum_, at = _largest_sum(scores, places)
                trials += float(n - places[-1])
                best = max(best, (abs(sum_) / size, at + length // 2, count, float(apart)))
        about *= _ALIKE
    score, at, count, apart = best
    interval = fit.data.interval_s
    return Evidence(
        check="strongest teeth of a saw for a while in the residuals: score in deviations",
        p_value=min(1.0, two_sided(score) * max(trials, 1.0)),
        observed=score,
        low=0.0,
        high=float(norm.isf(0.0125 / max(trials, 1.0))),
        looks=f"some {count} teeth of a saw, {apart * interval:.3g} s each, from {at * interval:.4g} s on, most like "
        "a periodic glitch",
    )


def _even(fit: Fit) -> Floats:
    """Return the residuals on the grid, 0 where there is none."""
    data = fit.data
    even = np.zeros(int(data.slot[-1]) + 1)
    even[data.slot[data.used]] = fit.z[data.used]
    return even[:_LONG]


def _powers(z: Floats, length: int, steepest: int) -> Powers:
    """Return powers by the tone's rate, its frequency, and span, all exponential with mean 1 for white noise.

    At the edges of the band real and imaginary part differ, so those frequencies are left out.
    """
    spans = z[: z.size // length * length].reshape(-1, length)
    middle = np.arange(length) - (length - 1) / 2
    made = []
    for rate in range(-steepest, steepest + 1):
        turned = spans * np.exp(-1j * np.pi * rate / length**2 * middle**2)
        power = np.abs(np.fft.fft(turned, _FINER * length, axis=1)[:, _FINER : _FINER * (length // 2 - 1) + 1]) ** 2
        made.append((power.T / length).astype(np.float32))
    return np.ascontiguousarray(made)


def _say_tone(begin_s: float, end_s: float, first_hz: float, last_hz: float) -> str:
    spread = abs(first_hz - last_hz) / max(first_hz, last_hz)
    tone = f"at {first_hz:.3g} Hz" if spread < 0.1 else f"that runs from {first_hz:.3g} to {last_hz:.3g} Hz"
    like = "periodic interference" if spread < 0.1 else "a wandering line"
    return f"a tone {tone} between {begin_s:.4g} and {end_s:.4g} s, most like {like}, which goes on all the time"


@njit(cache=True)
def _best_track(
    powers: Powers, count: int, geometric: int, first: int, steepest: int, finer: int
) -> tuple[float, int, int, int, int]:
    """Return the largest sum of powers along a track, its first span, first and last frequency, and sums tried.

    Straight, or `geometric`: the frequency grows by the same factor from span to span.
    """
    places, spans = powers.shape[1], powers.shape[2] - count + 1
    best, at, begin, end, tried = 0.0, 0, 0, 0, 0
    where, rate = np.empty(count, np.int64), np.empty(count, np.int64)
    sums = np.empty(spans, np.float32)
    for a in range(places):
        for b in range(places):
            if (count == 1 and a != b) or (geometric and a == b):
                continue
            allowed = True
            for k in range(count):
                if geometric:
                    growth = np.log((b + first) / (a + first)) / (count - 1.0)
                    place = (a + first) * np.exp(growth * k) - first
                    slope = (place + first) * growth
                else:
                    slope = (b - a) / (count - 1.0) if count > 1 else 0.0
                    place = a + slope * k
                turn = int(np.floor(slope / finer + 0.5))
                if abs(turn) > steepest:
                    allowed = False
                    break
                where[k], rate[k] = int(np.floor(place + 0.5)), turn + steepest
            if not allowed:
                continue
            tried += spans
            row = powers[rate[0], where[0]]
            for t in range(spans):
                sums[t] = row[t]
            for k in range(1, count):
                row = powers[rate[k], where[k]]
                for t in range(spans):
                    sums[t] += row[t + k]
            most = sums[0]
            for t in range(spans):
                most = max(most, sums[t])
            if most > best:
                best, at, begin, end = most, int(np.argmax(sums)), a, b
    return best, at, begin, end, tried


@njit(cache=True)
def _largest_sum(scores: Powers, places: NDArray[np.int64]) -> tuple[float, int]:
    """Return the sum over these places, moved along the record, that is largest in size, and where."""
    count = scores.size - places[-1]
    sums = np.zeros(count, np.float32)
    for place in places:
        for t in range(count):
            sums[t] += scores[t + place]
    low, high = sums[0], sums[0]
    for t in range(count):
        high, low = max(high, sums[t]), min(low, sums[t])
    if high >= -low:
        return high, int(np.argmax(sums))
    return low, int(np.argmin(sums))
