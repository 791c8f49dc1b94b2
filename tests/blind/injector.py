"""Makes readings with an effect hidden in them, by another road than the package's own model: numpy and nothing else.

Everything at the input is a history on a grid of a millisecond or less; readings are plain means of the grid's points
within each aperture, so folding, smearing and cut edges come about by themselves and not by a formula. Chance draws
from one stream for each part, so that the twin of a run without its effect has the same noise.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import ceil, exp, pi, sqrt

import numpy as np

from tests.blind.plant import (
    FORGOTTEN,
    Effect,
    Record,
    Run,
    World,
    add_shock,
    lose,
    make_world,
    markov,
    supply,
    thermometer,
)

__all__ = ["AFTERWARDS", "AT_INPUT", "NOISE", "calm", "make_record", "template"]


def make_record(run: Run) -> Record:
    plant = run.plant
    world = make_world(run)
    fine = plant.level_V + markov(
        world.rng("signal"),
        world.t.size,
        plant.step_s,
        plant.signal_tau_s,
        plant.signal_sd_V * sqrt(2 / plant.signal_tau_s),
    )
    fine += markov(world.rng("drift"), world.t.size, plant.step_s, plant.drift_tau_s, plant.drift_rate_V_per_rt_s)
    for time_s, amplitude_V in world.shocks:
        add_shock(world, fine, time_s, amplitude_V)
    for effect in run.effects:
        if effect.cause in AT_INPUT:
            fine += effect.size * AT_INPUT[effect.cause](world, effect.shape)
    value = world.read(fine)
    beside = {"temperature": thermometer(world), "supply": supply(world)} if plant.witness else {}
    white = plant.white_sd_V * world.rng("white").standard_normal(plant.n)
    for effect in run.effects:
        if effect.cause in NOISE:
            white = NOISE[effect.cause](world, effect, white, value)
    value = value + white
    record = Record(
        np.arange(plant.n),
        np.arange(plant.n) * plant.interval_s + plant.aperture_s / 2,
        value,
        {name: (np.arange(plant.n) * plant.interval_s, column) for name, column in beside.items()},
    )
    for effect in run.effects:
        if effect.cause in AFTERWARDS:
            record = AFTERWARDS[effect.cause](world, effect, record)
    return lose(record, world.rng("lost").random(record.index.size) < plant.lost_fraction)


def calm(run: Run) -> np.ndarray:
    """Return the readings of the twin without effects, losses and shocks."""
    return make_record(replace(run, effects=(), plant=replace(run.plant, lost_fraction=0.0, shocks_per_s=0.0))).value_V


def template(run: Run, effect: Effect) -> np.ndarray:
    """Return what one unit of an effect at the input adds to the readings, V, shape (n,)."""
    world = make_world(run)
    return world.read(AT_INPUT[effect.cause](world, effect.shape))


# --- at the input: a history on the grid, V, for a size of 1 ---------------------------------------------------------


def sine(world: World, shape: Mapping[str, float]) -> np.ndarray:
    return np.sin(2 * pi * shape["frequency_hz"] * world.t + shape["phase_rad"])


def chirp(world: World, shape: Mapping[str, float]) -> np.ndarray:
    return np.sin(
        2 * pi * (shape["frequency_hz"] + shape["sweep_hz_per_s"] * world.t / 2) * world.t + shape["phase_rad"]
    )


def packet(world: World, shape: Mapping[str, float]) -> np.ndarray:
    """Outside the catalogue: an oscillation that swells and dies once."""
    return sine(world, shape) * bump(world, shape)


def sawtooth_burst(world: World, shape: Mapping[str, float]) -> np.ndarray:
    """Outside the catalogue: some teeth of a saw, each a ramp and a fall, then silence again."""
    since = (world.t - shape["time_s"]) / shape["width_s"]
    return np.where((since >= 0) & (since < shape["teeth"]), since % 1.0 - 0.5, 0.0)


def sweep_once(world: World, shape: Mapping[str, float]) -> np.ndarray:
    """Outside the catalogue: a tone that runs through the band once, its pitch doubling in even times, and stops."""
    since = np.clip((world.t - shape["time_s"]) / shape["width_s"], 0.0, 1.0)
    octaves = np.log(2.0) * 3.0
    angle = 2 * pi * shape["frequency_hz"] * shape["width_s"] * np.expm1(octaves * since) / octaves
    return np.where((since > 0) & (since < 1), np.sin(angle), 0.0)


def glitch(world: World, shape: Mapping[str, float]) -> np.ndarray:
    return np.where((world.t - shape["start_s"]) % shape["period_s"] < shape["width_s"], 1.0, 0.0)


def resonance(world: World, shape: Mapping[str, float]) -> np.ndarray:
    """Unit variance: a turning Markov process of the bandwidth f/Q, near an oscillator's history for Q >> 1."""
    decay_s = shape["quality"] / (pi * shape["frequency_hz"])
    return markov(
        world.rng("resonance"), world.t.size, world.plant.step_s, decay_s, sqrt(2 / decay_s), shape["frequency_hz"]
    )


