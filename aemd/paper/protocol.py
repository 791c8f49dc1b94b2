"""The paper's two tests, and a third, as seeded records of which the truth is known.

The paper (Shen et al., Micromachines 10(5), 294, 2019) states: 15 readings/s; for the static test three groups of
shocks, 0.18, 0.20 and 0.22 mm (Table 2), and a slow fluctuation; for the dynamic test a sine of 2 mV and 0.2 Hz, white
noise of 0.11 mV peak to peak, impulses within +-60 mV and two square waves of 1.7 and 2.2 mm (Table 4). It leaves open
what a millimetre is in millivolts, how large the slow fluctuation is, how many impulses there are, and when.

One rule fills this in, stated before any other row was looked at: **the scale of the disturbances is such that the
Kalman filter's variance is the paper's**, 0.212 mV^2 in Table 3 and 35.5 mV^2 in Table 5, in the mean over the first
200 seeds (see `disturbance_scales`). All other rows are then predictions. What it does not reach is chosen plainly:

    records         1,000 readings, each the mean over an aperture of 20 ms: 1 power line cycle at 50 Hz, the meter's
                    default
    noise           0.11 mV peak to peak is 6.6 standard deviations, the usual convention (999 in 1,000 readings lie
                    within): 16.7 uV; the same in all tests, since it is the same sensor and meter
    static test     the input is 0 V; shocks and slow fluctuation have equal shares in the Kalman filter's variance
    shocks          one reading each, of random sign, in proportion to Table 2's displacements, its cycle times apart
    slow            five harmonics of the record, of random amplitude (falling as 1/n, like a random walk's) and phase:
                    nothing above 0.075 Hz
    impulses        as many as Table 2 has shocks, 11; one reading each, uniform within +-60 mV
    square waves    Table 4's frequencies and durations, once each, at random instants; exact means over the aperture,
                    so 77 and 18 Hz fold onto 2 and 3 Hz, as they do in the meter
    third test      the dynamic one, with a first-order Markov process (eq. 2) of variance 2 mV^2 and time constant 1 s
                    in place of the sine
    probe           the static one, with a sine of 0.2 mV and 0.2 Hz added: what of a small signal is left?
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal, get_args

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from aemd.block import Block, make_block
from aemd.estimate import make_estimator
from aemd.model import GaussMarkov, Sine, SquareBurst, WhiteNoise

__all__ = [
    "CONDITIONS",
    "INTERVAL_S",
    "NOISE_V",
    "READINGS",
    "SHOCK_GROUPS",
    "SIGNAL_HZ",
    "SQUARE_WAVES",
    "Condition",
    "Record",
    "Scales",
    "disturbance_scales",
    "make_record",
]

Floats = NDArray[np.float64]

Condition = Literal["static", "dynamic", "broadband", "probe"]
CONDITIONS: tuple[Condition, ...] = get_args(Condition)

READINGS = 1000
INTERVAL_S = 1 / 15
APERTURE_S = 0.020
NOISE_V = 0.11e-3 / 6.6
SIGNAL_V, SIGNAL_HZ = 2e-3, 0.2
PROBE_V = 0.2e-3
MARKOV_SD_V, MARKOV_TAU_S = 2**0.5 * 1e-3, 1.0
IMPULSES, IMPULSE_LIMIT_V = 11, 60e-3
SLOW_HARMONICS = 5
_START_S: Floats = INTERVAL_S * np.arange(READINGS, dtype=np.float64)  # of the apertures
KALMAN_STATIC_V2, KALMAN_DYNAMIC_V2 = 0.212e-6, 35.5e-6  # Tables 3 and 5, first row
CALIBRATION_RECORDS = 200  # the seeds that a run has unless told otherwise, so its first row is the paper's


@dataclass(frozen=True, slots=True)
class ShockGroup:
    """A row of Table 2."""

    displacement_mm: float
    shocks: int
    cycle_s: float


@dataclass(frozen=True, slots=True)
class SquareWave:
    """A row of Table 4."""

    amplitude_mm: float
    frequency_hz: float
    duration_s: float


SHOCK_GROUPS = (ShockGroup(0.18, 2, 1.0), ShockGroup(0.20, 1, 0.0), ShockGroup(0.22, 8, 0.3))
SQUARE_WAVES = (SquareWave(1.7, 77.0, 4.5), SquareWave(2.2, 18.0, 1.6))


@dataclass(frozen=True, slots=True)
class Scales:
    """What the rule finds."""

    shock_V_per_mm: float
    slow_V: float
    """Standard deviation of the slow fluctuation, V."""
    square_V_per_mm: float


@dataclass(frozen=True, slots=True)
class Record:
    """One run of a test: the readings, and what they are made of. All of shape (READINGS,)."""

    block: Block
    truth_V: Floats
    """The input s, V."""
    slow_V: Floats
    """u_in, V."""
    abrupt_V: Floats
    """u_ex, V."""
    disturbed: NDArray[np.bool_]
    """Whether the reading is under an abrupt disturbance, however little of it the reading may show."""
    abrupt_variance_V2: Floats
    """Mean square of the disturbance that the reading is under: what the oracle is told. V^2."""


@dataclass(frozen=True, slots=True)
class _Abrupt:
    """Abrupt disturbances: the part that the scale multiplies, in mm, and the part that is known in volts."""

    scaled: Floats
    fixed_V: Floats
    scaled_square: Floats
    """Mean square of the scaled part over its burst, for each reading."""
    fixed_square_V2: Floats
    disturbed: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class _Parts:
    """What a record is made of before the disturbances are scaled."""

    noise_V: Floats
    truth_V: Floats
    slow: Floats
    """Of unit variance in the mean over records, or 0."""
    abrupt: _Abrupt


def make_record(condition: Condition, seed: int) -> Record:
    """Return the record of a test and a seed. Tests share no random numbers, but `probe` is `static` with its probe."""
    parts, scales = _parts(condition, seed), disturbance_scales()
    scale = scales.square_V_per_mm if condition in {"dynamic", "broadband"} else scales.shock_V_per_mm
    slow_V = scales.slow_V * parts.slow
    abrupt_V = scale * parts.abrupt.scaled + parts.abrupt.fixed_V
    return Record(
        block=make_block(parts.truth_V + slow_V + abrupt_V + parts.noise_V, interval_ns=INTERVAL_S * 1e9),
        truth_V=parts.truth_V,
        slow_V=slow_V,
        abrupt_V=abrupt_V,
        disturbed=parts.abrupt.disturbed,
        abrupt_variance_V2=scale**2 * parts.abrupt.scaled_square + parts.abrupt.fixed_square_V2,
    )


@cache
def disturbance_scales() -> Scales:
    """Return the scales that give the Kalman filter the paper's variances, in the mean over the first 200 records.

    Its gains do not depend on the readings, so it is linear: what it makes of a record is the sum of what it makes of
    the parts, and the variance of that is a quadratic in their scales.
    """
    known, shocks, slow = _filtered("static", lambda p: (p.noise_V, p.abrupt.scaled, p.slow))
    share_V = _scale(known, shocks / _rms(shocks) + slow / _rms(slow), KALMAN_STATIC_V2)
    others, squares = _filtered("dynamic", lambda p: (p.noise_V + p.truth_V + p.abrupt.fixed_V, p.abrupt.scaled))
    return Scales(
        shock_V_per_mm=share_V / _rms(shocks),
        slow_V=share_V / _rms(slow),
        square_V_per_mm=_scale(others, squares, KALMAN_DYNAMIC_V2),
    )


def _filtered(condition: Condition, choose: Callable[[_Parts], tuple[Floats, ...]]) -> Floats:
    """Return what the Kalman filter makes of some parts, each about its mean, shape (parts, records, READINGS)."""
    rows = []
    for seed in range(CALIBRATION_RECORDS):
        for part in choose(_parts(condition, seed)):
            value = make_estimator("kalman", {}, INTERVAL_S).push(make_block(part))["value_V"]
            rows.append(value - value.mean())
    filtered = np.array(rows)
    return np.swapaxes(filtered.reshape(CALIBRATION_RECORDS, -1, READINGS), 0, 1)


def _rms(value: Floats) -> float:
    return float(np.sqrt(np.mean(value**2)))


def _scale(known: Floats, part: Floats, variance_V2: float) -> float:
    """Return a > 0 of mean((known + a part)^2) = variance."""
    square, cross, rest = np.mean(part**2), np.mean(known * part), np.mean(known**2) - variance_V2
    return float((-cross + np.sqrt(cross**2 - square * rest)) / square)


def _parts(condition: Condition, seed: int) -> _Parts:
    family = "static" if condition == "probe" else condition
    rng = np.random.default_rng([CONDITIONS.index(family), seed])
    noise_V = WhiteNoise.from_sd(NOISE_V, APERTURE_S).realise(rng).average(_START_S, APERTURE_S)
    abrupt, slow = (_shocks(rng), _slow(rng)) if family == "static" else (_bursts(rng), np.zeros(READINGS))
    return _Parts(noise_V, _input(condition, rng), slow, abrupt)


def _input(condition: Condition, rng: Generator) -> Floats:
    """Return the input s, V."""
    if condition == "broadband":
        process = GaussMarkov.from_sd(MARKOV_SD_V, MARKOV_TAU_S)
        return process.realise(rng).average(_START_S, APERTURE_S)
    amplitude_V = {"dynamic": SIGNAL_V, "probe": PROBE_V}.get(condition, 0.0)
    sine = Sine(amplitude_V=amplitude_V, frequency_hz=SIGNAL_HZ, phase_rad=rng.uniform(0, 2 * np.pi))
    return sine.realise(rng).average(_START_S, APERTURE_S)


def _slow(rng: Generator) -> Floats:
    """Return the slow fluctuation, of unit variance in the mean over records."""
    order = np.arange(1, SLOW_HARMONICS + 1)
    cosine, sine = rng.standard_normal((2, SLOW_HARMONICS)) / order
    angle = 2 * np.pi * np.outer(np.arange(READINGS) / READINGS, order)
    return np.asarray((np.cos(angle) @ cosine + np.sin(angle) @ sine) / np.sqrt(np.sum(1 / order**2)))


def _shocks(rng: Generator) -> _Abrupt:
    """Return Table 2's shocks, in mm: groups at random instants, which do not share a reading."""
    height = np.zeros(READINGS)
    for group in SHOCK_GROUPS:
        offset_s = np.arange(group.shocks) * group.cycle_s
        while True:
            first_s = rng.uniform(0, (READINGS - 1) * INTERVAL_S - offset_s[-1])
            at = np.rint((first_s + offset_s) / INTERVAL_S).astype(int)
            if not height[at].any():
                break
        height[at] = group.displacement_mm * rng.choice([-1.0, 1.0], group.shocks)
    return _Abrupt(height, np.zeros(READINGS), height**2, np.zeros(READINGS), height != 0)


