"""What is hidden in which run: drawn from a salt that nobody knows before the key is opened.

35 % clean (a third of them provocative), 40 % one effect of the catalogue, 10 % two, 10 % one that the catalogue does
not have, 5 % one too small to be seen. Plant, length, rate, level, format, gaps and thermometer are drawn before, and
apart from, what is hidden, so that none of them tells of it.
"""

from dataclasses import dataclass, replace
from math import pi, sqrt

import numpy as np

from tests.blind.certificate import KINDS, clairvoyant_d95, d_nats, size_for
from tests.blind.plant import Effect, Plant, Run

__all__ = [
    "BELOW_D",
    "FACTORS",
    "OUTSIDE",
    "SINGLE",
    "Envelope",
    "draw_effect",
    "draw_envelope",
    "draw_ladder",
    "draw_plant",
]

FACTORS = (0.6, 0.8, 1.0, 1.25, 1.6)
"""Of the amplitude at which a clairvoyant detects in 95 %."""
LADDER = 1.25
LADDER_STREAM = 1 << 32  # apart from every envelope's number
BELOW_D = 1.5  # nats: nobody detects that at these levels

SINGLE = (
    "mains_alias",
    "periodic_interference",
    "wandering_line",
    "periodic_glitch",
    "resonance",
    "difference_noise",
    "smoothing",
    "popcorn_noise",
    "changing_noise",
    "signal_dependent_noise",
    "heavy_tails",
    "shock_law",
    "ring_down",
    "step",
    "thermal_drift",
    "warmup_drift",
    "supply_coupling",
    "latency",
    "range_switching",
    "nonlinearity",
    "dead_band",
    "reading_pattern",
    "quantisation",
    "saturation",
    "stuck_readings",
    "replayed_block",
    "missing_samples",
    "timestamp_jitter",
    "clock_error",
)
"""Hidden alone. Flicker noise, a random walk and a third Markov process are not among them: on records of these lengths
the refitted base absorbs them."""
OUTSIDE = ("ooc_packet", "ooc_bump", "ooc_echo", "ooc_gain_step", "ooc_saw", "ooc_sweep", "ooc_breath")
DOUBLE = ("periodic_interference", "difference_noise", "changing_noise", "quantisation", "reading_pattern", "resonance")


@dataclass(frozen=True)
class Envelope:
    """One line of the key."""

    number: int
    group: str
    """clean, provocative, single, double, outside, below, or ladder."""
    run: Run
    suffix: str
    d_nats: tuple[float, ...] = ()
    """Of each effect; NaN where it is counted."""
    factor: float = 0.0
    """Of the clairvoyant's amplitude; 0 where it is counted, or nothing is hidden."""


def draw_envelope(salt: str, number: int) -> Envelope:
    rng = np.random.default_rng([*salt.encode(), number])
    group = str(rng.choice(["clean", "single", "double", "outside", "below"], p=[0.35, 0.4, 0.1, 0.1, 0.05]))
    if group == "clean" and rng.random() < 1 / 3:
        group = "provocative"
    suffix = ".csv" if rng.random() < 0.5 else ".mcap"
    while True:  # until the plant that was drawn can carry what is to be hidden
        run = Run(draw_plant(rng, provocative=group == "provocative"), int(rng.integers(2**62)))
        if group in ("clean", "provocative"):
            return Envelope(number, group, run, suffix)
        factor = float(rng.choice(FACTORS))
        if group == "below":
            cause = str(rng.choice([name for name in SINGLE if KINDS[name] != "counted"]))
            factor, effects = 0.0, [draw_effect(rng, run, cause, BELOW_D)]
        elif group == "double":
            factor = 2.0
            effects = [draw_effect(rng, run, str(cause), factor) for cause in rng.choice(DOUBLE, 2, replace=False)]
        else:
            factor = 2.0 if group == "outside" else factor
            effects = [draw_effect(rng, run, str(rng.choice(OUTSIDE if group == "outside" else SINGLE)), factor)]
        hidden = [effect for effect in effects if effect is not None]
        if any(effect.cause == "clock_error" for effect in hidden):
            suffix = ".mcap"  # a table does not say how long its interval should be
        if len(hidden) == len(effects):
            d = tuple(d_nats(run, effect) for effect in hidden)
            counted = any(KINDS[effect.cause] == "counted" for effect in hidden)
            return Envelope(number, group, replace(run, effects=tuple(hidden)), suffix, d, 0.0 if counted else factor)


