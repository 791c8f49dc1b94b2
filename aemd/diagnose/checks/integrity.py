"""What is wrong with the readings themselves: repeated, stuck, rounded, clipped; and their times (stamps.py).

These run first, on the raw column, because what they find must not be explained by noise. Each null is an exact bound.
Where it needs to know how predictable a reading is, it takes the innovation variance S of the base fit: given the past,
no cell of a lattice of step q holds more than erf(q / sqrt(8 S)) of the next reading's probability.
"""

from dataclasses import replace
from math import erf, inf, log, log10, pi, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr
from scipy.stats import binom

from aemd.diagnose.checks.lattice import coarser_beyond, find_lattice, find_lattice_within
from aemd.diagnose.checks.stamps import clock_error, missing_samples, timestamp_jitter
from aemd.diagnose.evidence import Defect
from aemd.diagnose.result import Value, exact
from aemd.diagnose.series import OVERLOAD, Series

__all__ = ["check_raw"]

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SURE = 1e-6
"""p below which a defect is one. Far below the other checks' level, so that these never spend of it."""
_COARSE = 0.3
"""Lattice step in innovation deviations from which rounding is more than 0.7 % of the variance, and is reported."""


def check_raw(series: Series, innovation_sd_V: float) -> list[Defect]:
    """Return every defect of the readings.

    Args:
        series: the readings.
        innovation_sd_V: of the base model's one-step prediction, V.
    """
    values = series.value_V[series.used]
    q_V = coarser_beyond(values, find_lattice(values) or find_lattice_within(series))
    band = dead_band(series, q_V, innovation_sd_V)
    clipped = saturation(series, q_V, innovation_sd_V)
    # What rests in the band rests at its level, and what is clipped at the range's end: neither is stuck.
    sound = series
    for resting in (band, clipped):
        if resting is not None and resting.dropped is not None:
            sound = replace(sound, value_V=np.where(resting.dropped, np.nan, sound.value_V))
    found = [
        missing_samples(series),
        band,
        stuck_readings(sound, q_V, innovation_sd_V),
        replayed_block(series, q_V),
        quantisation(series, q_V, innovation_sd_V),
        clipped,
        timestamp_jitter(series),
        clock_error(series),
    ]
    return [defect for defect in found if defect is not None]


def _tie_probability(values: Floats, q_V: float, innovation_sd_V: float) -> float:
    """Return the most that the past leaves to any one value.

    Where the values are too many for `find_lattice` to be sure of one, there may still be one, and some values come
    twice by chance: no step of it is larger than the least distance between two values.
    """
    if q_V == 0:
        distinct = np.unique(values[np.isfinite(values)])
        q_V = float(np.diff(distinct).min()) if distinct.size > 1 else 0.0
    return max(erf(q_V / sqrt(8) / innovation_sd_V), 1e-9)


def _to_a_reading(time_s: float, series: Series) -> Value:
    """Return a time that readings tell: what was between two of them, nobody saw."""
    return Value(time_s, max(time_s - series.interval_s, 0.0), time_s + series.interval_s, "s")


def _to_half_a_step(level_V: float, q_V: float) -> Value:
    """Return a level that readings rest at: on a lattice it may be anywhere in its cell."""
    return Value(level_V, level_V - q_V / 2, level_V + q_V / 2, "V")


def _offset(values: Floats, q_V: float) -> Value:
    """Return how far from 0 V the lattice's nearest point is, as closely as the readings keep to their lattice.

    Readings that were written to fewer digits than the lattice has lie beside it by up to half the last of these.
    """
    turns = values / q_V
    here = float(np.angle(np.mean(np.exp(2j * pi * turns)))) / (2 * pi)
    off = np.abs(turns - here - np.rint(turns - here))
    wide_V = max(float(np.quantile(off, 0.95)) * q_V, float(np.spacing(np.abs(values).max())))
    return Value(here * q_V, here * q_V - wide_V, here * q_V + wide_V, "V")


