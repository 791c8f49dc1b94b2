"""Noise beyond the base's: further processes, noise that neighbours share, noise that changes or has tails."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, inf, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.apertures import averaged_markov
from aemd.diagnose.hypothesis import Bounds, Data, Parameter, Parts
from aemd.diagnose.kernels import MARKOV, PAIR, PAIR_SECOND, PREVIOUS, WHITE

__all__ = [
    "ChangingNoise",
    "DifferenceNoise",
    "ExtraMarkov",
    "Flicker",
    "HeavyTails",
    "RandomWalk",
    "Resonance",
    "SignalDependentNoise",
    "Smoothing",
    "SwellingNoise",
    "flicker_processes",
]

Floats = NDArray[np.float64]

_WIDE: Bounds = (log(1e-6), log(1e6))
"""Of the logarithm of a size in units of the readings' noise."""


@dataclass(frozen=True, slots=True)
class ExtraMarkov:
    """A third first-order process; free numbers log tau_s, log sd."""

    tau_s: float
    sd: float
    cost_nats: float
    cause: str = "extra_gauss_markov"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([log(self.tau_s), log(self.sd)])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """A factor of 30 about the time constant that the score found."""
        return [(log(self.tau_s / 30), log(self.tau_s * 30)), _WIDE]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:  # noqa: ARG002 - a Term's
        """Add its state."""
        tau, sd = exp(theta[0]), exp(theta[1])
        parts.states.append((MARKOV, tau, 0.0, sd * sqrt(2 / tau), sd, 1.0))

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return its time constant and standard deviation."""
        unit = data.unit_V
        return [Parameter("tau_s", "s", lambda v: exp(v[0])), Parameter("sd_V", "V", lambda v: exp(v[1]) * unit)]


@dataclass(frozen=True, slots=True)
class RandomWalk:
    """A random walk on top of a drift that is not one; free number log rate in units per root second."""

    rate: float
    cost_nats: float
    cause: str = "random_walk"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([log(self.rate)])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Of the rate."""
        return [_WIDE]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:  # noqa: ARG002 - a Term's
        """Add its state, which begins at the level."""
        parts.states.append((MARKOV, inf, 0.0, exp(theta[0]), 0.0, 1.0))

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return its rate."""
        unit = data.unit_V
        return [Parameter("rate_V_per_rt_s", "V/rt s", lambda v: exp(v[0]) * unit)]


def flicker_processes(low_hz: float, high_hz: float) -> tuple[Floats, Floats]:
    """Return time constants, s, and variances of first-order processes that sum to a one-sided density 1/f.

    Three of them to two decades: with corners r apart and the variance ln r each, the sum of the Lorentzians
    4 v tau / (1 + (2 pi f tau)^2) is 1/f within 5 % between the two frequencies.
    """
    count = max(int(np.ceil(np.log10(high_hz / low_hz) * 1.5)) + 1, 2)
    corners = np.geomspace(low_hz, high_hz, count)
    ratio = corners[1] / corners[0]
    return np.asarray(1 / (2 * pi * corners)), np.full(count, log(ratio))


@dataclass(frozen=True, slots=True)
class Flicker:
    """Noise of one-sided density amplitude^2/f over the record's band; free number log amplitude."""

    amplitude: float
    cost_nats: float
    cause: str = "flicker_noise"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([log(self.amplitude)])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Of the amplitude."""
        return [_WIDE]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Add a state for each process."""
        taus, variances = flicker_processes(0.3 / data.span_s, 0.5 / data.interval_s)
        for tau, variance in zip(taus, variances, strict=True):
            rate, lost = averaged_markov(tau, exp(theta[0]) * sqrt(2 * variance / tau), data.aperture_s)
            parts.states.append((MARKOV, tau, 0.0, rate, rate * sqrt(tau / 2), 1.0))
            parts.average_out(lost)

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the root of its one-sided density at 1 Hz."""
        unit = data.unit_V
        return [Parameter("amplitude_V", "V", lambda v: exp(v[0]) * unit)]


@dataclass(frozen=True, slots=True)
class Resonance:
    """A swinging pair driven by noise; free numbers log tau_s, (f - f0) tau0, log sd."""

    frequency_hz: float
    tau_s: float
    longest_s: float
    """Bound of the time constant: what is narrower than some frequencies of the record is a line."""
    sd: float
    cost_nats: float
    cause: str = "resonance"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([log(self.tau_s), 0.0, log(self.sd)])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """A factor of 10 in width, a width in frequency."""
        return [(log(self.tau_s / 10), log(min(self.tau_s * 10, self.longest_s))), (-1.0, 1.0), _WIDE]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:  # noqa: ARG002 - a Term's
        """Add its two states."""
        tau, sd = exp(theta[0]), exp(theta[2])
        omega = 2 * pi * (self.frequency_hz + theta[1] / self.tau_s)
        parts.states.append((PAIR, tau, omega, sd, sd, 1.0))
        parts.states.append((PAIR_SECOND, tau, omega, sd, sd, 0.0))

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return frequency, standard deviation and quality w tau / 2."""
        unit = data.unit_V

        def frequency(v: Floats) -> float:
            return float(self.frequency_hz + v[1] / self.tau_s)

        return [
            Parameter("frequency_hz", "Hz", frequency),
            Parameter("sd_V", "V", lambda v: exp(v[2]) * unit),
            Parameter("quality", "", lambda v: pi * abs(frequency(v)) * exp(v[0])),
        ]


