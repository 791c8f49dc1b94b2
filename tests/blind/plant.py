"""The clean instrument before anything is hidden in it: its numbers, its noise, its shocks, the room around it.

Numpy and nothing else, on purpose: see injector.py.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import ceil, exp, inf, pi, sqrt

import numpy as np

__all__ = [
    "FORGOTTEN",
    "Effect",
    "Plant",
    "Record",
    "Run",
    "World",
    "add_shock",
    "lose",
    "make_world",
    "markov",
    "supply",
    "thermometer",
]

BLOCK = 256  # points over which a recursion is solved at once; e^(256 steps/tau) stays far from overflow


FORGOTTEN = 40.0  # decays after which of the loudest shock less is left than a number's last digit


@dataclass(frozen=True)
class Plant:
    """A clean instrument: first-order Markov signal and drift, shocks, white noise, now and then a lost reading."""

    n: int
    interval_s: float
    aperture_s: float
    signal_sd_V: float
    signal_tau_s: float
    drift_rate_V_per_rt_s: float
    drift_tau_s: float
    white_sd_V: float
    """Of a reading."""
    shocks_per_s: float = 0.0
    shock_sd_V: float = 0.0
    shock_decay_s: float = 0.1
    level_V: float = 0.0
    lost_fraction: float = 0.0
    witness: bool = False
    """Whether a thermometer and a meter of the supply stand beside it, whether or not they matter."""

    @property
    def step_s(self) -> float:
        return self.interval_s / ceil(self.interval_s * 1000)

    @property
    def points(self) -> int:
        """Of the grid, from one reading to the next."""
        return ceil(self.interval_s * 1000)

    @property
    def inside(self) -> int:
        """Of these, within the aperture."""
        return max(1, round(self.aperture_s / self.step_s))


@dataclass(frozen=True)
class Effect:
    """What is hidden: its cause, how large, and of what shape; units as in the function of that cause below."""

    cause: str
    size: float
    shape: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Run:
    plant: Plant
    seed: int
    effects: tuple[Effect, ...] = ()


@dataclass(frozen=True)
class Record:
    """What a logger has; shapes (n,), and (m,) for a witness."""

    index: np.ndarray
    time_s: np.ndarray
    value_V: np.ndarray
    witnesses: Mapping[str, tuple[np.ndarray, np.ndarray]]


@dataclass
class World:
    """A run while it is being made."""

    plant: Plant
    seed: int
    t: np.ndarray
    """The grid, s."""
    shocks: list[tuple[float, float]]
    """Time, s, and amplitude, V."""

    def rng(self, part: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, *part.encode()])

    def read(self, fine: np.ndarray) -> np.ndarray:
        return fine.reshape(self.plant.n, self.plant.points)[:, : self.plant.inside].mean(axis=1)


def make_world(run: Run) -> World:
    plant = run.plant
    world = World(plant, run.seed, np.arange(plant.n * plant.points) * plant.step_s, [])
    rng = world.rng("shocks")
    count = rng.poisson(plant.shocks_per_s * plant.n * plant.interval_s)
    times = np.sort(rng.random(count)) * plant.n * plant.interval_s
    world.shocks = list(zip(times, plant.shock_sd_V * rng.standard_normal(count), strict=True))
    for effect in run.effects:
        if effect.cause == "shock_law":  # one sign
            world.shocks = [(at, abs(size) if rng.random() < effect.size else size) for at, size in world.shocks]
    return world


def markov(
    rng: np.random.Generator, n: int, step_s: float, tau_s: float, rate: complex, turn_hz: float = 0.0
) -> np.ndarray:
    """Solve dx = -x/tau + rate dW on a grid; with `turn_hz`, its complex sister that also turns, of which Re is read.

    x[k] = a x[k-1] + e[k] is, over a block, a^k (x[0] + sum a^-j e[j]): a cumulative sum of scaled numbers.
    """
    keep = exp(-step_s / tau_s) * (np.exp(2j * pi * turn_hz * step_s) if turn_hz else 1.0)
    if tau_s == inf:
        return np.cumsum(rate * sqrt(step_s) * rng.standard_normal(n))
    if abs(keep) < 1e-300 ** (1 / BLOCK):
        raise ValueError(f"tau = {tau_s} s is too short for a grid of {step_s} s")
    sd = rate * sqrt(tau_s / 2)
    kick = sd * sqrt(-np.expm1(-2 * step_s / tau_s))

    def normal(count: int) -> np.ndarray:
        plain = rng.standard_normal(count)
        return plain + 1j * rng.standard_normal(count) if turn_hz else plain

    blocks = ceil(n / BLOCK)
    powers = keep ** np.arange(1, BLOCK + 1)
    driven = powers * np.cumsum(kick * normal(blocks * BLOCK).reshape(blocks, BLOCK) / powers, axis=1)
    x = sd * normal(1)[0]
    for number in range(blocks):
        driven[number] += powers * x
        x = driven[number, -1]
    return np.real(driven.ravel()[:n])


def add_shock(world: World, fine: np.ndarray, time_s: float, amplitude_V: float) -> None:
    """Add a shock to a history on the grid, up to where nothing of it is left."""
    decay_s = world.plant.shock_decay_s
    first, last = np.searchsorted(world.t, (time_s, time_s + FORGOTTEN * decay_s))
    fine[first:last] += amplitude_V * np.exp(-(world.t[first:last] - time_s) / decay_s)


def thermometer(world: World) -> np.ndarray:
    """Return a room's temperature, degrees Celsius: an hour's drift and the switching of the heating."""
    plant = world.plant
    rng = world.rng("temperature")
    slow = markov(rng, plant.n, plant.interval_s, 1800.0, 0.02)
    heating_s = rng.uniform(120, 400)
    phase = rng.uniform(0, 2 * pi)
    return 23 + slow + 0.3 * np.sin(2 * pi * np.arange(plant.n) * plant.interval_s / heating_s + phase)


def supply(world: World) -> np.ndarray:
    """Return the supply's voltage, V: a load that comes and goes, and a little wandering."""
    plant = world.plant
    rng = world.rng("supply")
    wandering = markov(rng, plant.n, plant.interval_s, 20.0, 0.01 * sqrt(2 / 20.0))
    load = np.sign(np.sin(2 * pi * (np.arange(plant.n) * plant.interval_s / rng.uniform(30, 90) + rng.uniform())))
    return 5 + wandering + 0.01 * load


def lose(record: Record, lost: np.ndarray) -> Record:
    kept = ~lost
    return replace(record, index=record.index[kept], time_s=record.time_s[kept], value_V=record.value_V[kept])