def draw_ladder(salt: str, number: int) -> Envelope:
    """Return an envelope with one effect at LADDER times the clairvoyant's amplitude, each mechanism in turn."""
    rng = np.random.default_rng([*salt.encode(), LADDER_STREAM, number])
    cause = SINGLE[number % len(SINGLE)]
    suffix = ".csv" if rng.random() < 0.5 and cause != "clock_error" else ".mcap"
    while True:
        run = Run(draw_plant(rng), int(rng.integers(2**62)))
        effect = draw_effect(rng, run, cause, LADDER)
        if effect is not None:
            d = (d_nats(run, effect),)
            factor = 0.0 if KINDS[cause] == "counted" else LADDER
            return Envelope(number, "ladder", replace(run, effects=(effect,)), suffix, d, factor)


def draw_plant(rng: np.random.Generator, *, provocative: bool = False) -> Plant:
    unit_V = 10 ** rng.uniform(-6, -2)
    drift_tau_s = 10 ** rng.uniform(1.5, 3.0)
    plant = Plant(
        n=int(rng.choice([1500, 3000, 6000, 9000])),
        interval_s=float(rng.choice([0.06712, 1 / 15, 0.1])),
        aperture_s=float(rng.choice([0.002, 0.01, 0.02])),
        signal_sd_V=unit_V,
        signal_tau_s=10 ** rng.uniform(-0.6, 0.3),
        drift_rate_V_per_rt_s=unit_V * 10 ** rng.uniform(-0.5, 0.5) * sqrt(2 / drift_tau_s),
        drift_tau_s=drift_tau_s,
        white_sd_V=unit_V * 10 ** rng.uniform(-0.6, 0.1),
        level_V=float(rng.uniform(-100, 100)) * unit_V,
        lost_fraction=float(rng.choice([0.0, 0.0, 0.0, 0.02])),
        witness=bool(rng.random() < 0.3),
    )
    if rng.random() < 0.5:
        plant = with_shocks(rng, plant, per_minute=float(rng.uniform(0.3, 3)), loud=float(rng.uniform(4, 12)))
    if provocative:
        plant = with_shocks(rng, plant, per_minute=6.0, loud=20.0)
        plant = replace(
            plant,
            n=int(rng.choice([500, 1000, 2000])),
            lost_fraction=0.05,
            signal_tau_s=float(rng.choice([0.1, 5.0])),
            white_sd_V=unit_V * float(rng.choice([0.1, 3.0])),
        )
    return plant


def with_shocks(rng: np.random.Generator, plant: Plant, per_minute: float, loud: float) -> Plant:
    decay_s = 10 ** rng.uniform(-1.3, 0)
    return replace(plant, shocks_per_s=per_minute / 60, shock_sd_V=loud * plant.signal_sd_V, shock_decay_s=decay_s)


def draw_effect(rng: np.random.Generator, run: Run, cause: str, factor: float) -> Effect | None:
    """Return an effect of `factor` times the clairvoyant's amplitude, or of BELOW_D nats where that is the factor.

    None where this plant cannot carry it: no shocks, no thermometer, or no size that reaches so far.
    """
    plant = run.plant
    if cause in ("ring_down", "shock_law") and plant.shocks_per_s * plant.n * plant.interval_s < 5:
        return None
    if cause in ("thermal_drift", "latency", "supply_coupling") and not plant.witness:
        return None
    shape = draw_shape(rng, plant, cause)
    if shape is None:
        return None
    unit_V = plant.signal_sd_V
    if KINDS[cause] == "counted":
        low, high = COUNTED[cause]
        size = 10 ** rng.uniform(np.log10(low), np.log10(high)) * (unit_V if cause in IN_VOLTS else 1.0)
        return Effect(cause, size, shape)
    d95 = clairvoyant_d95(cause, plant.n)
    target = BELOW_D if factor == BELOW_D else factor**2 * d95
    low, high = RANGES.get(cause, (1e-4 * unit_V, 1e3 * unit_V))
    if cause == "nonlinearity":
        low, high = 1e-4 / unit_V, 1 / unit_V
    if cause == "supply_coupling":
        low, high = 1e-4, 1e3
    return size_for(target, run, Effect(cause, 1.0, shape), low, high)


