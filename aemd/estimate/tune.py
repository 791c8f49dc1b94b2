"""Find the options of IMM in a stretch of readings, by maximum likelihood.

The likelihood is the estimator's own, one step ahead. It is maximised for each of a few kinds of model (is there a
signal, does it swing, is there a slow part), and the kind is chosen by Schwarz's criterion (BIC), which asks of each
further parameter that it raise the log-likelihood by half the logarithm of the number of readings.

Two things no likelihood can tell, so they are stated: the slowest signal, which parts the band of the input from that
of the drift; and the noise where the input moves by far more than it from reading to reading, since its share is then
lost in the scatter of the rest. It can be taken from a stretch at rest, see `noise_of`.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from aemd.block import ESTIMATE, NOT_A_VALUE, Block, Status
from aemd.errors import ConfigError
from aemd.estimate.imm import ImmOptions, imm_model
from aemd.estimate.imm_kernels import run_imm, start_imm
from aemd.estimate.kalman import columns_of
from aemd.estimate.resonance import Resonances, find_resonances

__all__ = ["Kind", "Tuning", "noise_of", "tune"]

Floats = NDArray[np.float64]

_LEAST_READINGS = 100  # fewer do not tell eight parameters apart
_EXPLORED = 4  # pieces of a long stretch on which the kinds are compared
_PIECE = 2_500  # readings of each; the best kind is then fitted to the whole stretch
_ABSENT = 1e-2  # standard deviation of a part that is not there, in units of the noise: nothing, but not singular
_LEAST_RATE = 3.2  # of a swing, in noises over the length of the stretch: see _Likelihood._options
_SHARP = 1000.0  # factor of the logarithm of a frequency: see _Likelihood
_ORDERS = (4, 8, 12, 16, 20)  # of the autoregressions that are tried where many parts are allowed
_ROUNDS = 2  # of the search over many swings
_PEAKS = 2  # in the spectrum of the errors, at which a further swing is tried
_PEAK_WIDTH = 8  # of the spectrum's bins: the foot of a line under a Hann window, and some
_DRASTIC = 5.0  # least standard deviation of the abrupt disturbance in units of the noise: less is not told from noise


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of model: which parts there are besides noise and abrupt disturbance."""

    signal: tuple[Literal["markov", "swing"], ...]
    """Parts of the input: Markov processes of first order (eq. 2), or ones that swing at a frequency."""
    slow: bool
    """Whether there is a slow part."""
    order: int = 0
    """Of an autoregression whose resonances are the input's parts, in place of `signal`; 0: none."""

    def __str__(self) -> str:
        """Return its name."""
        signal = (f"resonances of order {self.order}",) if self.order else self.signal
        return " + ".join((*signal, "slow")[: len(signal) + self.slow]) or "noise"

    @property
    def parameters(self) -> int:
        """Number of free parameters."""
        return (
            5
            + 2 * self.slow
            + (self.order + 1 if self.order else 0)
            + sum({"markov": 2, "swing": 3}[part] for part in self.signal)
        )


@dataclass(frozen=True, slots=True)
class Tuning:
    """What was found."""

    options: ImmOptions
    kind: Kind
    readings: int
    """Readings with a value that it was found in."""
    log_likelihood: float
    """Per reading, one step ahead, natural logarithm of a density in 1/V."""
    compared: tuple[tuple[str, float], ...]
    """Each kind that was tried and its BIC, on the part of the stretch that was explored; the least is best."""


