"""What is wrong with the readings' times: some lost, stamps that scatter, a clock that is not as fast as it says."""

from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr
from scipy.stats import norm

from aemd.diagnose.checks.lattice import find_lattice
from aemd.diagnose.evidence import Defect
from aemd.diagnose.result import Value, exact
from aemd.diagnose.series import OVERLOAD, Series
from aemd.tables.grid import digit_of, jumps_for_good, scatter

__all__ = ["clock_error", "missing_samples", "timestamp_jitter"]

Floats = NDArray[np.float64]

_JITTER = 0.01
"""Scatter of the stamps, in intervals, from which it is reported: at 1 % the fastest swing that 15 readings/s can
follow is off by 3 % of its amplitude."""
_LATE = 3
"""Times what most stamps scatter by: what all do is more only where some come late by far."""
_KNOWN = 0.2
"""Error of a standard deviation, of itself, above which the late stamps are too few to tell it."""
_CORE_ERROR = 1.3
"""Times 1/sqrt(n): error of a normal law's standard deviation by the median of its absolute differences; that by their
squares is sqrt(3) / 2."""
_CLOCK = 1e-4
"""Deviation of the interval from the nominal one that is reported; a bench meter's timer keeps 1e-5."""
_EIGHTHS = 8
"""Parts of the record whose intervals are compared; those of real logs of hours keep to 4e-6."""


def missing_samples(series: Series) -> Defect | None:
    """Find steps of more than one interval: counted by the index, or seen in the stamps."""
    jumps = np.diff(series.slot) - 1
    lost, gaps = int(np.sum(jumps)), int(np.count_nonzero(jumps))
    invalid = int(np.count_nonzero(~series.used & ((series.status & OVERLOAD) == 0)))
    if lost + invalid == 0:
        return None
    counted = series.numbered and lost <= int(series.index[-1] - series.index[0]) + 1 - series.index.size
    known = "the readings' numbers" if counted else "the time stamps"
    look = f"{known} show it; look for a stalled host or a full buffer at the first gap, and for its period"
    return Defect(
        cause="missing_samples",
        p_value=0.0,
        parameters={
            "lost": exact(lost + invalid, ""),
            "gaps": exact(gaps, ""),
            "fraction": exact((lost + invalid) / (lost + series.index.size), ""),
        },
        experiment=look if lost else "their places are there without a value; ask what writes the file when it does so",
        check="readings missing",
        observed=lost + invalid,
        expected=0,
    )


def timestamp_jitter(series: Series) -> Defect | None:
    """Find stamps that scatter about the grid by more than the digits they are written with."""
    grid = series.slot
    slope, start = np.polyfit(grid, series.time_s, 1)
    left = series.time_s - (start + slope * grid)
    # Of differences, so that a clock that wanders is not taken for one that jitters; nor is one that was set.
    jitter = np.diff(left)[~jumps_for_good(left / series.interval_s, digit_of(series.time_s) / series.interval_s)]
    core = scatter(jitter)
    whole = float(np.std(jitter)) / sqrt(2)
    rounding = find_lattice(series.time_s) / sqrt(12)
    seen = whole if whole < _LATE * core else core
    if seen < _JITTER * series.interval_s or seen < 2 * rounding:
        return None
    sd = _spread(jitter, core, whole, rounding)
    return Defect(
        cause="timestamp_jitter",
        p_value=float(norm.sf(min(sd.value / max(rounding, 1e-12), 37.0))),
        parameters={"sd_s": sd, "worst_s": exact(float(np.abs(left).max()), "s")},
        experiment="let the meter's own timer pace and number the readings; stamps given by a host scatter as it does",
        check="scatter of the time stamps about their grid, intervals",
        observed=sd.value / series.interval_s,
        expected=_JITTER,
    )


def _spread(jitter: Floats, core: float, whole: float, rounding: float) -> Value:
    """Return the standard deviation of the stamps, s, from their differences.

    Where so few stamps come so late that nobody knows how late the next ones come, it is that of the others, and may be
    as large as that of all.

    Args:
        jitter: differences, s.
        core: what most stamps scatter by, s.
        whole: what all do, s.
        rounding: the part of it that the stamps' digits make, s.
    """
    # Neighbouring differences share a stamp, of whose law they have half the excess kurtosis.
    kurtosis = 2 * float(np.mean((jitter - jitter.mean()) ** 4) / np.var(jitter) ** 2 - 3)
    error = sqrt(max(3 + kurtosis, 0.0) / (4 * jitter.size))
    value = sqrt(max(whole**2 - rounding**2, 0.0))
    if whole < _LATE * core or error < _KNOWN:
        return Value(value, value * (1 - 2 * error), value * (1 + 2 * error), "s")
    inner = sqrt(max(core**2 - rounding**2, 0.0))
    return Value(inner, inner * (1 - 2 * _CORE_ERROR / sqrt(jitter.size)), value * (1 + 2 * error), "s")


def clock_error(series: Series) -> Defect | None:
    """Find an interval that is not the nominal one, or that is not the same all along."""
    return _off_nominal(series) or _uneven_clock(series)


def _off_nominal(series: Series) -> Defect | None:
    if series.nominal_interval_s <= 0:
        return None
    grid = series.slot
    slope, start = np.polyfit(grid, series.time_s, 1)
    left = series.time_s - (start + slope * grid)
    error = float(np.std(left)) * sqrt(12) / (grid[-1] * sqrt(grid.size)) / series.nominal_interval_s
    return _clock_defect(float(slope) / series.nominal_interval_s, error, "interval over the nominal one, minus 1")


def _uneven_clock(series: Series) -> Defect | None:
    """Compare the interval in eighths of the record: the median over the stamps a sixty-fourth of the record apart.

    A clock that was set once moves few of those; stamps that scatter move all, each by as much as the error says.
    """
    rates, errors = [], []
    for eighth in np.array_split(np.arange(series.slot.size), _EIGHTHS):
        grid, time_s = series.slot[eighth], series.time_s[eighth]
        apart = eighth.size // _EIGHTHS
        rates.append(float(np.median((time_s[apart:] - time_s[:-apart]) / (grid[apart:] - grid[:-apart]))))
        scatter_s = float(np.std(time_s - np.polyval(np.polyfit(grid - grid[0], time_s, 1), grid - grid[0])))
        errors.append(scatter_s * sqrt(2) / apart)
    error = sqrt(2) * float(np.median(errors)) / series.interval_s
    return _clock_defect(max(rates) / min(rates), error, "slowest interval over the quickest, of eighths, minus 1")


def _clock_defect(ratio: float, error: float, check: str) -> Defect | None:
    if abs(ratio - 1) < max(_CLOCK, 6 * error):
        return None
    return Defect(
        cause="clock_error",
        p_value=float(2 * ndtr(-min(abs(ratio - 1) / max(error, 1e-9), 37.0))),
        parameters={"ratio": Value(ratio, ratio - 2 * error, ratio + 2 * error, "")},
        experiment="time 1,000 readings against a second clock; ask the meter for the interval that it really keeps",
        check=check,
        observed=ratio - 1,
        expected=_CLOCK,
    )