def _runs(values: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where runs of equal values begin, and their lengths; NaN equals nothing."""
    edges = np.flatnonzero(np.concatenate(([True], values[1:] != values[:-1], [True])))
    return edges[:-1], np.diff(edges)


def dead_band(series: Series, q_V: float, innovation_sd_V: float) -> Defect | None:
    """Find one value in the middle that the readings return to too often, with none just beside it.

    Given the past, a reading equals any stated value with at most the tie probability, so how often it does is at most
    binomial; the value is chosen among n. The hole around it is what sets it apart from a lattice.
    """
    values = series.value_V[series.used]
    distinct, counts = np.unique(values, return_counts=True)
    at = int(np.argmax(counts))
    if not 0 < at < distinct.size - 1:
        return None
    visits = int(np.count_nonzero(np.diff(np.concatenate(([0], values == distinct[at]))) > 0))
    tie = _tie_probability(values, q_V, innovation_sd_V)
    p_value = min(1.0, values.size * float(binom.sf(visits - 1, values.size, tie)))
    low, high = float(distinct[at - 1]), float(distinct[at + 1])
    if p_value > _SURE or visits < 3 or high - low < max(3 * q_V, 0.02 * innovation_sd_V):
        return None
    width = high - low
    return Defect(
        cause="dead_band",
        p_value=p_value,
        parameters={
            "width_V": Value(width, 0.9 * width, width, "V"),
            "level_V": _to_half_a_step(float(distinct[at]), q_V),
            "fraction": exact(float(counts[at]) / values.size, ""),
        },
        experiment="move the input slowly through the level: the reading stays there and then jumps",
        check="returns to one value with none beside it",
        observed=visits,
        expected=2,
        dropped=series.value_V == distinct[at],
    )


def stuck_readings(series: Series, q_V: float, innovation_sd_V: float) -> Defect | None:
    """Find runs of equal values too long for noise: P(any of n runs reaches m) <= n p_tie^(m - 1)."""
    values = series.value_V
    tie = _tie_probability(values, q_V, innovation_sd_V)
    if tie > 0.9:  # the input hardly leaves its cell: nothing can be said
        return None
    begins, lengths = _runs(values)
    limit = 1 + (log(_SURE) - log(values.size)) / log(tie)
    stuck = lengths > max(limit, 2)
    if not stuck.any():
        return None
    dropped = np.zeros(values.size, bool)
    for begin, length in zip(begins[stuck], lengths[stuck], strict=True):
        dropped[begin + 1 : begin + length] = True
    longest = int(lengths.max())
    return Defect(
        cause="stuck_readings",
        p_value=min(1.0, 10 ** max(log10(values.size) + (longest - 1) * log10(tie), -300)),
        parameters={
            "fraction": exact(float(dropped.mean()), ""),
            "dwell_s": _to_a_reading(float(lengths[stuck].mean()) * series.interval_s, series),
            "time_s": _to_a_reading(float(series.time_s[begins[stuck][0]]), series),
        },
        experiment="read the meter's memory directly: if its values change while the log's do not, the link repeats",
        check="longest run of equal readings",
        observed=longest,
        expected=float(max(limit, 2)),
        dropped=dropped,
    )


def replayed_block(series: Series, q_V: float) -> Defect | None:
    """Find a stretch that occurs twice, value for value: P <= n^2 / 2 times the stretch's own probability.

    Of a stretch only its changes count, each with the frequency it has in the record; stretches are compared by a
    rolling hash of windows long enough that one chance match among all pairs has the probability _SURE.
    """
    values = series.value_V
    n = values.size
    changes = np.diff(np.nan_to_num(values))
    if q_V > 0:
        changes = np.rint(changes / q_V)
    _, codes, counts = np.unique(changes, return_inverse=True, return_counts=True)
    # A change of nothing counts for nothing: long runs of one value are another defect.
    surprise = np.where(changes == 0, 0.0, -np.log(counts[codes] / codes.size))
    need = -log(_SURE) + 2 * log(n)
    typical = max(float(np.mean(surprise)), 1e-3)
    width = int(np.ceil(1.5 * need / typical)) + 1
    if width > n // 4:
        return None
    rng = np.random.default_rng(0)  # any numbers do: they only name the codes
    names = rng.integers(1, 2**62, size=counts.size, dtype=np.uint64)
    factor = np.uint64(0x9E3779B97F4A7C15)
    with np.errstate(over="ignore"):
        powers = np.cumprod(np.full(n, factor, np.uint64))
        total = np.concatenate(([np.uint64(0)], np.cumsum(names[codes] * powers[: codes.size])))
        inverse = np.uint64(pow(int(factor), -1, 2**64))
        unpowers = np.cumprod(np.full(n, inverse, np.uint64))
        hashes = (total[width:] - total[:-width]) * unpowers[: codes.size - width + 1]
    weight = np.concatenate(([0.0], np.cumsum(surprise)))
    rich = (weight[width:] - weight[:-width]) > need
    order = np.argsort(hashes, kind="stable")
    same = (hashes[order][1:] == hashes[order][:-1]) & rich[order][1:]
    if not same.any():
        return None
    dropped = np.zeros(n, bool)
    copies = order[1:][same]
    originals = order[:-1][same]
    for copy, original in zip(copies, originals, strict=True):
        if np.array_equal(values[copy : copy + width + 1], values[original : original + width + 1]):
            dropped[copy : copy + width + 1] = True
    if not dropped.any():
        return None
    first = int(np.argmax(dropped))
    at = int(copies[np.argmin(np.abs(copies - first))])
    original = int(originals[np.argmin(np.abs(copies - first))])
    length = int(np.argmin(np.concatenate((dropped[first:], [False]))))
    return Defect(
        cause="replayed_block",
        p_value=float(np.exp(2 * log(n) - min(float(np.sum(surprise[first : first + length - 1])), 700))),
        parameters={
            "time_s": _to_a_reading(float(series.time_s[first]), series),
            "fraction": exact(float(dropped.mean()), ""),
            "dwell_s": _to_a_reading(length * series.interval_s, series),
            "lag_s": _to_a_reading(float(series.time_s[at] - series.time_s[original]), series),
        },
        experiment="number the readings at the meter (its memory's index) and look whether numbers come twice",
        check="longest stretch that occurs twice, readings",
        observed=length,
        expected=width,
        dropped=dropped,
    )


def quantisation(series: Series, q_V: float, innovation_sd_V: float) -> Defect | None:
    """Find a lattice whose step is not small beside what is new in each reading."""
    if q_V < _COARSE * innovation_sd_V:
        return None
    values = series.value_V[series.used]
    distinct = np.unique(values).size
    return Defect(
        cause="quantisation",
        p_value=float(10 ** max(-(values.size - distinct) * 3.0, -300)),
        parameters={
            "step_V": exact(q_V, "V"),
            "offset_V": _offset(values, q_V),
            "ratio": exact(q_V / innovation_sd_V, ""),
        },
        experiment="log one more digit, or read in binary: the lattice goes if it was the log's, not if the meter's",
        check="lattice step in deviations of a reading's news",
        observed=q_V / innovation_sd_V,
        expected=_COARSE,
    )


def saturation(series: Series, q_V: float, innovation_sd_V: float) -> Defect | None:
    """Find readings that pile up at an extreme, or that the meter flagged as overload.

    Given that a reading with prediction at most c lies in the extreme cell or beyond, it lies in the cell with at most
    the Gaussian hazard there; that none of k went beyond has the product of those probabilities.
    """
    values = series.value_V
    overloads = int(np.count_nonzero(series.status & OVERLOAD))
    cell = max(q_V, float(np.spacing(np.nanmax(np.abs(values)))) * 4)
    ends: list[tuple[float, float]] = []
    for sign in (1.0, -1.0):
        signed = sign * values
        extreme = float(np.nanmax(signed))
        at = np.flatnonzero(signed >= extreme - 0.25 * cell)
        if at.size < 3:
            continue
        # The reading before bounds the prediction well enough: clipped excursions come in runs.
        before = signed[np.maximum(at - 1, 0)]
        distance = np.clip((extreme - cell / 2 - np.nan_to_num(before, nan=extreme)) / innovation_sd_V, 0, 4)
        beyond = log_ndtr(-(distance + cell / innovation_sd_V)) - log_ndtr(-distance)
        inside = np.log(-np.expm1(np.minimum(beyond, -1e-12)))
        log_p = log(values.size) + float(np.sum(inside)) - float(np.min(inside))  # one is there by definition
        if log_p < log(_SURE):
            ends.append((log_p, sign * extreme))
    if not ends and not overloads:
        return None
    clipped = np.isin(values, [level for _, level in ends]) | ((series.status & OVERLOAD) != 0)
    log_p, level = min(ends, default=(-inf, float(np.nanmax(np.abs(values)))))
    return Defect(
        cause="saturation",
        p_value=0.0 if overloads else float(np.exp(max(log_p, -690.0))),
        parameters={
            "level_V": _to_half_a_step(level, q_V),
            **({"other_level_V": _to_half_a_step(max(ends)[1], q_V)} if len(ends) > 1 else {}),
            "fraction": exact(float(clipped.mean()), ""),
        },
        experiment="take the next range for a minute: the readings go beyond the level if the range cut them",
        check="readings at the extremes" if len(ends) > 1 else "readings at the extreme",
        observed=int(np.count_nonzero(clipped)),
        expected=2,
        dropped=clipped,
    )
