"""Between what was fitted and the catalogue's model: terms and effects in volts and seconds.

A fit's first reading is at the model's time 0, the middle of the first aperture being half an aperture later.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from math import atan2, exp, hypot, inf, pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aemd import model
from aemd.diagnose.apertures import averaged_markov, averaged_out, averaged_pair, struck_between
from aemd.diagnose.fit import Fit
from aemd.diagnose.given import Given
from aemd.diagnose.hypothesis import Base, Parts, signal_and_drift
from aemd.diagnose.instants import one_ring
from aemd.diagnose.result import Value
from aemd.diagnose.terms.events import PeriodicGlitch, Popcorn, RingDown, ShockLaw
from aemd.diagnose.terms.lines import Sines, WanderingLine
from aemd.diagnose.terms.noise import (
    ChangingNoise,
    DifferenceNoise,
    ExtraMarkov,
    Flicker,
    HeavyTails,
    RandomWalk,
    Resonance,
    SignalDependentNoise,
    Smoothing,
)
from aemd.diagnose.terms.ranges import RangeOffset, RangeOverlap, RangeSwitching
from aemd.diagnose.terms.shapes import Nonlinearity, ReadingPattern, Step, WarmUp
from aemd.diagnose.terms.stated import OtherFigures
from aemd.diagnose.terms.witnessed import Latency, SupplyCoupling, ThermalDrift, called

__all__ = ["Told", "as_tables", "to_model"]

Floats = NDArray[np.float64]
Made = tuple[list[Any], list[Any]]
Told = Mapping[int, Mapping[str, Value]]

_BLOCKED = 0.05
"""Part of what swings that an aperture must let through for its size before the aperture to mean anything."""
_LEAST_PART = 1e-4
"""Of the white noise that was fitted, which is left where another aperture averages less of what is fast."""
_ORDER = (
    model.Nonlinearity,
    model.DifferenceNoise,
    model.HeavyTails,
    model.SignalDependentNoise,
    model.ReadingPattern,
    model.SupplyCoupling,
    model.RangeSwitching,
    model.Smoothing,
)
"""In which the filter has effects meet a reading, whichever was found first."""
_A_WALK = 100.0
"""Spans of the record from which a time constant is called infinite."""
_WITNESSED = (model.ThermalDrift, model.SupplyCoupling)
"""Of each, a model has one, since it is recorded under one name."""
_NOTHING_TOLD: Told = {}


def to_model(fit: Fit, aperture_s: float, told: Told = _NOTHING_TOLD) -> tuple[model.Model, tuple[str, ...]]:
    """Return the model that the fit describes, and the causes that the catalogue has no term for.

    Args:
        fit: base and terms.
        aperture_s: of the meter that the model is for, s; white noise and lines depend on it.
        told: what is reported of terms, by their numbers; a ring's figures are not those of its fit (see instants.py).
    """
    terms, effects, without = list[Any](), list[Any](), list[str]()
    for number, term in enumerate(fit.terms):
        theta = fit.parts_of(number)
        if isinstance(term, Given):
            terms += term.stated.terms
            effects += term.stated.effects
            continue
        if isinstance(term, OtherFigures):  # the stated terms came first, its effects too
            first = len(term.given.stated.terms)
            place, at = (terms, term.number) if term.number < first else (effects, term.number - first)
            place[at] = term.made(theta, fit.data)
            continue
        if isinstance(term, Base):
            terms += _base(term, theta, fit, aperture_s)
            continue
        if isinstance(term, ShockLaw | RingDown):  # a property of the shocks; see _struck
            continue
        make = _MAKERS.get(type(term))
        if make is None:
            without.append(term.cause)
            continue
        made, changed = make(term, theta, fit, aperture_s)
        have = {type(part) for part in (*terms, *effects)}
        if any(isinstance(part, _WITNESSED) and type(part) in have for part in (*made, *changed)):
            without.append(called(term))
            continue
        terms += made
        effects += changed
    if isinstance(fit.terms[0], Base):  # in which the fit has them; a stated model's have an order of their own
        effects.sort(key=lambda effect: _ORDER.index(type(effect)) if type(effect) in _ORDER else len(_ORDER))
    terms, unheard = _struck(terms, fit, told)
    return model.Model(tuple(terms), 1, tuple(effects)), (*without, *unheard)


def as_tables(made: model.Model) -> Mapping[str, Any]:
    """Return a model as plain tables, as its TOML file has them."""
    return {
        "seed": made.seed,
        "terms": [{key: value for key, value in asdict(term).items() if value is not None} for term in made.terms],
        "effects": [asdict(effect) for effect in made.effects],
    }


def _base(base: Base, v: Floats, fit: Fit, aperture_s: float) -> list[Any]:
    unit, span = fit.data.unit_V, fit.data.span_s
    # What is fitted is at instants; the model's processes are averaged, which takes from the white noise what is fast.
    places = signal_and_drift(v)
    signal_tau_s, drift_tau_s = (exp(v[at]) for at in places)
    signal, drift = (exp(v[at + 1]) / averaged_markov(exp(v[at]), 1.0, aperture_s)[0] for at in places)
    fitted, lost = (
        sum(averaged_out(exp(v[at]), exp(v[at + 1]), each) for at in places)
        for each in (fit.data.aperture_s, aperture_s)
    )
    own = exp(2 * v[4])
    white = sqrt(max(own * _quietest(fit) ** 2 + fitted - lost, _LEAST_PART * own))
    made: list[Any] = [
        model.Level(level_V=float(v[5] * unit + fit.data.origin_V)),
        model.GaussMarkov(role="signal", rate_V_per_rt_s=signal * unit, tau_s=signal_tau_s),
        model.GaussMarkov(
            role="internal",
            rate_V_per_rt_s=drift * unit,
            tau_s=inf if drift_tau_s > _A_WALK * span else drift_tau_s,
        ),
        model.WhiteNoise.from_sd(white * unit, aperture_s),
    ]
    if base.shocks:
        left = struck_between(exp(v[8]), fit.data.interval_s)
        made.append(model.Shocks(rate_per_s=exp(v[6]), sd_V=exp(v[7]) * unit / left, decay_s=exp(v[8])))
    return made


def _steady_sd(fit: Fit) -> float:
    """Return the standard deviation of the white noise as it would be without what changes it, in scaled readings."""
    parts = Parts(np.zeros(fit.data.y.size), np.zeros(fit.data.y.size), np.ones(fit.data.y.size))
    for number, term in enumerate(fit.terms):
        if not isinstance(term, ChangingNoise):
            term.add(fit.parts_of(number), fit.data, parts)
    return sqrt(max(float(np.median(parts.noise_var - parts.averaged)), 0.0))


def _quietest(fit: Fit) -> float:
    """Return by how much the white noise is less where it is least: that part is there all the time."""
    ratios = [exp(fit.parts_of(at)[0]) for at, term in enumerate(fit.terms) if isinstance(term, ChangingNoise)]
    return min([1.0, *ratios])


def _sines(term: Sines, v: Floats, fit: Fit, aperture_s: float) -> Made:
    frequency, rate = float(term.frequency_hz + v[0] / fit.data.span_s), 1 / fit.data.interval_s
    made = []
    for number, harmonic in enumerate(term.harmonics):
        a, b, f = float(v[1 + 2 * number]), float(v[2 + 2 * number]), harmonic * frequency
        if abs(np.sinc(f * aperture_s)) < _BLOCKED:  # an aperture of whole periods: the alias makes the same readings
            folded = f - rate * round(f / rate)
            f, b = abs(folded), float(np.copysign(b, b * folded))
        passed = float(np.sinc(f * aperture_s))
        phase = atan2(a, b) - pi * f * aperture_s
        amplitude_V = hypot(a, b) * fit.data.unit_V / passed
        if amplitude_V < 0:
            amplitude_V, phase = -amplitude_V, phase + pi
        if f > 0:
            made.append(model.Sine(role="external", amplitude_V=amplitude_V, frequency_hz=f, phase_rad=phase))
    return made, []


def _changing(term: ChangingNoise, v: Floats, fit: Fit, aperture_s: float) -> Made:
    """Return the noise that is added between the instants; where it is less there, what is added elsewhere."""
    white_V, ratio = _steady_sd(fit) * fit.data.unit_V, exp(v[0])
    density = white_V * sqrt(abs(ratio**2 - 1)) * sqrt(2 * aperture_s)
    inside, outside = (term.begin_s, term.end_s - term.begin_s), ((0.0, term.begin_s), (term.end_s, inf))
    spans = (inside,) if ratio >= 1 else outside
    return [
        model.WhiteNoise(density_V_per_rt_hz=density, start_s=start, duration_s=length)
        for start, length in spans
        if length > 0
    ], []


def _step(term: Step, v: Floats, fit: Fit, _: float) -> Made:
    at_s = max(term.time_s - fit.data.interval_s / 2, 0.0)
    return [model.Step(time_s=at_s, step_V=float(v[0] * fit.data.unit_V))], []


def _warm_up(_term: WarmUp, v: Floats, fit: Fit, _: float) -> Made:
    return [model.WarmUp(amplitude_V=float(v[1] * fit.data.unit_V), tau_s=exp(v[0]))], []


def _extra(_term: ExtraMarkov, v: Floats, fit: Fit, _: float) -> Made:
    return [model.GaussMarkov.from_sd(exp(v[1]) * fit.data.unit_V, exp(v[0]), role="internal")], []


def _walk(_term: RandomWalk, v: Floats, fit: Fit, _: float) -> Made:
    return [model.GaussMarkov(role="internal", rate_V_per_rt_s=exp(v[0]) * fit.data.unit_V, start_V=0.0)], []


def _flicker(_term: Flicker, v: Floats, fit: Fit, _: float) -> Made:
    low_hz, high_hz = 0.3 / fit.data.span_s, 0.5 / fit.data.interval_s
    return [model.FlickerNoise(amplitude_V=exp(v[0]) * fit.data.unit_V, low_hz=low_hz, high_hz=high_hz)], []


def _resonance(term: Resonance, v: Floats, fit: Fit, aperture_s: float) -> Made:
    frequency, tau_s = float(term.frequency_hz + v[1] / term.tau_s), exp(v[0])
    passed, _ = averaged_pair(tau_s, 2 * pi * frequency, 1.0, aperture_s)
    sd_V = exp(v[2]) * fit.data.unit_V / max(passed, _BLOCKED)
    return [model.Resonance(frequency_hz=frequency, quality=max(pi * frequency * tau_s, 0.51), sd_V=sd_V)], []


def _difference(_term: DifferenceNoise, v: Floats, fit: Fit, _: float) -> Made:
    return [], [model.DifferenceNoise(sd_V=exp(v[0]) * fit.data.unit_V)]


def _smoothing(_term: Smoothing, v: Floats, _fit: Fit, _: float) -> Made:
    return [], [model.Smoothing(kept=1 / (1 + exp(-v[0])))]


def _tails(_term: HeavyTails, v: Floats, fit: Fit, _: float) -> Made:
    # Student's law with the mixture's variance and kurtosis, 3/p - 3.
    fraction = min(exp(v[0]), 0.99)
    sd_V = sqrt(fraction) * exp(v[1]) * fit.data.unit_V
    return [], [model.HeavyTails(sd_V=sd_V, dof=4 + 6 / (3 / fraction - 3))]


def _signal_dependent(_term: SignalDependentNoise, v: Floats, _fit: Fit, _: float) -> Made:
    return [], [model.SignalDependentNoise(fraction=exp(v[0]))]


def _nonlinearity(_term: Nonlinearity, v: Floats, fit: Fit, _: float) -> Made:
    centre_V = fit.data.origin_V
    return [], [model.Nonlinearity(coefficient_per_V=float(v[0] / fit.data.unit_V), centre_V=centre_V)]


def _pattern(_term: ReadingPattern, v: Floats, fit: Fit, _: float) -> Made:
    offsets = np.append(v, -v.sum()) * fit.data.unit_V
    return [], [model.ReadingPattern(offsets_V=tuple(float(offset) for offset in offsets))]


def _thermal(term: ThermalDrift, v: Floats, fit: Fit, _: float) -> Made:
    sd, tau_s, mean = _witness_law(fit, term.witness)
    coefficient, lag_s = float(v[0] * fit.data.unit_V), exp(v[1]) if term.lag_s else 0.0
    if called(term) == "supply_coupling":
        return [], [
            model.SupplyCoupling(coefficient_V_per_V=coefficient, lag_s=lag_s, sd_V=sd, tau_s=tau_s, mean_V=mean)
        ]
    return [
        model.ThermalDrift(
            coefficient_V_per_C=coefficient,
            lag_s=lag_s,
            sd_C=sd,
            tau_s=tau_s,
            mean_C=mean,
        )
    ], []


def _latency(term: Latency, v: Floats, fit: Fit, _: float) -> Made:
    lag_s = float(term.lag_s * (1 + v[1]))
    if term.known:
        return [], [model.Latency(lag_s=lag_s)]
    sd, tau_s, mean = _witness_law(fit, term.witness)
    coefficient = float(v[0] * fit.data.unit_V)
    return [model.ThermalDrift(coefficient_V_per_C=coefficient, sd_C=sd, tau_s=tau_s, mean_C=mean)], [
        model.Latency(lag_s=lag_s)
    ]


def _wandering(term: WanderingLine, v: Floats, fit: Fit, aperture_s: float) -> Made:
    span_s = fit.data.span_s
    frequency, chirp = float(term.frequency_hz + v[0] / span_s), float(term.chirp_hz_per_s + v[1] / span_s**2)
    middle_s = span_s / 2 + aperture_s / 2  # of the record, on the model's clock
    first_hz = frequency - chirp * middle_s
    turned = 2 * pi * (first_hz + chirp * middle_s / 2) * middle_s
    passed = float(np.sinc(frequency * aperture_s))
    return [
        model.WanderingLine(
            amplitude_V=hypot(v[2], v[3]) * fit.data.unit_V / max(abs(passed), _BLOCKED),
            frequency_hz=max(first_hz, 1e-6),
            chirp_hz_per_s=chirp,
            phase_rad=atan2(v[2], v[3]) - turned,
        )
    ], []


def _glitch(term: PeriodicGlitch, v: Floats, fit: Fit, aperture_s: float) -> Made:
    begin_s = (term.begin_s + aperture_s / 2) % term.period_s
    amplitude_V = float(v[0] * fit.data.unit_V)
    return [
        model.PeriodicPulse(
            amplitude_V=amplitude_V, period_s=term.period_s, width_s=min(term.width_s, term.period_s), start_s=begin_s
        )
    ], []


def _popcorn(_term: Popcorn, v: Floats, fit: Fit, _: float) -> Made:
    step, low_s, high_s = np.exp(v)
    return [
        model.PopcornNoise(step_V=float(step * fit.data.unit_V), dwell_low_s=float(low_s), dwell_high_s=float(high_s))
    ], []


def _between_ranges(term: RangeOffset | RangeOverlap, v: Floats, fit: Fit, _: float) -> Made:
    level_V, offset_V = (item.value(v) for item in term.parameters(fit.data))
    return [], [model.RangeSwitching(threshold_V=level_V or 1e-12, offset_V=offset_V)]


def _range(term: RangeSwitching, v: Floats, fit: Fit, _: float) -> Made:
    unit = fit.data.unit_V
    return [], [
        model.RangeSwitching(
            threshold_V=term.threshold * unit,
            hysteresis_V=term.hysteresis * unit,
            offset_V=float(v[0] * unit),
            sd_V=exp(v[1]) * unit,
        )
    ]


def _struck(terms: list[Any], fit: Fit, told: Told) -> tuple[list[Any], list[str]]:
    """Return the terms, their shocks with the law and the shape that findings gave them, and what these cannot have.

    Shocks have one ring: the loudest, unless a stated model's have their own.
    """
    if any(isinstance(term, Popcorn) for term in fit.terms):
        terms = [term for term in terms if not isinstance(term, model.Shocks)]
    shocks = next((term for term in terms if isinstance(term, model.Shocks)), None)
    changes, rings, without = dict[str, Any](), list[tuple[float, float, float]](), list[str]()
    for number, term in enumerate(fit.terms):
        if not isinstance(term, ShockLaw | RingDown):
            continue
        v = fit.parts_of(number)
        if shocks is None:
            without.append(term.cause)
        elif isinstance(term, ShockLaw):
            changes["positive_fraction"] = float(0.5 + v[0] / 2)
        else:
            figures = {item.name: item.value(v) for item in term.parameters(fit.data)}
            figures |= {name: known.value for name, known in told.get(number, {}).items()}
            rings.append((figures["frequency_hz"], figures["decay_s"], figures["ratio"]))
    if rings and shocks is not None:
        hz, decay_s, ratio = max(rings, key=lambda ring: ring[2])
        if shocks.ring_fraction == 0:
            changes |= {"ring_fraction": ratio, "ring_hz": hz, "ring_decay_s": decay_s}
            rings = [ring for ring in rings if not one_ring(ring[:2], (hz, decay_s))]
        without += ["ring_down"] * len(rings)
    return [replace(term, **changes) if isinstance(term, model.Shocks) else term for term in terms], without


def _supply(term: SupplyCoupling, v: Floats, fit: Fit, _: float) -> Made:
    sd, tau_s, mean = _witness_law(fit, term.witness)
    return [], [model.SupplyCoupling(coefficient_per_V=float(v[0]), sd_V=sd, tau_s=tau_s, mean_V=mean)]


def _witness_law(fit: Fit, name: str) -> tuple[float, float, float]:
    """Return deviation, time constant and mean of a witness as a first-order process: by variance and mean change."""
    values = fit.data.witnesses[name]
    sd = float(np.std(values))
    apart = max(values.size // 100, 1)
    change = float(np.mean((values[apart:] - values[:-apart]) ** 2)) / (2 * sd**2)
    tau_s = apart * fit.data.interval_s / max(-np.log(max(1 - change, 1e-3)), 1e-3)
    return sd, float(tau_s), float(np.mean(values))


_MAKERS: Mapping[type, Callable[[Any, Floats, Fit, float], Made]] = {
    Sines: _sines,
    ChangingNoise: _changing,
    Step: _step,
    WarmUp: _warm_up,
    ExtraMarkov: _extra,
    RandomWalk: _walk,
    Flicker: _flicker,
    Resonance: _resonance,
    DifferenceNoise: _difference,
    Smoothing: _smoothing,
    HeavyTails: _tails,
    SignalDependentNoise: _signal_dependent,
    Nonlinearity: _nonlinearity,
    ReadingPattern: _pattern,
    ThermalDrift: _thermal,
    SupplyCoupling: _supply,
    Latency: _latency,
    WanderingLine: _wandering,
    PeriodicGlitch: _glitch,
    Popcorn: _popcorn,
    RangeOffset: _between_ranges,
    RangeOverlap: _between_ranges,
    RangeSwitching: _range,
}