def tune(
    stretches: Sequence[Block],
    interval_s: float,
    *,
    origin_V: float | None = None,
    noise_V: float | None = None,
    slow: Literal["disturbance", "input"] = "disturbance",
    slowest_signal_s: float | None = None,
    kinds: Sequence[Kind] | None = None,
    most_parts: int = 1,
) -> Tuning:
    """Return the options of greatest likelihood.

    Args:
        stretches: readings, one array of READING or several that are independent of each other.
        interval_s: between readings, s.
        origin_V: what the input varies about, V; without it the median.
        noise_V: standard deviation of the white noise where it is known, V; without it, it is fitted.
        slow: what the slow part is; see ImmOptions. Where it is part of the input it is always there: nothing is lost
            by it, and a stretch that did not drift is no promise.
        slowest_signal_s: longest period of the input, s; what is slower is the slow part. Without it, 150 readings:
            10 s at 15 readings/s.
        kinds: kinds of model to compare; without it, all with at most one part of the input.
        most_parts: of the input; more swings are added to the best while that is better.

    Raises:
        ConfigError: too few readings with a value, or they are all equal.
    """
    values = [block["value_V"][_usable(block)] for block in stretches]
    together = np.concatenate(values) if values else np.empty(0)
    if together.size < _LEAST_READINGS:
        raise ConfigError(f"{together.size} readings with a value: too few to tune by, at least {_LEAST_READINGS}")
    if np.ptp(together) == 0:
        raise ConfigError(f"all {together.size} readings are {together[0]:g} V: nothing to tune by")
    origin = float(np.median(together)) if origin_V is None else origin_V
    slowest = 150.0 if slowest_signal_s is None else slowest_signal_s / interval_s
    whole = _Likelihood(stretches, origin, noise_V, slowest, walk=slow == "input")
    pieces = _pieces(stretches)
    explored = whole if pieces is stretches else _Likelihood(pieces, origin, noise_V, slowest, walk=slow == "input")

    kinds = kinds or [kind for kind in _KINDS if kind.slow or slow == "disturbance"]
    tried = [_fit(explored, kind, _starts(explored, kind)) for kind in kinds]
    parts = 1
    while parts < most_parts and len(min(tried).kind.signal) == parts:
        tried.append(_extended(explored, min(tried)))
        parts += 1
    for order in _ORDERS:
        if 1 < order // 2 <= most_parts and max(map(len, explored.values)) > 10 * order:
            kind = Kind((), slow=True, order=order)
            tried.append(_fit(explored, kind, _starts(explored, kind)))
    best = min(tried)
    if len(best.kind.signal) > 1:
        best = _settled(whole, best)
    elif explored is not whole:
        best = _fit(whole, best.kind, [best.theta])
    return Tuning(
        options=whole.options(best.kind, best.theta, interval_s, slow),
        kind=best.kind,
        readings=int(together.size),
        log_likelihood=whole(best.kind, best.theta) / together.size - math.log(whole.unit_V),
        compared=tuple((str(fit.kind), fit.criterion) for fit in tried),
    )


def noise_of(block: Block) -> float:
    """Return the standard deviation of the white noise of a stretch whose input is at rest, V.

    From the third differences, whose variance is 20 times that of the noise, and in which what moves slowly is next to
    nothing (the Hadamard relative of the paper's Allan variance, after eq. 3); those beyond 5 of their own standard
    deviations, which shocks leave, are put aside.

    Raises:
        ConfigError: too few readings with a value.
    """
    usable = _usable(block)
    values, index = block["value_V"][usable], block["index"][usable]
    third = np.diff(values, 3)[index[3:] - index[:-3] == 3]
    if third.size < _LEAST_READINGS:
        raise ConfigError(f"{third.size} runs of four readings with a value: too few, at least {_LEAST_READINGS}")
    limit = 5 * float(np.median(np.abs(third))) / 0.6745  # of a Gaussian, the median is at 0.6745
    for _ in range(5):
        kept = third[np.abs(third) <= limit]
        limit = 5 * float(np.sqrt(np.mean(kept**2)))
    return float(np.sqrt(np.mean(kept**2) / 20))


_KINDS = tuple(Kind(signal, there) for signal in ((), ("markov",), ("swing",)) for there in (True, False))


@dataclass(frozen=True, slots=True)
class _Fit:
    """A kind and its best parameters."""

    kind: Kind
    theta: Floats
    criterion: float
    """BIC over 2: less is better."""

    def __lt__(self, other: "_Fit") -> bool:
        return self.criterion < other.criterion


