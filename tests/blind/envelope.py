"""What is hidden in which run: drawn from a salt that nobody knows before the key is opened.

A mix has so many envelopes of each group: clean ones (a third of them provocative), each mechanism at 1.25 times the
amplitude of a clairvoyant and at other factors of it up to ten, two at once, one that the catalogue does not have, one
too small to be seen, and one large enough to measure what knowing it is worth. Plant, length, rate, level, format, gaps
and thermometer are drawn before, and apart from, what is hidden, so that none of them tells of it.
"""

from dataclasses import dataclass, replace
from math import exp, inf, log, pi, sqrt

import numpy as np

from tests.blind.certificate import KINDS, clairvoyant_d95, d_nats, size_for
from tests.blind.injector import make_record
from tests.blind.plant import Effect, Plant, Run, make_world, supply

__all__ = [
    "BELOW_D",
    "FACTORS",
    "LADDER",
    "OUTSIDE",
    "SINGLE",
    "STRONG",
    "Envelope",
    "Mix",
    "beside_each_other",
    "draw",
    "draw_effect",
    "draw_ladder",
    "draw_plant",
]

FACTORS = (0.6, 0.8, 1.0, 1.25, 1.6, 3.0, 10.0)
"""Of the amplitude at which a clairvoyant detects in 95 %."""
LADDER = 1.25
STRONG = 3.0
"""From this factor on an effect is strong: it should be found, and told from others, whatever the plant."""
PLANTS = 40
"""That are tried for a strong effect; if none carries it, it is the largest that one of them does."""
TURNS = 8
"""In which two effects are sized, each beside the other."""
LADDER_STREAM = 1 << 32  # apart from the streams of the other groups
LONG_SHARE = 0.15  # of the provocative plants; 20,000 to 100,000 readings are a day's work for a thousand of them
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
DOUBLE = ("periodic_interference", "resonance", "changing_noise", "difference_noise", "reading_pattern", "quantisation")
"""In the order in which they act, for which D of two holds: the noise that changes is the plant's alone, and the
quantiser is the last."""

UNCOUNTED = tuple(cause for cause in SINGLE if KINDS[cause] != "counted")
GAINFUL = (
    "mains_alias",
    "periodic_interference",
    "wandering_line",
    "reading_pattern",
    "resonance",
    "difference_noise",
    "changing_noise",
    "step",
    "warmup_drift",
)
"""Of which tests/blind/oracle.py knows what the truth is worth."""
GAIN_D = (60.0, 120.0)
STREAMS = {"clean": 1, "single": 2, "double": 3, "outside": 4, "below": 5, "gain": 6}


@dataclass(frozen=True)
class Envelope:
    """One line of the key."""

    number: int
    group: str
    """clean, provocative, ladder, single, double, outside, below, or gain."""
    run: Run
    suffix: str
    d_nats: tuple[float, ...] = ()
    """Of each effect, the others being known; NaN where it is counted."""
    factor: float = 0.0
    """Of the clairvoyant's amplitude; 0 where it is counted, or nothing is hidden, or it was sized by D alone.

    Of a strong effect what was reached, which may lie between FACTORS."""


@dataclass(frozen=True)
class Mix:
    """How many envelopes of each group."""

    clean: int = 120
    """A third of them provocative."""
    rungs: int = 4
    """Of each mechanism, at LADDER times the clairvoyant's amplitude."""
    singles: int = 42
    """Each mechanism that is not counted in turn, at the other factors in turn: 126 are all once."""
    doubles: int = 12
    outside: int = 14
    below: int = 10
    gains: int = 18

    def tickets(self) -> list[tuple[str, int]]:
        """Return the group and the number in it of every envelope."""
        counts = {
            "clean": self.clean,
            "ladder": self.rungs * len(SINGLE),
            "single": self.singles,
            "double": self.doubles,
            "outside": self.outside,
            "below": self.below,
            "gain": self.gains,
        }
        return [(group, number) for group, count in counts.items() for number in range(count)]


