"""How far a hidden effect is from what else it could be called: D against the nearest rival, in nats.

D_rival = E[log p(readings | the true model)] - E[log p(readings | the best model of another mechanism)], by the means
of certificate.py and nothing of the critic's. Of an effect in the mean, what the best of a rival's shapes leaves of it,
whitened by the true plant; a resonance as narrow as a record can tell, four of its frequencies, leaves of a line
4 ln(1 + D/4). Of an effect in the covariance, the asymptotic loss of the true spectrum under the best rival's, the
plant fitted again. Two names are told apart in 95 % of the cases from 5.4 nats on, in 99 % from 10.8 (the root of half
of it is the odds' deviations).

Of what the readings themselves make in the mean, a bent scale, a gain that follows the supply and an offset of the
wider range, each is a rival of the others, and a supply that adds late one of the gain. (One that adds at once has the
gain's name: where the level does not move, they are the same readings.) A bent scale is also louder where the slope is
larger, and a rival noise takes that part of what its score is made of.

A rival of which the truth is a special case is none: a line is a sweep of no sweep. None where no rival is written for
the kind: noise that is not Gaussian, what is counted, jumps between two levels.
"""

from collections.abc import Callable, Iterator
from math import exp, log

import numpy as np
from scipy.optimize import minimize

from tests.blind.certificate import EXTENDED, KINDS, d_nats, edge_of_range, unit_template
from tests.blind.gaussian import numbers, spectrum, whiten
from tests.blind.injector import calm, thermal
from tests.blind.plant import Effect, Plant, Run, make_world, supply, thermometer

__all__ = ["TOLD_APART", "rival_nats"]

TOLD_APART = 10.8
BAND = 4.0
"""Frequencies of a record that the narrowest resonance covers."""
ONE_LINE = ("mains_alias", "periodic_interference")
BOTH_LINES = (*ONE_LINE, "wandering_line")
OF_READINGS = ("nonlinearity", "supply_coupling", "range_switching")


def rival_nats(run: Run, effect: Effect) -> tuple[float, str] | None:
    """Return D against the nearest rival and its name; None where none can be computed."""
    kind, rivals = KINDS[effect.cause], None
    if kind == "mean":
        rivals = mean_rivals(run, effect)
    if kind == "covariance" and effect.cause in EXTENDED:
        rivals = spectral_rivals(run.plant, effect)
    if rivals is None:
        return None
    nats, name = min(rivals)
    return min(nats, d_nats(run, effect)), name  # a rival of no size is the plant, fitted again


def mean_rivals(run: Run, effect: Effect) -> Iterator[tuple[float, str]]:
    plant = run.plant
    theta = numbers(plant)
    shown = effect.size * unit_template(run, effect)
    keeps = [exp(-plant.interval_s / exp(theta[j])) for j in (1, 3)]
    variances = np.exp(theta[[0, 2, 4]])

    def whitened(column: np.ndarray) -> np.ndarray:
        return whiten(np.ascontiguousarray(column, dtype=float), *keeps, *variances)

    seen, level = whitened(shown), whitened(np.ones(plant.n))
    louder = 0.0
    if effect.cause == "supply_coupling":  # it scales the noise as well, which nothing in the mean does
        apart = effect.size * supply(make_world(run))
        louder = float(np.sum((apart - apart.mean()) ** 2))
    if effect.cause == "range_switching":  # it leaves a hole between two ranges, or a part that they share
        louder = effect.size * edge_of_range(run, effect)
    for name, columns in shapes(run, effect, shown):
        taken = np.linalg.qr(np.column_stack([level, *(whitened(column) for column in columns)]))[0]
        yield float(np.sum((seen - taken @ (taken.T @ seen)) ** 2) / 2) + louder, name
    if effect.cause == "nonlinearity":
        yield from noisy_rivals(run, effect, whitened)
    if effect.cause in BOTH_LINES:
        yield BAND * log(1 + d_nats(run, effect) / BAND), "resonance"