class _Likelihood:
    """Log-likelihood of some stretches for any kind and parameters, in the units of the search.

    The unit of voltage is the noise between neighbouring readings, the unit of time a reading, and parameters are
    logarithms, so that the search sees numbers near 1 whatever was measured. The logarithm of a frequency is multiplied
    by a thousand: the readings tell it that much more sharply than the rest, and the search goes astray in a ravine.
    """

    def __init__(
        self, stretches: Sequence[Block], origin_V: float, noise_V: float | None, slowest: float, *, walk: bool
    ) -> None:
        self.origin_V = origin_V
        self.slowest = slowest
        self.walk = walk
        values_V = [block["value_V"][_usable(block)] for block in stretches]
        self.values = values_V
        steps_V = np.abs(np.concatenate([np.diff(value_V) for value_V in values_V]))
        middling_V = float(np.median(steps_V)) / 0.6745 / math.sqrt(2)
        self.unit_V = middling_V or float(np.sqrt(np.mean(steps_V**2) / 2))  # coarse steps: most differences are 0
        self.values = [(value_V - origin_V) / self.unit_V for value_V in values_V]
        self.size = sum(map(len, self.values))
        self.noise = None if noise_V is None else noise_V / self.unit_V
        self._resonances: dict[int, Resonances] = {}
        self._columns = []
        for block in stretches:
            index, value_V, status = columns_of(block)
            self._columns.append((index, block["t_ns"].copy(), (value_V - origin_V) / self.unit_V, status))
        self._out = np.empty(max(map(len, stretches)), dtype=ESTIMATE)

    def __call__(self, kind: Kind, theta: Floats) -> float:
        """Return the log-likelihood of all stretches, each from its own start, in natural units of density 1/unit_V."""
        model = imm_model(self._options(kind, theta), 1.0)
        pairs = (0,) * model.cos.size
        total = 0.0
        for columns in self._columns:
            ready = run_imm(pairs, start_imm(model, 0), model, *columns, self._out)
            total += float(self._out["log_likelihood"][:ready].sum())
        return total

    def errors(self, kind: Kind, theta: Floats) -> Floats:
        """Return what the model foresees least: the noise that it ascribes to each reading of the longest stretch.

        It is the one-step error times a constant, but of a disturbed reading next to nothing. What is in it besides
        noise, the model lacks.
        """
        model = imm_model(self._options(kind, theta), 1.0)
        columns = max(self._columns, key=lambda columns: columns[0].size)
        ready = run_imm((0,) * model.cos.size, start_imm(model, 0), model, *columns, self._out)
        rows, taken = self._out[:ready], self._out["status"][:ready] & Status.COASTED == 0
        return np.asarray((columns[2][:ready] - rows["value_V"] - rows["u_V"])[taken])

    def resonances(self, order: int) -> Resonances:
        """Return those of an autoregression, found once."""
        if order not in self._resonances:
            self._resonances[order] = find_resonances(self.values, order)
        return self._resonances[order]

    def bounds(self, kind: Kind) -> list[tuple[float, float]]:
        """Return the logarithms between which each parameter is sought."""
        spread = max(float(np.ptp(value)) for value in self.values) + 1.0
        longest = math.log(100.0 * self.size)
        edge = math.log(self.slowest / (2 * math.pi))
        noise = (math.log(1e-3), math.log(10.0)) if self.noise is None else (math.log(self.noise),) * 2
        found = [noise, (0.0, math.log(100 * spread)), (math.log(2.0), longest), (math.log(0.15), longest)]
        found.append((math.log(50.0), math.log(1000.0)) if self.walk else (longest, longest))
        if kind.slow:
            returns = (longest + math.log(10.0),) * 2 if self.walk else (edge + math.log(10.0), longest)
            found += [(math.log(1e-4), math.log(10.0)), returns]
        if kind.order:
            found.append((math.log(1e-3), math.log(10.0)))
        for part in kind.signal:
            if part == "markov":
                found += [(math.log(1e-3), math.log(100.0)), (math.log(0.3), edge)]
            else:
                found += [
                    (math.log(1e-2), math.log(10 * spread)),
                    (math.log(_LEAST_RATE / self.size), math.log(1e5)),  # 100 of our units, if the noise is least
                    (-_SHARP * math.log(self.slowest), _SHARP * math.log(0.5)),
                ]
        return found

    def options(
        self, kind: Kind, theta: Floats, interval_s: float, slow: Literal["disturbance", "input"]
    ) -> ImmOptions:
        """Return the options in SI units."""
        found = self._options(kind, theta)
        scaled: dict[str, Any] = {}
        for name, value in asdict(found).items():
            unit = (
                self.unit_V
                if name.endswith("_V")
                else float(interval_s)
                if name.endswith("_s")
                else 1 / float(interval_s)
            )
            if name.endswith(("_V", "_s", "_hz")) and name != "origin_V":
                scaled[name] = tuple(unit * part for part in value) if isinstance(value, tuple) else unit * value
        scaled["longest_disturbance_s"] = max(60.0, 20 * scaled["disturbed_s"])
        return replace(found, **scaled, origin_V=self.origin_V, slow=slow)

    def _options(self, kind: Kind, theta: Floats) -> ImmOptions:
        """Return the options in the units of the search.

        A Markov process is sought by its rate (rms step, well determined by the readings) and its time; a swing by its
        standard deviation and its rate, since its time may be endless. That rate is kept from 0, because N readings of
        noise sigma tell the frequency of a swing of amplitude A only to sqrt(24) sigma / (A N^1.5) radians per reading
        (Cramer and Rao). A filter of rate r remembers sqrt(2) sigma / r readings; over them the frequency's error grows
        to one of variance b^2 = 48 sigma^4 / (N^3 r^2) in phase and none in amplitude. It expects a variance of
        P = sqrt(2) sigma r in either, half of it from the noise and half as room for such errors. On the mean of both
        directions the room is filled at b^2 = P, which is r = 3.2 sigma / N; a lower rate would claim too much.
        """
        logarithm = iter(theta.tolist())
        number = map(math.exp, logarithm)
        noise, disturbed, quiet, lasting, memory = (next(number) for _ in range(5))
        slow_V, slow_tau = _ABSENT * noise, 10.0 * self.size
        if kind.slow:
            rate, slow_tau = next(number), next(number)
            slow_V = rate * math.sqrt(slow_tau / 2)
        parts: list[tuple[float, float, float]] = []
        for part in kind.signal:
            if part == "markov":
                rate, tau = next(number), next(number)
                parts.append((rate * math.sqrt(tau / 2), tau, 0.0))
            else:
                sd, rate, frequency = next(number), noise * next(number), math.exp(next(logarithm) / _SHARP)
                parts.append((sd, max(2 * (sd / rate) ** 2, 1.0), frequency))
        drive: NDArray[np.complex128] = np.zeros(0, dtype=complex)
        if kind.order:
            found = self.resonances(kind.order)
            drive = next(number) * found.error * found.gain
            parts = [
                (_ABSENT * noise, *part) for part in zip(found.tau.tolist(), found.frequency.tolist(), strict=True)
            ]
        signal_V, signal_tau, signal_hz = zip(*(parts or [(_ABSENT * noise, 1.0, 0.0)]), strict=True)
        return ImmOptions(
            signal_V=signal_V,
            signal_tau_s=signal_tau,
            signal_hz=signal_hz,
            drive_V=tuple(np.abs(drive).tolist()),
            drive_rad=tuple(np.angle(drive).tolist()),
            slow_V=slow_V,
            slow_tau_s=slow_tau,
            origin_V=0.0,
            noise_V=noise,
            disturbed_V=_DRASTIC * noise + disturbed,
            quiet_s=quiet,
            disturbed_s=lasting,
            longest_disturbance_s=1e9,
            variance_memory_s=memory,
        )


