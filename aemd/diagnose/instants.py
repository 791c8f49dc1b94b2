"""What rings after shocks whose instants nobody knows: its size, pitch and decay, the instants integrated out.

A shock comes at any time between two readings. So the reading after it shows what is left of it, and its ring has
turned by then: by up to half a turn, and by other angles after other shocks. A wave of one angle laid after all of them
is told too small, or too large by what is left of the shocks, at a wrong pitch, and its decay by what the angles
happened to do; and the curvature of its likelihood knows nothing of it. Here each shock has an instant and a size of
its own, drawn by Gibbs' sampler (Geman and Geman 1984) together with the ring's numbers:

    what a shock of amplitude A at t0 adds:  A r exp(-(t - t0)/d) sin(2 pi f (t - t0)),  t > t0.

Whitened by the fit's own filter, this is linear in two amplitudes for each shock, given f and d; so readings are gone
through once for each pair of these, and a draw costs products of small matrices.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import exp, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, logsumexp, ndtr, ndtri

from aemd.diagnose.climb import assemble
from aemd.diagnose.fit import Fit
from aemd.diagnose.hypothesis import Base
from aemd.diagnose.kernels import whiten
from aemd.diagnose.terms.events import RingDown, rung

__all__ = ["one_ring", "rings"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_MOST_SHOCKS = 20
"""The loudest: of a ring they tell nearly all, as their squares."""
_LEAST_ODDS = 0.15
"""Probability of a shock at a reading from which it is followed."""
_INSTANTS = 40
"""Of each interval, one of them that there was no shock."""
_CHAINS, _SETTLING, _SWEEPS = 48, 15, 50
_PAIRS = 64
"""Of decay and pitch that a sweep chooses from, beside what a chain has."""
_DECAYS, _PITCHES = 7, 11
"""Steps to each side of the fit's, in so many of its deviations: one angle for all shocks makes the pitch look better
known than it is."""
_STRIDES = np.array([0.55, 0.6])
"""Deviations of decay and pitch."""
_GRIDS, _CENTRED = 12, 0.4
"""Grids at most, one about the middle of what the last one told, as long as that is so far from its own, in parts of
its reach. A strong ring is fitted far too short by a wave of one angle, and the fit's deviations know nothing of it."""
_WIDER, _FINER = 2.0, 0.25
"""Times the last stride: where a grid ended at its edge, and at least where what it tells is in few of its cells."""
_WIDEST = 0.5
"""Stride of a decay's logarithm; of a ring that does not decay within a record all that are long are as likely."""
_FEW = 0.8
"""Strides of deviation from which it is not; a cell's own width then adds 6 % to it."""
_MOST_DOUBT = 0.7
"""Of the logarithm of the shocks' own decay; where that is shorter than an interval, nothing is known of it."""
_LOUDEST = 2.0
"""Times the shock, of a ring; see the term's bounds."""
_RING = 0.6
"""The same, at most, in what a reading shows of the shock itself."""
_SHORTEST = 0.25
"""Decay, in intervals: of a shorter one no reading shows anything."""
_FADED = 9.0
"""Decays after which a ring is left out."""


@dataclass(frozen=True, slots=True)
class _Struck:
    """The shocks that are followed; shapes (s,)."""

    at: Ints
    """First reading after each."""
    probability: Floats
    paired: NDArray[np.bool_]
    """Whether the reading after it shows the rest: it came within an aperture."""
    size: Floats
    """Mean of what the reading shows of it, and its deviation."""
    size_sd: Floats
    next_size: Floats
    """What the next reading shows beside what was expected then, and its variance."""
    next_var: Floats
    jump_sd: float
    """Deviation of all shocks, as readings show them."""
    decay_s: float
    variance: Floats
    """Of each reading of the record once a shock is allowed for, shape (n,)."""


@dataclass(frozen=True, slots=True)
class _Candidates:
    """Instants and amplitudes that each shock may have had; shapes (chains, s, instants)."""

    before_s: Floats
    """From the instant to the middle of the reading."""
    amplitude: Floats
    log_odds: Floats


@dataclass(frozen=True, slots=True)
class _Grid:
    """Pairs of pitch and decay, and what readings say of both quadratures of each shock's wave."""

    frequency_hz: Floats
    decay_s: Floats
    passed: Floats
    """What an aperture lets through."""
    seen: Floats
    """Products of the whitened waves with the residuals, shape (pairs, 2 s)."""
    energy: Floats
    """Products of the waves with each other, shape (pairs, 2 s, 2 s)."""