def popcorn(world: World, shape: Mapping[str, float]) -> np.ndarray:
    rng = world.rng("popcorn")
    jumps = np.cumsum(rng.exponential(shape["dwell_s"], ceil(world.t[-1] / shape["dwell_s"] * 2 + 50)))
    return (np.searchsorted(jumps, world.t) % 2).astype(float)


def step(world: World, shape: Mapping[str, float]) -> np.ndarray:
    return (world.t >= shape["time_s"]).astype(float)


def bump(world: World, shape: Mapping[str, float]) -> np.ndarray:
    """Outside the catalogue: a smooth bump."""
    return np.exp(-(((world.t - shape["time_s"]) / shape["width_s"]) ** 2) / 2)


def warm_up(world: World, shape: Mapping[str, float]) -> np.ndarray:
    return np.exp(-world.t / shape["tau_s"])


def ring_down(world: World, shape: Mapping[str, float]) -> np.ndarray:
    """A damped sine after each shock, in amplitudes of the shock."""
    ringing = np.zeros(world.t.size)
    for time_s, amplitude_V in world.shocks:
        first, last = np.searchsorted(world.t, (time_s, time_s + FORGOTTEN * shape["decay_s"]))
        since = world.t[first:last] - time_s
        wave = np.sin(2 * pi * shape["frequency_hz"] * since)
        ringing[first:last] += amplitude_V * np.exp(-since / shape["decay_s"]) * wave
    return ringing


def thermal(world: World, shape: Mapping[str, float]) -> np.ndarray:
    """The thermometer's deviation after a first-order lag, degrees Celsius; held from reading to reading."""
    deviation = thermometer(world) - 23
    lagged = np.empty_like(deviation)
    keep, x = exp(-world.plant.interval_s / shape["lag_s"]), deviation[0]
    for k, now in enumerate(deviation):
        x = keep * x + (1 - keep) * now
        lagged[k] = x
    return np.repeat(lagged, world.plant.points)


def delayed(world: World, shape: Mapping[str, float]) -> np.ndarray:
    """The thermometer's deviation, degrees Celsius, as it was a while before: readings that are stamped late."""
    deviation = thermometer(world) - 23
    back = round(shape["lag_s"] / world.plant.interval_s)
    return np.repeat(
        np.concatenate((np.full(back, deviation[0]), deviation[: deviation.size - back])), world.plant.points
    )


AT_INPUT: Mapping[str, Callable[[World, Mapping[str, float]], np.ndarray]] = {
    "mains_alias": sine,
    "periodic_interference": sine,
    "wandering_line": chirp,
    "periodic_glitch": glitch,
    "resonance": resonance,
    "popcorn_noise": popcorn,
    "step": step,
    "warmup_drift": warm_up,
    "ring_down": ring_down,
    "thermal_drift": thermal,
    "latency": delayed,
    "ooc_packet": packet,
    "ooc_bump": bump,
    "ooc_saw": sawtooth_burst,
    "ooc_sweep": sweep_once,
}


# --- noise of a reading: from white noise to other noise -------------------------------------------------------------


def difference_noise(world: World, effect: Effect, white: np.ndarray, value: np.ndarray) -> np.ndarray:
    """size: standard deviation, V, of what neighbours share."""
    shared = effect.size * world.rng("difference").standard_normal(white.size + 1)
    return white + shared[1:] - shared[:-1]


def changing_noise(world: World, effect: Effect, white: np.ndarray, value: np.ndarray) -> np.ndarray:
    """size: factor of the noise's standard deviation from `begin` to `end`, parts of the record."""
    part = np.arange(white.size) / white.size
    return white * np.where((part >= effect.shape["begin"]) & (part < effect.shape["end"]), effect.size, 1.0)


def signal_dependent_noise(world: World, effect: Effect, white: np.ndarray, value: np.ndarray) -> np.ndarray:
    """size: standard deviation of the gain, which multiplies the input as it is, counted from 0 V."""
    return white + effect.size * value * world.rng("gain").standard_normal(white.size)


def heavy_tails(world: World, effect: Effect, white: np.ndarray, value: np.ndarray) -> np.ndarray:
    """size: part of the white variance that is Student's with 3 degrees of freedom; the variance stays."""
    student = world.rng("student").standard_t(3.0, white.size) / sqrt(3.0) * world.plant.white_sd_V
    return sqrt(1 - effect.size) * white + sqrt(effect.size) * student


