"""Records made by formula, for the critic's tests: nothing of aemd makes them."""

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from aemd.diagnose.series import Series

Floats = NDArray[np.float64]

INTERVAL_S = 1 / 14.9
N = 4_000


def markov(rng: np.random.Generator, n: int, tau_s: float, sd: float, interval_s: float = INTERVAL_S) -> Floats:
    """A sampled first-order process: x_k = phi x_{k-1} + sd sqrt(1 - phi^2) e_k."""
    phi = np.exp(-interval_s / tau_s)
    drive = sd * np.sqrt(1 - phi**2) * rng.standard_normal(n)
    drive[0] = sd * rng.standard_normal()
    return np.asarray(lfilter([1], [1, -phi], drive))


def clean(
    seed: int,
    n: int = N,
    *,
    shocks_per_s: float = 0.0,
    shock_sd: float = 8.0,
    decay_s: float = 0.3,
    white: float = 0.5,
) -> Floats:
    """A record of the base model, in mV about 1 V, as volts: tau 0.5 s and 60 s, sd 1 each, white noise 0.5."""
    rng = np.random.default_rng(seed)
    y = markov(rng, n, 0.5, 1.0) + markov(rng, n, 60.0, 1.0) + white * rng.standard_normal(n)
    if shocks_per_s:
        jumps = (rng.random(n) < shocks_per_s * INTERVAL_S) * shock_sd * rng.standard_normal(n)
        y += lfilter([1], [1, -np.exp(-INTERVAL_S / decay_s)], jumps)
    return np.asarray(1.0 + 1e-3 * y)


def times(n: int = N) -> Floats:
    """Seconds of the readings."""
    return np.arange(n) * INTERVAL_S


def series(value_V: Floats, **changed: object) -> Series:
    """A numbered, gapless record of these values."""
    n = value_V.size
    made: dict[str, object] = {
        "path": "made",
        "time_s": times(n),
        "value_V": value_V,
        "index": np.arange(n),
        "status": np.zeros(n, np.uint32),
        "interval_s": INTERVAL_S,
        "nominal_interval_s": INTERVAL_S,
        "numbered": True,
    }
    return Series(**(made | changed))  # type: ignore[arg-type]


def innovation_variance(tau_s: float = 0.5, white: float = 0.5) -> float:
    """One-step prediction variance of the record, mV^2: the drift barely moves; Riccati for signal plus noise."""
    phi = np.exp(-INTERVAL_S / tau_s)
    p = 1.0
    for _ in range(1000):
        p = phi**2 * (p - p**2 / (p + white**2)) + 1 - phi**2
    return float(p + white**2)


def sine_nats(amplitude_mV: float, frequency_hz: float, n: int = N) -> float:
    """D = A^2 n / (4 S(f)) of a sine in the record's noise, S the spectrum per reading, mV^2."""
    w = 2 * np.pi * frequency_hz * INTERVAL_S
    spectrum = 0.25
    for tau_s in (0.5, 60.0):
        phi = np.exp(-INTERVAL_S / tau_s)
        spectrum += (1 - phi**2) / (1 - 2 * phi * np.cos(w) + phi**2)
    return float(amplitude_mV**2 * n / (4 * spectrum))
