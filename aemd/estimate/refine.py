"""Refine the numbers of an IMM that is given, by its likelihood on a stretch of readings; what it consists of is kept.

The likelihood is that of the options as they stand, one step ahead. From them a search goes uphill, so what it finds is
the nearest summit. No part may become another: time constants of first-order processes, and frequencies, stay on their
side of the geometric mean with their neighbour's, so what was slower stays slower, and the input stays the input.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from aemd.block import ESTIMATE, Block
from aemd.estimate.compiled import choose
from aemd.estimate.imm import ImmOptions, imm_model
from aemd.estimate.imm_kernels import run_imm, start_imm
from aemd.estimate.kalman import columns_of
from aemd.estimate.likelihood import LEAST_RATE, SHARP, usable
from aemd.estimate.tune import pieces_of, values_of

__all__ = ["Refined", "log_likelihood", "refine"]

Floats = NDArray[np.float64]

_DRASTIC = 5.0  # noises that an abrupt disturbance has at least, unless the given one has less
_RETUNED = 1.2  # most factor of a frequency
_CLIMBS = 5  # on a ridge a search may stop short; begun again it has forgotten what shape the ridge seemed to have
_GATE = ImmOptions().gate  # in the search: what a narrow one puts aside is worth 0, which may beat what is unlikely


@dataclass(frozen=True, slots=True)
class Refined:
    """What a given model became."""

    options: ImmOptions
    readings: int
    """Readings with a value that it was refined by."""
    log_likelihood: float
    """Per reading, one step ahead, natural logarithm of a density in 1/V."""
    given: float
    """The same of the options that the search began with; never more."""


def refine(
    stretches: Sequence[Block], interval_s: float, given: ImmOptions, *, noise_V: float | None = None
) -> Refined:
    """Return the options of greatest likelihood near those given.

    Variances, times and frequencies are sought, and the origin where there is one. Parts that one noise drives together
    cancel between resonances, so only its size is. Lag, gate and what to do after holes are no matter of likelihood.

    Args:
        stretches: readings, one array of READING or several that are independent of each other.
        interval_s: between readings, s.
        given: where the search begins.
        noise_V: standard deviation of the white noise where it is known, V, in the place of the given one.

    Raises:
        ConfigError: too few readings with a value, they are all equal, or a frequency is above half the reading rate.
    """
    values = values_of(stretches)
    start = given if noise_V is None else replace(given, noise_V=noise_V)
    imm_model(start, interval_s)
    pieces = pieces_of(stretches)
    space = _Space(start, interval_s, values, noise_known=noise_V is not None)
    found = [np.zeros(len(space.bounds)), space.centred(float(np.median(values)))]
    scores = [log_likelihood(stretches, interval_s, space.options(theta)) for theta in found]
    if pieces is not stretches:  # few readings lead near
        found.append(_climb(space, pieces, interval_s, found[int(np.argmax(scores))]))
        scores.append(log_likelihood(stretches, interval_s, space.options(found[-1])))
    for _ in range(_CLIMBS):
        before = max(scores)
        found.append(_climb(space, stretches, interval_s, found[int(np.argmax(scores))]))
        scores.append(log_likelihood(stretches, interval_s, space.options(found[-1])))
        if scores[-1] < before + max(0.1, 1e-6 * values.size):
            break
    best = int(np.argmax(scores))
    options = start if best == 0 else space.options(found[best])
    return Refined(options, values.size, scores[best] / values.size, scores[0] / values.size)


def log_likelihood(stretches: Sequence[Block], interval_s: float, options: ImmOptions) -> float:
    """Return that of all stretches, each from its own start; -inf where a number overflows. Natural, density in 1/V.

    Raises:
        ConfigError: the interval cannot be, or a frequency is above half the reading rate.
    """
    model = imm_model(replace(options, gate=_GATE), interval_s)
    total = 0.0
    for block in stretches:
        index, value_V, status = columns_of(block)
        out = np.empty(block.size, ESTIMATE)
        run = choose(run_imm, block.size, few=0)
        ready = run(
            (0,) * model.cos.size, start_imm(model, 0), model, index, block["t_ns"].copy(), value_V, status, out
        )
        total += float(out["log_likelihood"][:ready].sum())
    return total if math.isfinite(total) else -math.inf


class _Space:
    """The free numbers of some options, as logarithms of the factor by which each is changed: 0 is as given.

    In the order noise, abrupt disturbance in noises, times quiet and disturbed, memory, rate and time of the slow part,
    then of the parts, and the origin, which alone is no logarithm: it is moved by standard deviations of the readings.
    A first-order process has its rate (the root of its variance per reading) beside its time, since short stretches
    tell the one and not the other; a part that swings has its standard deviation, its rate in noises (LEAST_RATE says
    why) and its frequency. What may not change has bounds of 0.
    """

    def __init__(self, given: ImmOptions, interval_s: float, values: Floats, *, noise_known: bool) -> None:
        self.given = given
        self._spread_V = float(np.std(values))
        span_s = values.size * interval_s
        unit_V = max(float(np.median(np.abs(np.diff(values)))), 1e-6 * self._spread_V, 1e-30)
        volts, times_s = (1e-4 * unit_V, 100 * float(np.ptp(values))), (0.15 * interval_s, 100 * span_s)
        fixed = (0.0, 0.0)
        disturbed = given.disturbed_V / given.noise_V
        self.bounds = [
            fixed if noise_known else _factors(given.noise_V, *volts),
            _factors(disturbed, _DRASTIC, max(volts[1] / given.noise_V, 100.0)),
            _factors(given.quiet_s, 2 * interval_s, times_s[1]),
            _factors(given.disturbed_s, *times_s),
            _factors(given.variance_memory_s, 50 * interval_s, span_s)
            if math.isfinite(given.variance_memory_s)
            else fixed,
        ]
        parts = list(zip(given.signal_V, given.signal_tau_s, given.signal_hz, strict=True))
        memories_s = [given.slow_tau_s, *(tau_s for _, tau_s, hz in parts if hz == 0)]
        tones_hz = [hz for _, _, hz in parts if hz > 0]

        def process(sd_V: float, tau_s: float) -> Iterator[tuple[float, float]]:
            yield _factors(sd_V * math.sqrt(2 * interval_s / tau_s), *volts)
            yield _factors(tau_s, *_between(tau_s, memories_s, *times_s))

        self.bounds += process(given.slow_V, given.slow_tau_s)
        for sd_V, tau_s, hz in parts:
            if given.drive_V:
                break
            if hz == 0:
                self.bounds += process(sd_V, tau_s)
                continue
            low, high = _between(hz, tones_hz, hz / _RETUNED, min(hz * _RETUNED, 0.5 / interval_s))
            rate = sd_V * math.sqrt(2 * interval_s / tau_s) / given.noise_V
            self.bounds += [_factors(sd_V, *volts), _factors(rate, LEAST_RATE / values.size, 1e5)]
            self.bounds.append((SHARP * math.log(min(low / hz, 1.0)), SHARP * math.log(max(high / hz, 1.0))))
        if given.drive_V:
            self.bounds.append(_factors(max(given.drive_V), *volts))
        reach = 0.0 if given.origin_V is None else float(np.abs(values - given.origin_V).max()) / self._spread_V
        self.bounds.append((-reach, reach))

    def centred(self, middle_V: float) -> Floats:
        """Return the given numbers with another origin: of a model from elsewhere, it may be volts away."""
        theta = np.zeros(len(self.bounds))
        if self.given.origin_V is not None:
            theta[-1] = (middle_V - self.given.origin_V) / self._spread_V
        return theta

    def options(self, theta: Floats) -> ImmOptions:
        """Return the options at a place."""
        given, numbers = self.given, iter(theta[:-1].tolist())
        noise, disturbed, quiet, lasting, memory, slow_rate, slow_tau = (math.exp(next(numbers)) for _ in range(7))
        signal_V, signal_tau_s, signal_hz = list(given.signal_V), list(given.signal_tau_s), list(given.signal_hz)
        for i in range(0 if given.drive_V else len(signal_V)):
            size, second = math.exp(next(numbers)), math.exp(next(numbers))
            if given.signal_hz[i] == 0:
                signal_V[i] *= size * math.sqrt(second)
                signal_tau_s[i] *= second
                continue
            signal_V[i] *= size
            least_s = min(signal_tau_s[i], 0.5 / (math.pi * signal_hz[i]))  # what forgets sooner does not swing
            signal_tau_s[i] = max(signal_tau_s[i] * (size / (second * noise)) ** 2, least_s)
            signal_hz[i] *= math.exp(next(numbers) / SHARP)
        drive = math.exp(next(numbers)) if given.drive_V else 1.0
        return replace(
            given,
            signal_V=tuple(signal_V),
            signal_tau_s=tuple(signal_tau_s),
            signal_hz=tuple(signal_hz),
            drive_V=tuple(drive * part_V for part_V in given.drive_V),
            slow_V=given.slow_V * slow_rate * math.sqrt(slow_tau),
            slow_tau_s=given.slow_tau_s * slow_tau,
            origin_V=None if given.origin_V is None else given.origin_V + self._spread_V * float(theta[-1]),
            noise_V=given.noise_V * noise,
            disturbed_V=given.disturbed_V * noise * disturbed,
            quiet_s=given.quiet_s * quiet,
            disturbed_s=given.disturbed_s * lasting,
            variance_memory_s=given.variance_memory_s * memory,
        )


def _climb(space: _Space, blocks: Sequence[Block], interval_s: float, start: Floats) -> Floats:
    """Return where the search from a place ends."""
    size = sum(int(np.count_nonzero(usable(block))) for block in blocks)

    def unlikely(theta: Floats) -> float:
        """Return minus the log-likelihood per reading: the search's tolerances are made for numbers near 1."""
        value = -log_likelihood(blocks, interval_s, space.options(theta)) / size
        return value if math.isfinite(value) else 1e6

    found = minimize(unlikely, start, method="L-BFGS-B", bounds=space.bounds, options={"maxfun": 3000, "ftol": 1e-8})
    return np.asarray(found.x)


def _factors(value: float, least: float, most: float) -> tuple[float, float]:
    """Return the logarithms of the factors that keep a value between two, or where it is if it is beyond them."""
    return math.log(min(least / value, 1.0)), math.log(max(most / value, 1.0))


def _between(value: float, others: Sequence[float], least: float, most: float) -> tuple[float, float]:
    """Return the bounds of a value that shall not come nearer to a neighbour than half way, by their logarithms."""
    if others.count(value) > 1:
        return value, value
    below, above = [other for other in others if other < value], [other for other in others if other > value]
    low = max([least, *(math.sqrt(value * other) for other in below)])
    return low, min([most, *(math.sqrt(value * other) for other in above)])