COUNTED = {
    "quantisation": (0.3, 2.0),
    "dead_band": (0.3, 1.0),
    "saturation": (0.005, 0.03),
    "stuck_readings": (4.0, 12.0),
    "replayed_block": (10.0, 100.0),
    "missing_samples": (0.005, 0.05),
    "timestamp_jitter": (0.003, 0.02),
    "clock_error": (200.0, 2000.0),
}
"""Ranges of sizes, from small but plain to large; those in IN_VOLTS in standard deviations of the signal."""
IN_VOLTS = ("quantisation", "dead_band")
RANGES = {
    "smoothing": (1e-3, 0.9),
    "changing_noise": (1.001, 10.0),
    "signal_dependent_noise": (1e-3, 3.0),
    "heavy_tails": (1e-3, 0.99),
    "shock_law": (1e-2, 0.9999),
    "ooc_echo": (1e-3, 0.9),
    "ooc_gain_step": (1e-3, 10.0),
    "ooc_breath": (1e-3, 2.0),
}


def draw_shape(rng: np.random.Generator, plant: Plant, cause: str) -> dict[str, float] | None:
    """Return the numbers besides the size; None where those drawn are of another cause, or of none."""
    rate_hz, span_s = 1 / plant.interval_s, plant.n * plant.interval_s
    phase = {"phase_rad": float(rng.uniform(0, 2 * pi))}
    middle = float(rng.uniform(0.3, 0.7))
    frequency_hz = float(rng.uniform(0.5, rate_hz / 2 - 0.3))
    folds = [abs(h * mains - rate_hz * round(h * mains / rate_hz)) for mains in (50.0, 60.0) for h in (1, 2, 3)]
    if cause == "mains_alias":
        mains_hz = float(rng.choice([50.0, 60.0])) + float(rng.normal(0, 0.01))
        alias_hz = abs(mains_hz - rate_hz * round(mains_hz / rate_hz))
        plain = 0.3 < alias_hz < rate_hz / 2 - 0.3
        passed = abs(np.sinc(mains_hz * plant.aperture_s)) > 0.05  # an aperture of whole cycles lets nothing through
        return {"frequency_hz": mains_hz, "alias_hz": alias_hz, **phase} if plain and passed else None
    if cause in ("periodic_interference", "wandering_line") and min(abs(frequency_hz - fold) for fold in folds) < 0.3:
        return None
    return {
        "periodic_interference": {"frequency_hz": frequency_hz, **phase},
        "wandering_line": {
            "frequency_hz": frequency_hz,
            "sweep_hz_per_s": float(rng.uniform(10, 40)) / span_s**2,
            **phase,
        },
        "ooc_packet": {"frequency_hz": frequency_hz, "time_s": span_s * middle, "width_s": span_s / 20, **phase},
        "ooc_echo": {"lag_readings": float(rng.integers(20, 60))},
        "ooc_gain_step": {"time_s": span_s * middle},
        "ooc_saw": {"time_s": span_s * middle, "width_s": float(rng.uniform(1, 5)), "teeth": float(rng.integers(4, 9))},
        "ooc_sweep": {"frequency_hz": rate_hz / 20, "time_s": span_s * middle, "width_s": span_s / 10},
        "ooc_breath": {"turns": float(rng.integers(2, 6))},
        "periodic_glitch": {
            "period_s": float(rng.uniform(5, 30)),
            "width_s": float(rng.uniform(0.1, 0.4)),
            "start_s": float(rng.uniform(0, 5)),
        },
        "resonance": {"frequency_hz": frequency_hz, "quality": float(rng.uniform(10, 60))},
        "popcorn_noise": {"dwell_s": float(rng.uniform(3, 20))},
        "changing_noise": {"begin": float(rng.uniform(0.2, 0.5)), "end": float(rng.uniform(0.7, 1.0))},
        "step": {"time_s": span_s * float(rng.uniform(0.1, 0.9))},
        "ooc_bump": {"time_s": span_s * middle, "width_s": float(rng.uniform(2, 10))},
        "warmup_drift": {"tau_s": span_s * float(rng.uniform(0.02, 0.2))},
        "ring_down": {"frequency_hz": float(rng.uniform(1, rate_hz / 2 - 0.5)), "decay_s": float(rng.uniform(0.5, 3))},
        "thermal_drift": {"lag_s": float(rng.uniform(1, 30))},
        "latency": {"lag_s": float(rng.uniform(5, 20))},
        "range_switching": {"part": float(rng.uniform(0.5, 0.9))},
        "reading_pattern": {"period_readings": float(rng.integers(2, 5))},
        "stuck_readings": {"place": float(rng.uniform(0.1, 0.9))},
        "replayed_block": {"place": float(rng.uniform(0.1, 0.9))},
    }.get(cause, {})