def _bursts(rng: Generator) -> _Abrupt:
    """Return Table 4's square waves, in mm, and the impulses, in V: none in the same reading as another."""
    scaled, square = np.zeros(READINGS), np.zeros(READINGS)
    disturbed = np.zeros(READINGS, dtype=bool)
    for wave in SQUARE_WAVES:
        while True:
            first_s = rng.uniform(0, READINGS * INTERVAL_S - wave.duration_s)
            seen = (first_s < _START_S + APERTURE_S) & (first_s + wave.duration_s > _START_S)
            if not (disturbed & seen).any():
                break
        burst = SquareBurst(
            amplitude_V=wave.amplitude_mm, frequency_hz=wave.frequency_hz, start_s=first_s, duration_s=wave.duration_s
        )
        mean = burst.realise(rng).average(_START_S, APERTURE_S)
        scaled += mean
        square[seen] = np.mean(mean[seen] ** 2)
        disturbed |= seen
    impulse_V, impulse_square_V2 = np.zeros(READINGS), np.zeros(READINGS)
    at = rng.choice(np.flatnonzero(~disturbed), IMPULSES, replace=False)
    impulse_V[at] = rng.uniform(-IMPULSE_LIMIT_V, IMPULSE_LIMIT_V, IMPULSES)
    impulse_square_V2[at] = IMPULSE_LIMIT_V**2 / 3
    disturbed[at] = True
    return _Abrupt(scaled, impulse_V, square, impulse_square_V2, disturbed)