def shapes(run: Run, effect: Effect, shown: np.ndarray) -> Iterator[tuple[str, list[np.ndarray]]]:
    """Yield each shape of each rival, as the columns that it may combine."""
    plant, cause = run.plant, effect.cause
    t_s = np.arange(plant.n) * plant.interval_s
    span_s = plant.n * plant.interval_s
    if cause != "step":
        edges = np.argsort(np.abs(np.diff(shown)))[-10:] + 1
        for at in {*np.linspace(5, plant.n - 5, 80).astype(int), *edges}:
            yield "step", [np.arange(plant.n) >= at]
    if cause != "warmup_drift":
        for tau_s in np.geomspace(10 * plant.interval_s, span_s, 16):
            yield "warmup_drift", [np.exp(-t_s / tau_s)]
    if cause not in ONE_LINE:
        yield from (("periodic_interference", columns) for columns in sines(shown, t_s))
    elif cause == "mains_alias":  # the same readings, whose other name is refused for what frequencies a grid may have
        yield "periodic_interference", [shown]
    if cause != "reading_pattern":
        for period in (2, 3, 4, 5):
            yield "reading_pattern", [np.arange(plant.n) % period == k for k in range(1, period)]
    if plant.witness and cause not in ("thermal_drift", "latency"):
        yield from witnessed(run, "thermal_drift")
    elif plant.witness:
        yield from witnessed(run, "latency" if cause == "thermal_drift" else "thermal_drift")
        yield "supply_coupling", [calm(run) * (thermometer(make_world(run)) - 23)]
    if cause in OF_READINGS:
        yield from of_readings(run, cause)
    if cause == "supply_coupling":
        yield from late_supply(run)


def sines(shown: np.ndarray, t_s: np.ndarray) -> Iterator[list[np.ndarray]]:
    """Yield waves at the strongest frequencies of what is shown."""
    power = np.abs(np.fft.rfft(shown - shown.mean(), 4 * shown.size)) ** 2
    for k in np.argsort(power)[-12:]:
        angle = 2 * np.pi * k * np.arange(t_s.size) / (4 * shown.size)
        yield [np.cos(angle), np.sin(angle)]


def witnessed(run: Run, cause: str) -> Iterator[tuple[str, list[np.ndarray]]]:
    """Yield the thermometer late, or through a lag."""
    world = make_world(run)
    now = world.read(thermal(world, {"lag_s": 1e-3}))
    for lag_s in np.geomspace(0.3, 300, 25):
        if cause == "latency":
            back = min(max(round(lag_s / run.plant.interval_s), 1), now.size - 1)
            yield cause, [np.concatenate((np.full(back, now[0]), now[:-back]))]
        else:
            yield cause, [world.read(thermal(world, {"lag_s": float(lag_s)}))]


def of_readings(run: Run, cause: str) -> Iterator[tuple[str, list[np.ndarray]]]:
    """Yield what else the readings themselves can make in the mean."""
    value = calm(run)
    if cause != "nonlinearity":
        yield "nonlinearity", [(value - value.mean()) ** 2]
    if cause != "range_switching":
        for part in np.linspace(0.05, 0.95, 19):
            yield "range_switching", [np.abs(value) >= np.quantile(np.abs(value), part)]
    if cause != "supply_coupling" and run.plant.witness:
        yield "supply_coupling", [value * (supply(make_world(run)) - 5)]


def late_supply(run: Run) -> Iterator[tuple[str, list[np.ndarray]]]:
    """Yield the supply as it was a while before, added to the readings instead of scaling them."""
    apart = supply(make_world(run)) - 5
    for lag_s in np.geomspace(0.1, 300, 25):
        back = min(max(round(lag_s / run.plant.interval_s), 1), apart.size - 1)
        yield "latency", [np.concatenate((np.full(back, apart[0]), apart[:-back]))]