def _starts(likelihood: _Likelihood, kind: Kind) -> list[Floats]:
    """Return parameters to start the search from."""
    together = np.concatenate(likelihood.values)
    spread = 1.4826 * float(np.median(np.abs(together - np.median(together)))) + 1.0
    drift = float(
        np.median([np.median(np.abs(value[64:] - value[:-64])) for value in likelihood.values if value.size > 64])
    )
    rate = max(drift / 0.6745 / 8, 1e-3)  # of a random walk that goes so far in 64 readings
    loudest = _loudest(likelihood)
    starts = []
    for noise, lasting in ((0.9, 5.0), (0.2, 5.0)):
        start = [
            noise if likelihood.noise is None else likelihood.noise,
            10 * float(np.std(together)) + 1.0,
            100.0,
            lasting,
        ]
        start.append(10.0 * likelihood.size)
        if kind.slow:
            start += [rate, max(2 * (float(np.std(together)) / rate) ** 2, 1.0)]
        logarithms = [math.log(value) for value in start]
        if kind.order:
            error = likelihood.resonances(kind.order).error
            logarithms[0] = math.log((0.1 if noise > lasting / 10 else 0.5) * error)
            logarithms[5] = math.log(1e-2 * error)
            logarithms.append(0.0)
        for part in kind.signal:
            if part == "markov":
                logarithms += [math.log(spread / 3), math.log(10.0)]
            else:
                logarithms += [math.log(spread), math.log(_LEAST_RATE / likelihood.size), _SHARP * math.log(loudest)]
        starts.append(np.array(logarithms))
    return starts