def breathing_noise(world: World, effect: Effect, white: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Outside the catalogue: white noise whose deviation swells and fades evenly, `turns` times in the record."""
    part = np.arange(white.size) / white.size
    return white * np.exp(effect.size * np.sin(2 * pi * effect.shape["turns"] * part))


NOISE: Mapping[str, Callable[[World, Effect, np.ndarray, np.ndarray], np.ndarray]] = {
    "difference_noise": difference_noise,
    "changing_noise": changing_noise,
    "signal_dependent_noise": signal_dependent_noise,
    "heavy_tails": heavy_tails,
    "ooc_breath": breathing_noise,
}


# --- afterwards: converter, link, clock ------------------------------------------------------------------------------


def pattern(world: World, effect: Effect, record: Record) -> Record:
    """size: V, alternating."""
    sign = np.where(record.index % int(effect.shape["period_readings"]) == 0, 1.0, 0.0)
    return replace(record, value_V=record.value_V + effect.size * (sign - sign.mean()))


def smoothing(world: World, effect: Effect, record: Record) -> Record:
    """size: share of the last output in each one."""
    smoothed, x = record.value_V.copy(), record.value_V[0]
    for k, now in enumerate(record.value_V):
        smoothed[k] = x = effect.size * x + (1 - effect.size) * now
    return replace(record, value_V=smoothed)


def nonlinearity(world: World, effect: Effect, record: Record) -> Record:
    """size: 1/V."""
    return replace(record, value_V=record.value_V + effect.size * (record.value_V - record.value_V.mean()) ** 2)


def supply_coupling(world: World, effect: Effect, record: Record) -> Record:
    """size: gain per volt of the supply, 1/V."""
    return replace(record, value_V=record.value_V * (1 + effect.size * (supply(world) - 5)))


def range_switching(world: World, effect: Effect, record: Record) -> Record:
    """size: V, the offset of the wider range, in which a reading is from the shape's part of all magnitudes on."""
    magnitude = np.abs(record.value_V)
    wide = magnitude >= np.quantile(magnitude, effect.shape["part"])
    return replace(record, value_V=record.value_V + effect.size * wide)


def dead_band(world: World, effect: Effect, record: Record) -> Record:
    """size: width, V."""
    level = float(np.median(record.value_V))
    return replace(record, value_V=np.where(np.abs(record.value_V - level) < effect.size / 2, level, record.value_V))


def quantisation(world: World, effect: Effect, record: Record) -> Record:
    """size: step, V."""
    return replace(record, value_V=np.round(record.value_V / effect.size) * effect.size)


def saturation(world: World, effect: Effect, record: Record) -> Record:
    """size: part of the readings that are clipped, at the upper end."""
    return replace(record, value_V=np.minimum(record.value_V, np.quantile(record.value_V, 1 - effect.size)))


def stuck(world: World, effect: Effect, record: Record) -> Record:
    """size: readings that repeat one before them."""
    values, first = record.value_V.copy(), int(effect.shape["place"] * record.value_V.size)
    values[first + 1 : first + 1 + int(effect.size)] = values[first]
    return replace(record, value_V=values)


def replayed(world: World, effect: Effect, record: Record) -> Record:
    """size: length of the block, readings."""
    values, first, length = record.value_V.copy(), int(effect.shape["place"] * record.value_V.size), int(effect.size)
    values[first + length : first + 2 * length] = values[first : first + length]
    return replace(record, value_V=values)


def missing(world: World, effect: Effect, record: Record) -> Record:
    """size: part of the readings that the logger lost without counting them."""
    left = lose(record, world.rng("missing").random(record.index.size) < effect.size)
    return replace(left, index=np.arange(left.index.size))


def jitter(world: World, effect: Effect, record: Record) -> Record:
    """size: s. Stamps are late, and in order, since a host stamps what arrives."""
    late_s = effect.size * np.abs(world.rng("jitter").standard_normal(record.time_s.size))
    return replace(record, time_s=np.sort(record.time_s + late_s))


def clock_error(world: World, effect: Effect, record: Record) -> Record:
    """size: parts in a million by which the stamps run fast."""
    return replace(record, time_s=record.time_s * (1 + 1e-6 * effect.size))


def echo(world: World, effect: Effect, record: Record) -> Record:
    """Outside the catalogue: `size` times the reading `lag_readings` before it, as an absorbing dielectric gives."""
    lag, deviation = int(effect.shape["lag_readings"]), record.value_V - record.value_V.mean()
    return replace(record, value_V=record.value_V + effect.size * np.concatenate((np.zeros(lag), deviation[:-lag])))


def gain_step(world: World, effect: Effect, record: Record) -> Record:
    """Outside the catalogue: deviations from the mean grow by `size` from one moment on."""
    later = record.time_s >= effect.shape["time_s"]
    return replace(record, value_V=record.value_V + effect.size * later * (record.value_V - record.value_V.mean()))


AFTERWARDS: Mapping[str, Callable[[World, Effect, Record], Record]] = {
    "reading_pattern": pattern,
    "smoothing": smoothing,
    "nonlinearity": nonlinearity,
    "supply_coupling": supply_coupling,
    "range_switching": range_switching,
    "dead_band": dead_band,
    "quantisation": quantisation,
    "saturation": saturation,
    "stuck_readings": stuck,
    "replayed_block": replayed,
    "missing_samples": missing,
    "timestamp_jitter": jitter,
    "clock_error": clock_error,
    "ooc_echo": echo,
    "ooc_gain_step": gain_step,
}