def noisy_rivals(run: Run, effect: Effect, whitened: Callable[[np.ndarray], np.ndarray]) -> Iterator[tuple[float, str]]:
    """Yield what a noise that follows the level, or the clock, leaves of a bent scale y = x + b x^2.

    Of a reading m + e, with m known from those before and e of variance S, the score of b is, in units of e/sqrt(S)
    and ordered by Hermite's polynomials of it (independent of each other): He1 (m^2 - p + S)/sqrt(S), p what those
    before tell of m^2; He2 2 m; He3 sqrt(S). A noise's own score is of He2 alone, so of that part it leaves what its
    shape does not take, and nothing can be told of the rest.
    """
    plant, value = run.plant, calm(run)
    root = exp(float(np.mean(np.log(spectrum(numbers(plant), plant)))) / 2)
    x = value - value.mean()
    m = x - root * whitened(x)
    first = m**2 - x**2 + root * whitened(x**2) + root**2
    taken = np.linalg.qr(np.column_stack([np.ones(plant.n), whitened(np.ones(plant.n))]))[0]
    first = first - taken @ (taken.T @ first)
    apart = float(np.sum((first / root) ** 2)) + 6 * plant.n * root**2
    edges = np.linspace(0, plant.n, 21).astype(int)
    at = np.arange(plant.n)
    shapes_of = [("signal_dependent_noise", (m + value.mean()) ** 2)]
    shapes_of += [
        ("changing_noise", ((at >= begin) & (at < end)).astype(float))
        for begin in edges[:-1]
        for end in edges[1:]
        if begin < end and end - begin < plant.n
    ]
    for name, shape in shapes_of:
        columns = np.linalg.qr(np.column_stack([np.ones(plant.n), shape]))[0]
        left = 2 * m - columns @ (columns.T @ (2 * m))
        yield effect.size**2 / 2 * (apart + 2 * float(left @ left)), name


def spectral_rivals(plant: Plant, effect: Effect) -> Iterator[tuple[float, str]]:
    """Yield the loss under each rival noise, its own numbers and the plant's five fitted."""
    theta, true_s = numbers(plant), EXTENDED[effect.cause](spectrum(numbers(plant), plant), effect, plant)
    scale = plant.white_sd_V
    rate_hz = 1 / plant.interval_s

    def loss(s: np.ndarray) -> float:
        return plant.n / 2 * float(np.mean(true_s / s - np.log(true_s / s) - 1))

    def fitted(name: str, shape: dict[str, float], start: float) -> float:
        def at(free: np.ndarray) -> float:
            size = 0.98 / (1 + exp(-free[5])) if name == "smoothing" else scale * exp(free[5])
            return loss(EXTENDED[name](spectrum(free[:5], plant), Effect(name, size, shape), plant))

        box = [(value - 6, value + 6) for value in theta] + [(-12.0, 6.0)]
        return float(minimize(at, [*theta, start], method="L-BFGS-B", bounds=box, options={"maxiter": 60}).fun)

    for name in ("difference_noise", "smoothing"):
        if name != effect.cause:
            yield min(fitted(name, {}, start) for start in (-1.0, 0.0)), name
    if effect.cause != "resonance":
        for frequency_hz in np.linspace(0.15, 0.48, 5) * rate_hz:
            shape = {"frequency_hz": float(frequency_hz), "quality": 3.0}
            yield fitted("resonance", shape, -0.5), "resonance"
        return
    # A line takes the strongest of the frequencies that the resonance covers, whose powers are exponential: of so many,
    # the largest is the mean times their logarithm and Euler's number more.
    added = true_s / spectrum(theta, plant)
    excess = float(np.max(added))
    covered = max(float(np.sum(added - 1)) / max(excess - 1, 1e-9), 1.0)
    yield max(loss(spectrum(theta, plant)) - excess * (log(covered) + 0.577), 0.0), "periodic_interference"