@dataclass(frozen=True, slots=True)
class DifferenceNoise:
    """Each reading gains w_k - w_{k-1}; free number log sd of w."""

    sd: float
    cost_nats: float
    cause: str = "difference_noise"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([log(self.sd)])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Of the deviation."""
        return [_WIDE]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Add w and the w before it."""
        sd = exp(theta[0])
        parts.states.append((WHITE, 1.0, 0.0, sd, sd, 1.0))
        parts.states.append((PREVIOUS, 1.5 * data.interval_s, 0.0, sd, sd, -1.0))

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the deviation of w."""
        unit = data.unit_V
        return [Parameter("sd_V", "V", lambda v: exp(v[0]) * unit)]


@dataclass(frozen=True, slots=True)
class Smoothing:
    """Readings filtered as y_k = kept y_{k-1} + (1 - kept) x_k; free number the logit of kept.

    The filter is undone before the likelihood is taken: x is as certain as y, and its density is (1 - kept) times y's.
    """

    kept: float
    cost_nats: float
    cause: str = "smoothing"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([log(self.kept / (1 - self.kept))])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """From 0.7 % to 99.3 %."""
        return [(-5.0, 5.0)]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:  # noqa: ARG002 - a Term's
        """Say how much is kept."""
        parts.kept = 1 / (1 + exp(-theta[0]))

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return the share of the last reading, and the filter's time constant."""
        return [
            Parameter("fraction", "", lambda v: 1 / (1 + exp(-v[0]))),
            Parameter("tau_s", "s", lambda v: data.interval_s / log(1 + exp(-v[0]))),
        ]


@dataclass(frozen=True, slots=True)
class ChangingNoise:
    """White noise whose deviation is multiplied by a ratio from one instant to another; free number log ratio.

    The instants are those of the check's largest excursion; they are not fitted, and their intervals are a scan's.
    """

    begin_s: float
    end_s: float
    ratio: float
    cost_nats: float
    everything: bool = False
    """Multiply the processes, too: no mechanism of the catalogue, so where that explains more, the name is refused."""

    @property
    def cause(self) -> str:
        """Id of what it stands for."""
        return "unexplained" if self.everything else "changing_noise"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([log(self.ratio)])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Of the ratio."""
        return [(log(1e-3), log(1e3))]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Scale the white noise, or everything, between the instants."""
        inside = (data.t_s >= self.begin_s) & (data.t_s < self.end_s)
        if self.everything:
            parts.scale = np.where(inside, parts.scale * exp(theta[0]), parts.scale)
        stays = 0.0 if self.everything else parts.averaged
        parts.noise_var = np.where(inside, stays + (parts.noise_var - stays) * exp(2 * theta[0]), parts.noise_var)

    def parameters(self, data: Data) -> Sequence[Parameter]:  # noqa: ARG002 - a Term's
        """Return when, how long, and the ratio of standard deviations."""
        return [
            Parameter("time_s", "s", lambda _: self.begin_s),
            Parameter("dwell_s", "s", lambda _: self.end_s - self.begin_s),
            Parameter("ratio", "", lambda v: exp(v[0])),
        ]