def rings(fit: Fit, number: int, spread: Floats) -> Mapping[str, Floats] | None:
    """Return draws of what is reported of a ring-down, given the readings, each of shape (m,).

    The ratio is that of the amplitudes of ring and shock at its instant. None of another term, where no shock is
    followed, and where no grid was about what it told.

    Args:
        fit: at its top.
        number: of the term.
        spread: covariance of all free numbers.
    """
    term, theta = fit.terms[number], fit.parts_of(number)
    struck = _struck(fit, fit.innovation) if isinstance(term, RingDown) else None
    if not isinstance(term, RingDown) or struck is None:
        return None
    rng = np.random.default_rng(0)
    begin = sum(one.start.size for one in fit.terms[:number])
    sds = np.sqrt(np.maximum(np.diag(spread)[begin : begin + 2], 0.0))
    strides = _STRIDES * (float(np.clip(sds[0], 0.1, 0.5)), max(float(sds[1]) / term.decay_s, 1e-4))
    now_hz, now_s = _pitch_of(term, theta)
    parts = [(one, fit.parts_of(at)) for at, one in enumerate(fit.terms) if isinstance(one, RingDown)]
    waves = [(one, part) for one, part in parts if one_ring((now_hz, now_s), _pitch_of(one, part))]
    base, bare = fit.terms[0], _bare(fit, waves)
    doubt = sqrt(max(float(spread[8, 8]), 0.0)) if isinstance(base, Base) and base.shocks else 0.0
    ratio = float(sum(np.hypot(part[2], part[3]) for _, part in waves))
    told = None
    for _ in range(_GRIDS):
        grid = _grid(fit, struck, bare, (now_hz, now_s), strides)
        tried = _candidates(fit, struck, min(doubt, _MOST_DOUBT), (now_hz, now_s, min(ratio, _RING)), rng)
        ratios, at, each = _drawn(grid, tried, min(ratio, _LOUDEST), rng)
        before, ratio = np.array([log(now_s), now_hz]), float(np.median(ratios))
        drawn = np.array([np.log(grid.decay_s[at]), grid.frequency_hz[at]])
        middle, spread_here = np.median(drawn, axis=1), drawn.std(axis=1) / strides
        now_s, now_hz = exp(middle[0]), float(middle[1])
        # The first turns of a loud ring may pass for shocks of their own, as long as one angle stands for all.
        struck = _struck(fit, bare - _whitened(fit, _rung(fit, struck, each, now_hz, now_s))) or struck
        centred = np.abs(middle - before) < _CENTRED * np.array([_DECAYS, _PITCHES]) * strides
        if centred.all():
            drawn += (rng.random(drawn.shape) - 0.5) * strides[:, None]
            told = {"frequency_hz": np.abs(drawn[1]), "decay_s": np.exp(drawn[0]), "ratio": ratios}
            if (spread_here > _FEW).all():
                break
        finer = np.where(spread_here > _FEW, 1.0, np.maximum(_STRIDES * spread_here, _FINER))
        strides = np.minimum(strides * np.where(centred, finer, _WIDER), (_WIDEST, np.inf))
    return told


