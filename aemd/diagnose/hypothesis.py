"""A hypothesis: the base model and the terms added to it, each a function from free numbers to what the filter takes.

The free numbers of a term are unbounded or boxed reals (logarithms of what is positive), and the readings are centred
and scaled, so that one optimiser fits them all. What a user reads (volts, seconds) is made from them at the end.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import exp, inf, log, sqrt
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.apertures import averaged_out
from aemd.diagnose.kernels import MARKOV
from aemd.diagnose.series import Series

__all__ = [
    "Base",
    "Data",
    "Fixed",
    "Parameter",
    "Parts",
    "Seen",
    "Term",
    "base_box",
    "base_start_with_shocks",
    "make_data",
    "signal_and_drift",
]

Floats = NDArray[np.float64]
Bounds = tuple[float, float]

_FASTEST_DECAY = 0.5
"""Intervals, of which a seventh is left in the next reading: a shock that decays faster is one reading's, and so is a
tail of the noise."""
_SLOWEST_DECAY = 0.02
"""Of the span: a shock that decays more slowly is a step or a drift."""
_DECAY_STEPS = 30.0
"""Intervals, about two seconds, that a shock may always take to decay."""


@dataclass(frozen=True, slots=True)
class Data:
    """What is fitted: scaled readings on the grid; shapes (n,)."""

    y: Floats
    """(value - origin) / unit; 0 where not used."""
    used: NDArray[np.bool_]
    step_s: Floats
    t_s: Floats
    """Time on the grid, from 0."""
    slot: NDArray[np.int64]
    interval_s: float
    origin_V: float
    unit_V: float
    witnesses: Mapping[str, Floats] = field(default_factory=dict)
    low: Floats | None = None
    """Where of some readings only an interval is known: its lower end, scaled as they are; the reading itself where
    it is known."""
    high: Floats | None = None
    """The upper end."""
    aperture_s: float = 0.0
    """Over which each reading is a mean; it matters to what is faster than the readings."""
    sample: NDArray[np.int64] | None = None
    """Places of the readings that the filter is run over, where these are not all; shape (m,)."""
    thinned: "Data | None" = None
    """Those readings alone; what is left out between them is time that passes."""

    @property
    def n(self) -> int:
        """Readings that are used."""
        return int(np.count_nonzero(self.used if self.sample is None else self.used[self.sample]))

    @property
    def span_s(self) -> float:
        """From the first reading to the last, s."""
        return float(self.t_s[-1] + self.interval_s)

    def only(self, used: NDArray[np.bool_]) -> "Data":
        """Return the same with fewer readings used."""
        return replace(self, used=self.used & used)

    def sampled(self, blocks: int, length: int) -> "Data":
        """Return the same with the filter run over so many blocks of readings only, even ones, the last at the end."""
        begins = np.linspace(0, self.y.size - length, blocks).astype(np.int64)
        places = (begins[:, None] + np.arange(length)).ravel()
        return replace(self, sample=places, thinned=self._at(places))

    def first(self, count: int) -> "Data":
        """Return the first readings alone."""
        return self._at(slice(count))

    def _at(self, places: slice | NDArray[np.int64]) -> "Data":
        t_s = self.t_s[places]
        step_s = self.step_s[places]
        if not isinstance(places, slice):
            behind_gap = np.flatnonzero(np.diff(places) > 1) + 1
            step_s[behind_gap] = t_s[behind_gap] - t_s[behind_gap - 1]
        return replace(
            self,
            y=self.y[places],
            used=self.used[places],
            step_s=step_s,
            t_s=t_s,
            slot=self.slot[places],
            witnesses={name: values[places] for name, values in self.witnesses.items()},
            low=None if self.low is None else self.low[places],
            high=None if self.high is None else self.high[places],
        )


def make_data(
    series: Series, dropped: NDArray[np.bool_] | None = None, known: tuple[Floats, Floats] | None = None
) -> Data:
    """Scale a series.

    Args:
        series: the readings.
        dropped: those that are kept out, shape (n,).
        known: ends of the interval in which each reading is known to have been, V; both are the reading itself where
            that is known.
    """
    used = series.used if dropped is None else series.used & ~dropped
    kept = series.value_V[used]
    origin = float(np.median(kept))
    spread = float(np.median(np.abs(np.diff(kept)))) * 1.05  # sd of white noise whose differences have that median
    unit = spread if spread > 0 else float(np.std(kept))
    step_s = series.step_s
    return Data(
        y=np.where(used, (series.value_V - origin) / unit, 0.0),
        used=used,
        step_s=step_s,
        t_s=np.cumsum(step_s) - step_s[0],
        slot=series.slot,
        interval_s=series.interval_s,
        origin_V=origin,
        unit_V=unit,
        witnesses=series.witnesses,
        aperture_s=min(series.aperture_s, series.interval_s),
        low=None if known is None else (known[0] - origin) / unit,
        high=None if known is None else (known[1] - origin) / unit,
    )


@dataclass(frozen=True, slots=True)
class Seen:
    """What the filter takes for the readings; shapes (n,)."""

    y: Floats
    low: Floats | None
    high: Floats | None
    log_slope: Floats | float
    """Logarithm of the change of y with the reading: the density of the reading is that of y times the slope."""


@dataclass(slots=True)
class Parts:
    """What the filter takes, while it is being put together; see `kernels.log_densities` for its tables."""

    mean: Floats
    """Deterministic part, shape (n,)."""
    noise_var: Floats
    """Of the white noise, shape (n,)."""
    scale: Floats
    """Factor of the states in each reading, shape (n,)."""
    averaged: Floats | float = 0.0
    """Of the noise's variance what apertures take off, which is no white noise: it stays where that changes."""
    states: list[tuple[float, float, float, float, float, float]] = field(default_factory=list)
    """Kind, time constant, s, angular frequency, 1/s, rate, deviation to begin with, and weight in a reading."""
    shocks: Floats = field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))
    """Rate, 1/s, variance, and the state that is struck; none below 0."""
    extras: Floats = field(default_factory=lambda: np.zeros(6))
    """What a filter of Gaussian processes alone would not need: noise that grows, a bend, outliers, shocks' sign."""
    tails: list[tuple[float, float]] = field(default_factory=list)
    """Probability and added variance of each further noise that a reading may have instead of the usual one."""
    struck: list[float] = field(default_factory=list)
    """Part of a shock that each state takes, where it strikes more than one."""
    kept: float = 0.0
    """Share of the last reading in the next one, by a smoothing after all else."""
    undo: Callable[[Seen], Seen] | None = None
    """Takes off what a model says was done to the readings after all noise."""
    telegraph: Floats | None = None
    """Step, and mean stay below and above it, s, of a level that jumps between two values; it replaces the shocks."""

    def average_out(self, variance: float) -> None:
        """Add the white noise that the mean over apertures leaves beside a process at instants; it is negative."""
        self.noise_var += variance
        self.averaged = self.averaged + variance


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number for the user, as a function of a term's free numbers."""

    name: str
    unit: str
    value: Callable[[Floats], float]
    positive: bool = True
    """Whether its interval is made on a logarithmic scale."""
    limits: tuple[float, float] = (-inf, inf)
    """What is possible at all: where an interval ends that is open on a side."""
    ends: tuple[float, float] | None = None
    """Its 95 % interval, where a term knows it by another way than the likelihood's."""
    drawn: bool = False
    """Whether it is no smooth function of its numbers, so that its interval is made of draws of these."""