def draw(salt: str, ticket: tuple[str, int]) -> Envelope:
    """Return the envelope of one ticket of a mix; the same for the same salt and ticket."""
    group, number = ticket
    if group == "ladder":
        return draw_ladder(salt, number)
    rng = np.random.default_rng([*salt.encode(), STREAMS[group], number])
    suffix = ".csv" if rng.random() < 0.5 else ".mcap"
    if group == "clean":
        provocative = number % 3 == 2
        run = Run(draw_plant(rng, provocative=provocative), int(rng.integers(2**62)))
        return Envelope(number, "provocative" if provocative else "clean", run, suffix)
    if group == "double":
        two = sorted(map(str, rng.choice(DOUBLE, 2, replace=False)), key=DOUBLE.index)
        return hide(rng, number, group, suffix, tuple(two), 2.0)
    if group == "outside":
        return hide(rng, number, group, suffix, (OUTSIDE[number % len(OUTSIDE)],), 2.0)
    if group == "gain":
        d = exp(rng.uniform(log(GAIN_D[0]), log(GAIN_D[1])))
        return hide(rng, number, group, suffix, (GAINFUL[number % len(GAINFUL)],), 0.0, d)
    cause = UNCOUNTED[number % len(UNCOUNTED)]
    if group == "below":
        return hide(rng, number, group, suffix, (cause,), 0.0, BELOW_D)
    others = [factor for factor in FACTORS if factor != LADDER]
    factor = others[number // len(UNCOUNTED) % len(others)]
    if factor > LADDER:  # a law of shocks, of as few as there are, has no plant that carries it
        return hide_strong(rng, number, suffix, cause, factor)
    return hide(rng, number, group, suffix, (cause,), factor)


def hide(
    rng: np.random.Generator,
    number: int,
    group: str,
    suffix: str,
    causes: tuple[str, ...],
    factor: float,
    d_target: float = 0.0,
) -> Envelope:
    """Return an envelope with these effects of a factor of the clairvoyant's amplitude, or of `d_target` nats.

    Of two, each has that amplitude where the other is known.
    """
    while True:  # until the plant that was drawn can carry what is to be hidden
        plant = draw_plant(rng)
        if group == "gain":  # the oracle knows nothing of shocks
            plant = replace(plant, shocks_per_s=0.0)
        run = Run(plant, int(rng.integers(2**62)))
        hidden = tuple(effect for cause in causes if (effect := draw_effect(rng, run, cause, factor, d_target)))
        if len(hidden) == len(causes) > 1:
            hidden = beside_each_other(run, hidden, factor) or ()
        if len(hidden) == len(causes):
            d = tuple(d_nats(run, effect, beside=others(hidden, effect)) for effect in hidden)
            factor = 0.0 if any(KINDS[cause] == "counted" for cause in causes) else factor
            return Envelope(number, group, replace(run, effects=hidden), suffix, d, factor)


def others(effects: tuple[Effect, ...], effect: Effect) -> tuple[Effect, ...]:
    return tuple(other for other in effects if other is not effect)


def beside_each_other(run: Run, effects: tuple[Effect, ...], factor: float) -> tuple[Effect, ...] | None:
    """Return effects of sizes at which each has a factor of its clairvoyant's amplitude though the others are there.

    In turns, since a larger one makes others need to be larger; None where that finds no end.
    """
    for _ in range(TURNS):
        before = effects
        for effect in effects:
            if KINDS[effect.cause] == "counted":
                continue
            target = factor**2 * clairvoyant_d95(effect.cause, run.plant.n)
            sized = size_for(target, run, effect, *sizes(run, effect.cause), others(effects, effect))
            if sized is None:
                return None
            effects = tuple(sized if other is effect else other for other in effects)
        if all(abs(now.size / was.size - 1) < 0.01 for now, was in zip(effects, before, strict=True)):
            return effects
    return None


def hide_strong(rng: np.random.Generator, number: int, suffix: str, cause: str, factor: float) -> Envelope:
    """Return an envelope with one effect of a large factor of the clairvoyant's amplitude, or as large as may be."""
    carried: list[Envelope] = []
    tried = 0
    while tried < PLANTS or not carried:
        run = Run(draw_plant(rng), int(rng.integers(2**62)))
        effect = draw_effect(rng, run, cause, factor, largest=True)
        if effect is None:
            continue
        tried += 1
        d = d_nats(run, effect)
        if d <= 0:
            continue
        reached = sqrt(d / clairvoyant_d95(cause, run.plant.n))
        whole = reached > 0.97 * factor
        hidden = replace(run, effects=(effect,))
        carried.append(Envelope(number, "single", hidden, suffix, (d,), factor if whole else round(reached, 2)))
        if whole:
            break
    return max(carried, key=lambda envelope: envelope.factor)


def draw_ladder(salt: str, number: int) -> Envelope:
    """Return an envelope with one effect at LADDER times the clairvoyant's amplitude, each mechanism in turn."""
    rng = np.random.default_rng([*salt.encode(), LADDER_STREAM, number])
    cause = SINGLE[number % len(SINGLE)]
    # A table does not say how long its interval should be.
    suffix = ".csv" if rng.random() < 0.5 and cause != "clock_error" else ".mcap"
    return hide(rng, number, "ladder", suffix, (cause,), LADDER)


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
    return provoked(rng, plant) if provocative else plant


def provoked(rng: np.random.Generator, plant: Plant) -> Plant:
    """Return a plant that is still in the model but far from the usual: numbers ten times less or more, few readings
    or very many, gaps, and loud shocks one upon the other."""
    length = rng.random()
    if length < 0.6:
        plant = replace(plant, n=int(rng.integers(500, 1001)))
    elif length > 1 - LONG_SHARE:
        plant = replace(plant, n=round(10 ** rng.uniform(4.3, 5.0)))
    if rng.random() < 2 / 3:
        plant = with_shocks(rng, plant, per_minute=6.0, loud=20.0)
    if rng.random() < 2 / 3:
        plant = replace(plant, lost_fraction=0.05)
    tau, white, drift = rng.choice([0.1, 1.0, 10.0], 3)
    return replace(
        plant,
        signal_tau_s=float(tau * plant.signal_tau_s),
        white_sd_V=float(white * plant.white_sd_V),
        drift_rate_V_per_rt_s=float(drift * plant.drift_rate_V_per_rt_s),
    )


def with_shocks(rng: np.random.Generator, plant: Plant, per_minute: float, loud: float) -> Plant:
    decay_s = 10 ** rng.uniform(-1.3, 0)
    return replace(plant, shocks_per_s=per_minute / 60, shock_sd_V=loud * plant.signal_sd_V, shock_decay_s=decay_s)


def draw_effect(
    rng: np.random.Generator, run: Run, cause: str, factor: float, d_target: float = 0.0, *, largest: bool = False
) -> Effect | None:
    """Return an effect of `factor` times the clairvoyant's amplitude, or of `d_target` nats where that is given.

    None where this plant cannot carry it: no shocks, no thermometer, or no size that reaches so far; with `largest`,
    then the largest size.
    """
    plant = run.plant
    if cause in ("ring_down", "shock_law") and plant.shocks_per_s * plant.n * plant.interval_s < 5:
        return None
    if cause in ("thermal_drift", "latency", "supply_coupling") and not plant.witness:
        return None
    shape = draw_shape(rng, plant, cause)
    if shape is None:
        return None
    if KINDS[cause] == "counted":
        low, high = COUNTED[cause]
        size = 10 ** rng.uniform(np.log10(low), np.log10(high))
        return Effect(cause, size * (plant.signal_sd_V if cause in IN_VOLTS else 1.0), shape)
    target = d_target or factor**2 * clairvoyant_d95(cause, plant.n)
    low, high = sizes(run, cause)
    if largest:
        high = min(high, still_a_scale(run, cause))
    effect = Effect(cause, 1.0, shape)
    return size_for(target, run, effect, low, high) or (replace(effect, size=high) if largest else None)


def sizes(run: Run, cause: str) -> tuple[float, float]:
    """Return the range in which a size is sought."""
    unit_V = run.plant.signal_sd_V
    if cause == "nonlinearity":
        return 1e-4 / unit_V, 1 / unit_V
    if cause == "supply_coupling":
        return 1e-4, 1e3
    return RANGES.get(cause, (1e-4 * unit_V, 1e3 * unit_V))


def still_a_scale(run: Run, cause: str) -> float:
    """Return the size up to which what a meter shows still rises with what it reads, by a fifth of it or more."""
    if cause == "nonlinearity":
        value = make_record(replace(run, effects=())).value_V
        return float(0.4 / np.max(np.abs(value - value.mean())))
    if cause == "supply_coupling":
        return float(0.8 / np.max(np.abs(supply(make_world(run)) - 5)))
    return inf


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
    "ring_down": (1e-4, 10.0),
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