@dataclass(frozen=True, slots=True)
class SwellingNoise:
    """White noise whose deviation swells or fades along a bell, and never jumps; no mechanism of the catalogue.

    Free numbers: log ratio at the top, its place in widths, and the logarithm of its width. As many as a noise that
    changes has, so where this explains more, the noise does not change at two instants.
    """

    centre_s: float
    width_s: float
    ratio: float
    cost_nats: float
    cause: str = "unexplained"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([log(self.ratio), 0.0, 0.0])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Of the ratio; some widths aside; a factor of 10 in width."""
        return [(log(1e-3), log(1e3)), (-3.0, 3.0), (-2.3, 2.3)]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Scale the white noise along the bell."""
        apart = (data.t_s - self.centre_s) / self.width_s - theta[1]
        bell = np.exp(-0.5 * (apart / exp(theta[2])) ** 2)
        parts.noise_var = parts.averaged + (parts.noise_var - parts.averaged) * np.exp(2 * theta[0] * bell)

    def parameters(self, data: Data) -> Sequence[Parameter]:  # noqa: ARG002 - a Term's
        """Return when it is at its top, how wide it is, and the ratio of deviations there."""
        return [
            Parameter("time_s", "s", lambda v: self.centre_s + v[1] * self.width_s, positive=False),
            Parameter("dwell_s", "s", lambda v: self.width_s * exp(v[2])),
            Parameter("ratio", "", lambda v: exp(v[0])),
        ]


@dataclass(frozen=True, slots=True)
class SignalDependentNoise:
    """A gain that flickers: variance fraction^2 times the square of the reading; free number log fraction."""

    fraction: float
    cost_nats: float
    cause: str = "signal_dependent_noise"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([log(self.fraction)])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """Of the fraction."""
        return [(log(1e-9), log(10.0))]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Let the noise follow the predicted reading."""
        parts.extras[0] = exp(2 * theta[0])
        parts.extras[4] = float(parts.mean[0]) + data.origin_V / data.unit_V

    def parameters(self, data: Data) -> Sequence[Parameter]:  # noqa: ARG002 - a Term's
        """Return the gain's deviation."""
        return [Parameter("fraction", "", lambda v: exp(v[0]))]


@dataclass(frozen=True, slots=True)
class HeavyTails:
    """Now and then a reading with far more noise; free numbers log of that probability, log of the deviation added."""

    fraction: float
    sd: float
    cost_nats: float
    beside: tuple[float, ...] = ()
    """Free numbers of all other terms where the check found most: those without tails have them as shocks."""
    cause: str = "heavy_tails"

    @property
    def start(self) -> Floats:
        """Free numbers to begin with."""
        return np.array([log(self.fraction), log(self.sd)])

    @property
    def bounds(self) -> Sequence[Bounds]:
        """At most half of the readings."""
        return [(log(1e-5), log(0.5)), _WIDE]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:  # noqa: ARG002 - a Term's
        """Add the hypothesis of an outlier."""
        parts.extras[2], parts.extras[3] = exp(theta[0]), exp(2 * theta[1])

    def parameters(self, data: Data) -> Sequence[Parameter]:
        """Return how often, and the deviation of what is added then.

        No degrees of freedom. Those of Student's law with this kurtosis are 4 + 2p/(1 - p), above 4 for any p: they
        match it for an estimator, and of noise that is Student's with 3 they would say 4.0 with an interval of nothing.
        """
        unit = data.unit_V
        return [
            Parameter("fraction", "", lambda v: exp(v[0])),
            Parameter("sd_V", "V", lambda v: exp(v[1]) * unit),
        ]