def one_ring(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Return whether two pitches, Hz, with decays, s, share a band: a loud ring of many angles is fitted as two."""
    return abs(one[0] - other[0]) < (1 / one[1] + 1 / other[1]) / (2 * pi)


def _struck(fit: Fit, innovation: Floats) -> _Struck | None:
    """Return the shocks that are followed, by what readings show beside the ring; None where there is none."""
    _, parts, arguments = assemble(fit.terms, fit.theta, fit.data)
    rate_per_s, jump_var, at_state = parts.shocks[:3]
    if at_state < 0 or parts.telegraph is not None:
        return None
    data, calm = fit.data, fit.variance
    jump = -np.expm1(-rate_per_s * data.step_s)
    odds = np.log(jump) - np.log1p(-jump) + 0.5 * np.log(calm / (calm + jump_var))
    odds += 0.5 * innovation**2 * (1 / calm - 1 / (calm + jump_var))
    probability = np.where(data.used, 1 / (1 + np.exp(-np.clip(odds, -700, 700))), 0.0)
    size = jump_var / (calm + jump_var) * innovation
    likely = probability > _LEAST_ODDS
    paired = np.zeros(likely.size, np.bool_)
    for k in np.flatnonzero(likely[:-1] & likely[1:] & (size[:-1] * size[1:] > 0)):
        paired[k] = not (k and paired[k - 1])
    rest = np.concatenate(([False], paired[:-1]))
    at = np.flatnonzero(likely & ~rest)
    at = np.sort(at[np.argsort(-np.abs(probability * size)[at], kind="stable")][:_MOST_SHOCKS])
    if not at.size:
        return None
    after = np.minimum(at + 1, likely.size - 1)
    return _Struck(
        at=at,
        probability=probability[at],
        paired=paired[at],
        size=size[at],
        size_sd=np.sqrt(calm[at] * jump_var / (calm[at] + jump_var)),
        next_size=np.where(data.used[after], innovation[after], 0.0),
        next_var=np.where(data.used[after], calm[after], np.inf),
        jump_sd=sqrt(jump_var),
        decay_s=float(arguments[3][int(at_state), 1]),
        variance=np.where(likely, calm + probability * jump_var, calm),
    )


def _bare(fit: Fit, waves: Sequence[tuple[RingDown, Floats]]) -> Floats:
    """Return the innovations without these waves of one angle each, shape (n,)."""
    told = np.zeros(fit.data.y.size)
    for term, theta in waves:
        wave = rung(term.marks[: told.size], fit.data.step_s, *_pitch_of(term, theta))
        told += theta[2] * wave.real + theta[3] * wave.imag
    return fit.innovation + _whitened(fit, told)


def _pitch_of(term: RingDown, theta: Floats) -> tuple[float, float]:
    """Return pitch and decay of the wave of one angle."""
    return term.frequency_hz + float(theta[1]) / term.decay_s, exp(theta[0])


def _rung(fit: Fit, struck: _Struck, waves: Floats, frequency_hz: float, decay_s: float) -> Floats:
    """Return what rings from the reading after each shock on, shape (n,), by its quadratures, shape (s, 2)."""
    total, t_s = np.zeros(fit.data.y.size), fit.data.t_s
    for first, (one, other) in zip(struck.at, waves, strict=True):
        wave = np.exp(complex(-1 / decay_s, 2 * pi * frequency_hz) * (t_s[first + 1 :] - t_s[first]))
        total[first + 1 :] += one * wave.real + other * wave.imag
    return total


def _whitened(fit: Fit, told: Floats) -> Floats:
    return whiten(np.ascontiguousarray(told), fit.data.step_s, fit.states, fit.gains, fit.data.used)


def _grid(fit: Fit, struck: _Struck, bare: Floats, now: tuple[float, float], strides: Floats) -> _Grid:
    """Return pairs of pitch and decay about the fit's, `now`, and what readings say of each shock's wave."""
    data, count = fit.data, struck.at.size
    decays = now[1] * np.exp(np.arange(-_DECAYS, _DECAYS + 1) * strides[0])
    decays = decays[decays >= min(_SHORTEST * data.interval_s, now[1])]
    pitches = now[0] + np.arange(-_PITCHES, _PITCHES + 1) * strides[1]
    pitches = pitches[(pitches > 0) & (pitches < 0.5 / data.interval_s)]
    size = decays.size * pitches.size
    seen, energy = np.empty((size, 2 * count)), np.empty((size, 2 * count, 2 * count))
    root = np.sqrt(struck.variance)
    for of, decay_s in enumerate(decays):
        ends = np.searchsorted(data.t_s, data.t_s[struck.at] + _FADED * decay_s)
        heard = np.zeros(data.y.size, np.bool_)
        for first, end in zip(struck.at, ends, strict=True):
            heard[first:end] = True
        heard &= data.used
        place, rows, left_over = np.cumsum(heard) - 1, int(heard.sum()), (bare / root)[heard]
        for at, pitch_hz in enumerate(pitches):
            waves = np.zeros((rows, 2 * count))
            for column, (first, end) in enumerate(zip(struck.at, ends, strict=True)):
                part = slice(first, end)
                wave = np.exp(complex(-1 / decay_s, 2 * pi * pitch_hz) * (data.t_s[part] - data.t_s[first]))
                kept = heard[part]
                filled = place[part][kept]
                for quadrature, shape in enumerate((wave.real, wave.imag)):
                    left = whiten(
                        np.ascontiguousarray(shape), data.step_s[part], fit.states, fit.gains[part], data.used[part]
                    )
                    waves[filled, 2 * column + quadrature] = (left / root[part])[kept]
            seen[of * pitches.size + at] = waves.T @ left_over
            energy[of * pitches.size + at] = waves.T @ waves
    frequency_hz = np.tile(pitches, decays.size)
    passed = np.sinc(frequency_hz * data.aperture_s)
    return _Grid(frequency_hz, np.repeat(decays, pitches.size), passed, seen, energy)


def _candidates(
    fit: Fit, struck: _Struck, doubt: float, now: tuple[float, float, float], rng: np.random.Generator
) -> _Candidates:
    """Return instants and amplitudes that each shock may have had, and their odds by what was there before the ring.

    Each chain has a decay of the shocks of its own. A reading shows of a shock what of it is in the aperture, and of
    the ring what is there already: to that the ring's numbers `now` will do. Where the shock came within the aperture,
    the next reading shows more than is expected after the first.
    """
    data, count = fit.data, struck.at.size
    aperture_s, shape = max(data.aperture_s, 1e-6), (_CHAINS, count, _INSTANTS)
    decay_s = (struck.decay_s * np.exp(doubt * rng.standard_normal(_CHAINS)))[:, None, None]
    span_s = np.where(struck.paired, aperture_s, data.step_s[struck.at])[None, :, None]
    until_s = (np.arange(_INSTANTS) + rng.random(shape)) / _INSTANTS * span_s  # the aperture's end
    shown = _shown(until_s, aperture_s, decay_s)
    step_s = data.step_s[np.minimum(struck.at + 1, data.y.size - 1)][None, :, None]
    within = until_s < aperture_s
    more = np.where(within, _shown(until_s + step_s, aperture_s, decay_s) - np.exp(-step_s / decay_s) * shown, 0.0)
    # What both readings say of the size that the first one shows.
    size, var = struck.size[None, :, None], struck.size_sd[None, :, None] ** 2
    next_size, next_var = struck.next_size[None, :, None], struck.next_var[None, :, None]
    sharp = 1 / var + (more / shown) ** 2 / next_var
    mean = (size / var + more / shown * next_size / next_var) / sharp
    sizes = mean + rng.standard_normal(shape) / np.sqrt(sharp)
    frequency_hz, ring_s, ratio = now
    before_s = until_s - aperture_s / 2
    begun = ratio * np.imag(np.exp(complex(-1 / ring_s, 2 * pi * frequency_hz) * before_s)) * (before_s > 0)
    amplitude = sizes / np.maximum(shown + begun, 0.4 * shown)
    deviation = struck.jump_sd / np.sqrt(np.mean(shown**2, axis=(1, 2), keepdims=True))
    odds = -0.5 * (amplitude / deviation) ** 2 + 0.5 * (sizes / struck.jump_sd) ** 2 - np.log(shown)
    odds += 0.5 * mean**2 * sharp - 0.5 * size**2 / var - 0.5 * np.log(sharp * var)
    odds += np.log(np.maximum(struck.probability, 1e-300))[None, :, None] - logsumexp(odds, axis=2, keepdims=True)
    amplitude[:, :, 0] = 0.0  # no shock at all
    odds[:, :, 0] = np.log(np.maximum(1 - struck.probability, 1e-12))[None, :]
    return _Candidates(before_s, amplitude, odds)


def _shown(until_s: Floats, aperture_s: float, decay_s: Floats) -> Floats:
    """Return the mean over an aperture of a shock of amplitude 1, that long before the aperture's end."""
    early = np.maximum(until_s - aperture_s, 0.0)
    faded = np.exp(-early / decay_s) - np.exp(-until_s / decay_s)
    return np.asarray(np.maximum(decay_s / aperture_s * faded, 1e-6))


def _drawn(grid: _Grid, tried: _Candidates, ratio: float, rng: np.random.Generator) -> tuple[Floats, Ints, Floats]:
    """Return draws of the ratio and of the pair of pitch and decay, and the mean of each shock's wave, shape (s, 2)."""
    chains, count, instants = tried.amplitude.shape
    each, pairs = np.arange(chains), grid.decay_s.size
    turn = -1 / grid.decay_s + 2j * pi * grid.frequency_hz
    at: Ints = rng.integers(0, pairs, size=(chains,))
    chosen: Ints = rng.integers(0, instants, size=(chains, count))
    ratios, told = np.full(chains, ratio), list[tuple[Floats, Ints, Floats]]()
    for sweep in range(_SETTLING + _SWEEPS):
        waves = tried.amplitude * np.exp(turn[at][:, None, None] * tried.before_s) * grid.passed[at][:, None, None]
        wave = np.stack((waves.imag, waves.real), -1)  # of e^(turn t) the imaginary part, by its quadratures
        now = np.take_along_axis(wave, chosen[:, :, None, None], 2)[:, :, 0, :]
        energy, seen = grid.energy[at], grid.seen[at]
        for one in rng.permutation(count):
            own = slice(2 * one, 2 * one + 2)
            across = energy[:, own, :] @ now.reshape(chains, -1, 1) - energy[:, own, own] @ now[:, one, :, None]
            slope = ratios[:, None] * seen[:, own] - ratios[:, None] ** 2 * across[:, :, 0]
            bent = np.sum((wave[:, one] @ energy[:, own, own]) * wave[:, one], axis=2)
            odds = (wave[:, one] @ slope[:, :, None])[:, :, 0] - 0.5 * ratios[:, None] ** 2 * bent
            chosen[:, one] = np.argmax(odds + tried.log_odds[:, one] + rng.gumbel(size=odds.shape), axis=1)
            now[:, one] = wave[each, one, chosen[:, one]]
        rings = np.mean(ratios[:, None, None] * now, axis=0)
        ratios, at = _numbers(grid, turn, tried, chosen, at, rng)
        if sweep >= _SETTLING:
            told.append((ratios, at, rings))
    each_ratio, each_at, each_wave = zip(*told, strict=True)
    return np.concatenate(each_ratio), np.concatenate(each_at), np.mean(each_wave, axis=0)


def _numbers(
    grid: _Grid,
    turn: NDArray[np.complex128],
    tried: _Candidates,
    chosen: Ints,
    at: Ints,
    rng: np.random.Generator,
) -> tuple[Floats, Ints]:
    """Return a ratio and a pair of pitch and decay for each chain, given its shocks.

    The pair is one of some, the ratio integrated out; then the ratio has a normal law between nothing and the most.
    """
    chains, each = at.size, np.arange(at.size)
    some = rng.permutation(grid.decay_s.size)[:_PAIRS]
    offered = np.concatenate((np.tile(some, (chains, 1)), at[:, None]), axis=1)
    amplitude = np.take_along_axis(tried.amplitude, chosen[:, :, None], 2)[:, :, 0]
    before_s = np.take_along_axis(tried.before_s, chosen[:, :, None], 2)[:, :, 0]
    waves = amplitude[:, None, :] * np.exp(turn[offered][:, :, None] * before_s[:, None, :])
    waves *= grid.passed[offered][:, :, None]
    wave = np.stack((waves.imag, waves.real), -1).reshape(*offered.shape, -1)
    others = wave[:, :-1].swapaxes(0, 1)
    seen, energy = np.empty(offered.shape), np.empty(offered.shape)
    seen[:, :-1] = np.einsum("gci,gi->cg", others, grid.seen[some])
    energy[:, :-1] = np.einsum("gci,gci->cg", others @ grid.energy[some], others)
    seen[:, -1] = np.einsum("ci,ci->c", wave[:, -1], grid.seen[at])
    energy[:, -1] = np.einsum("ci,ci->c", (wave[:, -1:] @ grid.energy[at])[:, 0], wave[:, -1])
    energy = np.maximum(energy, 1e-9)  # without a shock nothing is known of the ratio
    mean, sd = seen / energy, 1 / np.sqrt(energy)
    odds = 0.5 * seen * mean + np.log(sd) + log_ndtr(np.minimum(mean, _LOUDEST) / sd)
    odds[:, :-1][offered[:, :-1] == at[:, None]] = -np.inf  # offered once
    picked = np.argmax(odds + rng.gumbel(size=odds.shape), axis=1)
    mean, sd = mean[each, picked], sd[each, picked]
    nearest, farthest = ndtr(np.minimum(mean / sd, 37.0)), ndtr((mean - _LOUDEST) / sd)
    part = farthest + rng.random(chains) * (nearest - farthest)
    ratios = mean - sd * ndtri(np.clip(part, 1e-300, 1 - 1e-16))
    return np.clip(ratios, 0.0, _LOUDEST), offered[each, picked]