def _loudest(likelihood: _Likelihood) -> float:
    """Return the frequency at which the readings swing most, in cycles per reading, above the band of the slow part."""
    value = max(likelihood.values, key=len)
    middle = float(np.median(value))
    reach = 4 * 1.4826 * float(np.median(np.abs(value - middle))) + 1.0
    clipped = np.clip(value - middle, -reach, reach) * np.hanning(value.size)  # a shock has power at every frequency
    power = np.abs(np.fft.rfft(clipped, 4 * value.size)) ** 2
    frequency = np.fft.rfftfreq(4 * value.size)
    power[(frequency < 1 / likelihood.slowest) | (frequency > 0.499)] = 0
    return float(frequency[np.argmax(power)])


def _fit(likelihood: _Likelihood, kind: Kind, starts: Sequence[Floats], free: NDArray[np.int64] | None = None) -> _Fit:
    """Return the parameters of greatest likelihood; `free` are the numbers of those that are sought, if not all."""
    bounds = likelihood.bounds(kind)
    if free is not None:  # a search leaves alone what may not move
        bounds = [
            bound if i in free else (value, value)
            for i, (bound, value) in enumerate(zip(bounds, starts[0], strict=True))
        ]
    low, high = np.transpose(bounds)

    def unlikely(theta: Floats) -> float:
        """Return minus the log-likelihood per reading: the search's tolerances are made for numbers near 1."""
        value = -likelihood(kind, theta) / likelihood.size
        return value if math.isfinite(value) else 1e6

    found = [
        minimize(
            unlikely,
            np.clip(start, low, high),
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxfun": 3000, "ftol": 1e-8},
        )
        for start in starts
    ]
    best = min(found, key=lambda result: result.fun)
    penalty = 0.5 * (kind.parameters - (likelihood.noise is not None)) * math.log(likelihood.size)
    return _Fit(kind, best.x, best.fun * likelihood.size + penalty)


def _extended(likelihood: _Likelihood, fit: _Fit) -> _Fit:
    """Return the fit with one more swing, begun where the errors of the fit so far swing most."""
    kind = Kind((*fit.kind.signal, "swing"), fit.kind.slow)
    error = likelihood.errors(fit.kind, fit.theta)
    sd, noise = float(np.std(error)), math.exp(fit.theta[0])
    power = np.abs(np.fft.rfft(error * np.hanning(error.size))) ** 2
    frequency = np.fft.rfftfreq(error.size)
    power[(frequency < 1 / likelihood.slowest) | (frequency > 0.499)] = 0
    starts = []
    for _ in range(_PEAKS):
        peak = frequency[np.argmax(power)]
        power[np.abs(frequency - peak) < _PEAK_WIDTH / error.size] = 0
        starts += [
            np.append(fit.theta, [math.log(sd), math.log(rate), _SHARP * math.log(peak)])
            for rate in (_LEAST_RATE / likelihood.size, 0.01, 0.3, 0.05 * sd / noise, 0.5 * sd / noise)
        ]
    best = max(starts, key=lambda theta: likelihood(kind, theta))
    return _fit(likelihood, kind, [best], _free(best.size, 0))


def _settled(likelihood: _Likelihood, fit: _Fit) -> _Fit:
    """Return the fit after a search over each swing in turn, the last first, until a round gains little.

    The time of a search over everything grows with the cube of the number of parts. Each in a band of its own moves
    little but itself and the noise, so that a few rounds do.
    """
    for _ in range(_ROUNDS):
        before = fit.criterion
        for part in range(len(fit.kind.signal)):
            fit = _fit(likelihood, fit.kind, [fit.theta], _free(fit.theta.size, part))
        if before - fit.criterion < 1.0:  # nat: a factor of e in how probable all readings are together
            break
    return fit


def _free(parameters: int, part: int) -> NDArray[np.int64]:
    """Return the numbers of the noise, its memory, and what belongs to the last swing, or one `part` before it."""
    first = parameters - 3 * (part + 1)
    return np.array([0, 4, first, first + 1, first + 2])


def _usable(block: Block) -> NDArray[np.bool_]:
    return np.asarray((block["status"] & NOT_A_VALUE == 0) & np.isfinite(block["value_V"]))


def _pieces(stretches: Sequence[Block]) -> Sequence[Block]:
    """Return pieces spread evenly over long stretches, or the stretches themselves."""
    longest = max(stretches, key=len)
    if sum(map(len, stretches)) <= 2 * _EXPLORED * _PIECE:
        return stretches
    starts = np.linspace(0, longest.size - _PIECE, _EXPLORED).astype(int)
    return [longest[start : start + _PIECE] for start in starts]
