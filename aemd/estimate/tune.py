"""Find the options of IMM in a stretch of readings, by maximum likelihood.

The likelihood is the estimator's own, one step ahead. It is maximised for each of a few kinds of model (is there a
signal, does it swing, is there a slow part, has it resonances), and the kind is chosen by Schwarz's criterion (BIC),
which asks of each further parameter that it raise the log-likelihood by half the logarithm of the number of readings.
Resonances are found by least squares; only how hard they are driven, beside the noises, is left to the likelihood.

Two things no likelihood can tell, so they are stated: the slowest signal, which parts the band of the input from that
of the drift; and the noise where the input moves by far more than it from reading to reading, since its share is then
lost in the scatter of the rest. It can be taken from a stretch at rest, see `noise_of`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from aemd.block import Block
from aemd.errors import ConfigError
from aemd.estimate.imm import ImmOptions
from aemd.estimate.likelihood import LEAST_RATE, SHARP, Kind, Likelihood, usable
from aemd.estimate.resonance import find_resonances

__all__ = ["Kind", "Tuning", "noise_of", "pieces_of", "tune", "values_of"]

Floats = NDArray[np.float64]

_LEAST_READINGS = 100  # fewer do not tell eight parameters apart
_LEAST_SPREAD_V = 1e-30  # the square of less may be 0
_EXPLORED = 4  # pieces of a long stretch on which the kinds are compared
_PIECE = 2_500  # readings of each; the best kind is then fitted to the whole stretch


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
    resonances: int = 0,
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
        resonances: most of them that an input which vibrates may have; 0: none are sought.

    Raises:
        ConfigError: too few readings with a value, or they are all equal.
    """
    together = values_of(stretches)
    origin = float(np.median(together)) if origin_V is None else origin_V
    pieces = pieces_of(stretches)
    slowest = 150.0 if slowest_signal_s is None else slowest_signal_s / interval_s
    slowest = min(slowest, 10.0 * sum(int(np.count_nonzero(usable(piece))) for piece in pieces))  # it is never seen
    found = find_resonances([_about(origin, piece) for piece in pieces], resonances) if resonances else None

    def likelihood_of(blocks: Sequence[Block]) -> Likelihood:
        return Likelihood(blocks, origin, noise_V, slowest, walk=slow == "input", resonances=found)

    whole = likelihood_of(stretches)
    explored = whole if pieces is stretches else likelihood_of(pieces)
    kinds = list(kinds or (kind for kind in _KINDS if kind.slow or slow == "disturbance"))
    if found is not None:
        kinds.append(Kind((), slow=True, order=found.order))
    tried = [_fit(explored, kind, _starts(explored, kind)) for kind in kinds]
    best = min(tried)
    if explored is not whole:
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
    rows = block[usable(block)]
    values, index = rows["value_V"], rows["index"]
    third = np.diff(values, 3)[index[3:] - index[:-3] == 3]
    if third.size < _LEAST_READINGS:
        raise ConfigError(f"{third.size} runs of four readings with a value: too few, at least {_LEAST_READINGS}")
    limit = 5 * float(np.median(np.abs(third))) / 0.6745  # of a Gaussian, the median is at 0.6745
    for _ in range(5):
        kept = third[np.abs(third) <= limit]
        limit = 5 * float(np.sqrt(np.mean(kept**2)))
    return float(np.sqrt(np.mean(kept**2) / 20))


def values_of(stretches: Sequence[Block]) -> Floats:
    """Return the readings with a value, V, of all stretches.

    Raises:
        ConfigError: they are too few to tune by, or all equal.
    """
    together = np.concatenate([np.empty(0), *(block["value_V"][usable(block)] for block in stretches)])
    if together.size < _LEAST_READINGS:
        raise ConfigError(f"{together.size} readings with a value: too few to tune by, at least {_LEAST_READINGS}")
    if np.ptp(together) < _LEAST_SPREAD_V:
        raise ConfigError(f"all {together.size} readings are {together[0]:g} V: nothing to tune by")
    return together


def pieces_of(stretches: Sequence[Block]) -> Sequence[Block]:
    """Return pieces spread evenly over long stretches, on which to explore, or the stretches themselves."""
    longest = max(stretches, key=len)
    if sum(map(len, stretches)) <= 2 * _EXPLORED * _PIECE:
        return stretches
    starts = np.linspace(0, longest.size - _PIECE, _EXPLORED).astype(int)
    return [longest[start : start + _PIECE] for start in starts]


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


def _starts(likelihood: Likelihood, kind: Kind) -> list[Floats]:
    """Return parameters to start the search from."""
    together = np.concatenate(likelihood.values)
    spread = 1.4826 * float(np.median(np.abs(together - np.median(together)))) + 1.0
    drift = float(
        np.median([np.median(np.abs(value[64:] - value[:-64])) for value in likelihood.values if value.size > 64])
    )
    rate = max(drift / 0.6745 / 8, 1e-3)  # of a random walk that goes so far in 64 readings
    loudest = _loudest(likelihood)
    starts = []
    for noise in (0.9, 0.2):
        start = [
            noise if likelihood.noise is None else likelihood.noise,
            10 * float(np.std(together)) + 1.0,
            100.0,
            5.0,
            10.0 * likelihood.size,
        ]
        if kind.slow:
            start += [rate, max(2 * (float(np.std(together)) / rate) ** 2, 1.0)]
        logarithms = [math.log(value) for value in start]
        if kind.order and likelihood.resonances is not None:  # one start: the rest is known but for its size
            error = likelihood.resonances.error_V / likelihood.unit_V
            logarithms[0], logarithms[5] = math.log(0.1 * error), math.log(1e-2 * error)
            return [np.array([*logarithms, 0.0])]
        for part in kind.signal:
            if part == "markov":
                logarithms += [math.log(spread / 3), math.log(10.0)]
            else:
                logarithms += [math.log(spread), math.log(LEAST_RATE / likelihood.size), SHARP * math.log(loudest)]
        starts.append(np.array(logarithms))
    return starts


def _loudest(likelihood: Likelihood) -> float:
    """Return the frequency at which the readings swing most, in cycles per reading, above the band of the slow part."""
    value = max(likelihood.values, key=len)
    middle = float(np.median(value))
    reach = 4 * 1.4826 * float(np.median(np.abs(value - middle))) + 1.0
    clipped = np.clip(value - middle, -reach, reach) * np.hanning(value.size)  # a shock has power at every frequency
    power = np.abs(np.fft.rfft(clipped, 4 * value.size)) ** 2
    frequency = np.fft.rfftfreq(4 * value.size)
    power[(frequency < 1 / likelihood.slowest) | (frequency > 0.499)] = 0
    return float(frequency[np.argmax(power)])


def _fit(likelihood: Likelihood, kind: Kind, starts: Sequence[Floats]) -> _Fit:
    """Return the parameters of greatest likelihood."""
    bounds = likelihood.bounds(kind)
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


def _about(origin_V: float, block: Block) -> tuple[NDArray[np.int64], Floats]:
    """Return the numbers of the readings with a value, and how far each is from the origin."""
    rows = block[usable(block)]
    return rows["index"], rows["value_V"] - origin_V