class Term(Protocol):
    """One mechanism as the filter sees it."""

    @property
    def cause(self) -> str:
        """Identifier of the mechanism."""

    @property
    def start(self) -> Floats:
        """Free numbers to begin the fit with."""

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Of each free number."""

    @property
    def cost_nats(self) -> float:
        """What its freedom costs where it is compared with rivals; see naming."""

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Put the term, with these free numbers, into the parts."""

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return what is reported of it."""


class Fixed:
    """What a term without free numbers has instead of them; such a term begins with this."""

    __slots__ = ()

    @property
    def start(self) -> Floats:
        """No free numbers."""
        return np.empty(0)

    @property
    def bounds(self) -> Sequence[Bounds]:
        """None."""
        return []

    def parameters(self, data: Data) -> Sequence[Parameter]:  # noqa: ARG002 - a Term's
        """Return nothing, as nothing was estimated."""
        return []


@dataclass(frozen=True, slots=True)
class Base:
    """First-order Markov signal and internal drift, white noise, a level, and shocks where there are any.

    Free numbers: log tau, log rate of one process and of the other, log white, level; with shocks: log rate, log sd,
    log decay. Rates in units per root second. A fit may leave the drift in either place; see signal_and_drift.
    """

    start: Floats
    shocks: bool
    box: tuple[Bounds, ...]
    cause: str = "base"
    cost_nats: float = 0.0

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Of each free number."""
        return self.box

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Put signal, drift, noise, level and shocks into the parts."""
        for tau, rate in ((exp(theta[0]), exp(theta[1])), (exp(theta[2]), exp(theta[3]))):
            parts.states.append((MARKOV, tau, 0.0, rate, rate * sqrt(tau / 2), 1.0))
            parts.average_out(averaged_out(tau, rate, data.aperture_s))
        parts.noise_var += exp(2 * theta[4])
        parts.mean += theta[5]
        if self.shocks:
            parts.shocks = np.array([exp(theta[6]), exp(2 * theta[7]), float(len(parts.states))])
            parts.states.append((MARKOV, exp(theta[8]), 0.0, 0.0, 0.0, 1.0))

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return time constants, deviations, rates and the level in volts."""
        unit = data.unit_V
        found = [
            Parameter("signal_tau_s", "s", lambda v: exp(v[signal_and_drift(v)[0]])),
            Parameter("signal_rate_V_per_rt_s", "V/rt s", lambda v: exp(v[signal_and_drift(v)[0] + 1]) * unit),
            Parameter("drift_tau_s", "s", lambda v: exp(v[signal_and_drift(v)[1]])),
            Parameter("drift_rate_V_per_rt_s", "V/rt s", lambda v: exp(v[signal_and_drift(v)[1] + 1]) * unit),
            Parameter("white_sd_V", "V", lambda v: exp(v[4]) * unit),
            Parameter("level_V", "V", lambda v: v[5] * unit + data.origin_V, positive=False),
        ]
        if self.shocks:
            found += [
                Parameter("shock_rate_per_s", "1/s", lambda v: exp(v[6])),
                Parameter("shock_sd_V", "V", lambda v: exp(v[7]) * unit),
                Parameter("shock_decay_s", "s", lambda v: exp(v[8])),
            ]
        return found


def signal_and_drift(theta: Floats) -> tuple[int, int]:
    """Return where the signal and the drift begin among the base's free numbers: 0 and 2, or 2 and 0.

    A fit may have the two change places. The drift is what is both slower and moves less from reading to reading; where
    one process is both slower and moves more, the other is hardly there, and they stay as they began.
    """
    return (2, 0) if theta[2] < theta[0] and theta[3] > theta[1] else (0, 2)


def base_box(data: Data) -> tuple[Bounds, ...]:
    """Return the bounds of the base's first six free numbers."""
    step, span = data.interval_s, data.span_s
    rate = (log(1e-5 / sqrt(span)), log(1e4 / sqrt(step)))
    reach = 10 * float(np.ptp(data.y[data.used]))
    return (
        (log(0.3 * step), log(span)),
        rate,
        (log(3 * step), log(1e3 * span)),  # beyond, it is a random walk that starts anywhere
        rate,
        (log(1e-3), log(1e4)),
        (-reach, reach),
    )


def base_start_with_shocks(data: Data, theta: Floats, rate_per_s: float, sd: float, decay_s: float) -> Base:
    """Return the base with shocks, beginning from the free numbers of one without."""
    step, span = data.interval_s, data.span_s
    return Base(
        start=np.concatenate((theta[:6], [log(rate_per_s), log(sd), log(decay_s)])),
        shocks=True,
        box=(
            *base_box(data),
            (log(0.1 / span), log(0.5 / step)),
            (log(0.3), log(1e6)),
            (log(_FASTEST_DECAY * step), log(max(_SLOWEST_DECAY * span, _DECAY_STEPS * step))),
        ),
    )
