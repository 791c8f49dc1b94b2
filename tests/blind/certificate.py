"""How much a hidden effect can be known: D, in nats, by a likelihood written for this purpose alone.

D = E[log p(readings | plant with the effect)] - E[log p(readings | the best plant without it)]

The best plant is found by refitting all five numbers of the clean plant, so what it absorbs is no part of D. A change
of covariance costs n/2 times the mean over the spectrum of log(S'/S) + S/S' - 1 (asymptotic; S folded, apertures
included); a change of the mean costs half the energy of what the refitted plant's whitening leaves of it (exact).
Shocks and lost readings are left out, except of a change of the mean: there readings that are lost tell nothing, and
shocks come at known instants and fade as the plant's do, but with unknown marks, which the first readings after each
are spent on. Who reads a file does not know the instants, so D is still a little too large, and much where shocks at
any instant can imitate the effect, as they can a step. Kind of D by cause, in KINDS below:

    mean         deterministic, given the draws (phases, temperature, the readings it bends): as above; of what rings
                 after shocks, less what it costs not to know when within an interval each came, which is the wave's
                 phase; of a bent scale, more by what its slope does to the density, and of a range's offset by the
                 hole that it leaves between ranges, or what they share
    covariance   Gaussian: as above; where the noise changes, segment by segment
    path         telegraph noise: by readings that are drawn, the path known to nobody, against the best plant whose
                 shocks, at instants that nobody knows, may be the jumps (see jumps.py; with shocks at known instants
                 and no others, who was never struck was thought to see what shocks imitate to 5 of 30 nats)
    innovation   noise that is not Gaussian or not stationary: as if innovations were independent, with their variance;
                 of the shocks' signs, as far as a reading tells that it was struck and by what; of noise that grows
                 with the reading, given the readings as drawn; of heavy tails no mean, which a few large readings
                 carry, but the D at which a Gaussian ratio is found as often, with the plant's own shocks, whose one
                 law cannot be that of the tails as well (see tails.py)
    counted      nothing is refitted: the effect is seen by counting, and a size is drawn instead of a D

Of two at once each has the D that is left of it where the other is there too, and known:

D = E[log p(readings | plant with both)] - E[log p(readings | the best plant with the other alone)]

As if it were alone it had more: differenced noise at twice the limit took nine tenths of a resonance's, which stands on
it as on the plant's noise. What the other adds to the covariance stays in the refitted plant's spectrum, part of the
record by part where the noise changes, and takes of a mean the share that it takes at its frequencies; a mean that is
known is subtracted, and costs nothing; a quantiser's steps q are white noise of q^2/12.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import exp, log, pi, sqrt

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtri

from tests.blind.gaussian import (
    Disturbances,
    Part,
    disturbances,
    energy,
    markov_spectrum,
    numbers,
    refit,
    same,
    spectrum,
    turns,
)
from tests.blind.injector import AT_INPUT, calm, template
from tests.blind.innovations import innovation_kl, louder_kl
from tests.blind.instants import cost_of_instants, ringing
from tests.blind.jumps import jumps_nats, plain_jump
from tests.blind.plant import Effect, Plant, Run, make_world, supply
from tests.blind.tails import tails_nats

__all__ = ["EXTENDED", "KINDS", "LEVEL", "clairvoyant_d95", "d_nats", "edge_of_range", "size_for", "unit_template"]

LEVEL = 0.003 / 33
"""False-alarm rate of one mechanism, if 0.3 % is shared by 33 of them."""

KINDS = dict.fromkeys(AT_INPUT, "mean") | {
    "resonance": "covariance",
    "difference_noise": "covariance",
    "smoothing": "covariance",
    "popcorn_noise": "path",
    "changing_noise": "covariance",
    "signal_dependent_noise": "innovation",
    "heavy_tails": "innovation",
    "shock_law": "innovation",
    "nonlinearity": "mean",
    "supply_coupling": "mean",
    "range_switching": "mean",
    "reading_pattern": "mean",
    "quantisation": "counted",
    "saturation": "counted",
    "stuck_readings": "counted",
    "replayed_block": "counted",
    "missing_samples": "counted",
    "timestamp_jitter": "counted",
    "clock_error": "counted",
    "dead_band": "counted",
    "ooc_echo": "covariance",
    "ooc_gain_step": "mean",
    "ooc_breath": "covariance",
}


def d_nats(run: Run, effect: Effect, shown: "Shown | None" = None, beside: Sequence[Effect] = ()) -> float:
    """Return D of an effect in a run that is clean but for what is `beside` it, and known; NaN where it is counted.

    `shown` is what one unit of it shows, where that is known from another size of it.

    Raises:
        ValueError: of this kind, or beside that one, nobody has written D of two.
    """
    plant, n = run.plant, run.plant.n
    kind, theta = KINDS[effect.cause], numbers(plant)
    if kind == "counted":
        return float("nan")
    if beside and kind not in ("mean", "covariance"):
        raise ValueError(f"{effect.cause}: D beside another effect is not written")
    if effect.cause == "signal_dependent_noise":
        return louder_kl(run, effect)
    if effect.cause == "heavy_tails":
        return tails_nats(run, effect, LEVEL / 2)
    if kind == "innovation":
        return n * innovation_kl(plant, effect, len(make_world(run).shocks))
    clean_s, known = spectrum(theta, plant), [WHOLE]
    for other in beside:
        known = [both(one, more) for one in known for more in covariance(plant, other)]
    if kind == "path":
        shown = shown or show(run, effect)
        return jumps_nats(shown.unit, effect, plant, shown.beside)
    if kind == "mean":
        shown = shown or show(run, effect)
        parts = [Part(share, change(clean_s), change) for share, change in known]
        d = refit(theta, plant, parts, effect.size * shown.unit, shown.beside)
        if shown.instants is not None:
            d -= cost_of_instants(*shown.instants, effect.size)
        return d + effect.size**2 * shown.slope + effect.size * shown.edge
    parts = [
        Part(share * part, change(other(clean_s)), other)
        for share, other in known
        for part, change in covariance(plant, effect)
    ]
    return refit(theta, plant, parts, None)


Change = tuple[float, Callable[[np.ndarray], np.ndarray]]
"""A share of the record, and what becomes of the spectrum there."""
WHOLE: Change = (1.0, same)


def both(first: Change, second: Change) -> Change:
    """Return two changes, one upon the other, in the share that they have in common if neither tells of the other."""
    if first is WHOLE:
        return second
    return first[0] * second[0], lambda s: second[1](first[1](s))


def covariance(plant: Plant, effect: Effect) -> list[Change]:
    """Return what an effect that is there makes of the spectrum: nothing, if it is a mean, which is subtracted."""

    def louder(variance_V2: float) -> Callable[[np.ndarray], np.ndarray]:
        return lambda s: s + variance_V2

    if KINDS[effect.cause] == "mean":
        return [WHOLE]
    if effect.cause == "quantisation":
        return [(1.0, louder(effect.size**2 / 12))]
    if effect.cause == "changing_noise":
        part = effect.shape["end"] - effect.shape["begin"]
        return [(1 - part, same), (part, louder((effect.size**2 - 1) * plant.white_sd_V**2))]
    if effect.cause == "ooc_breath":  # a sine's turn by six of its instants, of which four differ
        turn = ((1 / 3, 0.5), (1 / 3, -0.5), (1 / 6, 1.0), (1 / 6, -1.0))
        return [(part, louder(plant.white_sd_V**2 * (exp(2 * effect.size * at) - 1))) for part, at in turn]
    if effect.cause in EXTENDED:
        return [(1.0, lambda s: EXTENDED[effect.cause](s, effect, plant))]
    raise ValueError(f"{effect.cause}: what it makes of the spectrum beside another effect is not written")


def size_for(
    d_target: float, run: Run, effect: Effect, low: float, high: float, beside: Sequence[Effect] = ()
) -> Effect | None:
    """Return the effect with the size that has this D, within a range; None where no size there has it.

    Beside others, whose sizes are sought in turn with its own, the search begins at the size that it has.
    """
    shown = None
    if KINDS[effect.cause] in ("mean", "path"):
        shown = show(run, effect)
        if not shown.unit.any():
            return None  # such as a ring-down without a shock

    least = 0.1 if KINDS[effect.cause] == "path" else 1e-9  # of noise that is drawn less tells no slope

    def excess(log_size: float) -> float:
        return log(max(d_nats(run, replace(effect, size=exp(log_size)), shown, beside), least)) - log(d_target)

    at, slope = log(effect.size) if beside else first_guess(d_target, run, effect, shown, low, high), 2.0
    beyond = excess(at)
    for _ in range(8):  # secant steps, for a curve that is nearly straight in logarithms
        if abs(beyond) < 0.03:
            return replace(effect, size=exp(at)) if low <= exp(at) <= high else None
        last, was = at, beyond
        at = last - min(max(beyond / slope, -3.0), 3.0)
        if not log(low) - 1 < at < log(high) + 1:
            break
        beyond = excess(at)
        slope = min(max((beyond - was) / (at - last), 0.5), 8.0)
    if excess(log(high)) < 0 or excess(log(low)) > 0:
        return None
    return replace(effect, size=exp(brentq(excess, log(low), log(high), xtol=0.01)))


def first_guess(d_target: float, run: Run, effect: Effect, shown: "Shown | None", low: float, high: float) -> float:
    """Return the logarithm of a size to begin with: of the mean, what would do if nothing were refitted."""
    if shown is None:
        return (log(low) + log(high)) / 2
    if KINDS[effect.cause] == "path":  # of smaller jumps D is about 0, which tells no slope
        return log(plain_jump(run.plant))
    known = energy(numbers(run.plant), run.plant, shown.unit, shown.beside)
    return log(2 * d_target / max(known, 1e-300)) / 2


def clairvoyant_d95(cause: str, n: int, level: float = LEVEL) -> float:
    """Return the D at which who knows the family and the plant detects in 95 %: (u + 1.645)^2/2.

    u is the threshold of one standard normal number, or for a line of the root of twice an exponential one, after as
    many independent looks as the family's grid has; those numbers are estimates of the grids' sizes.
    """
    looks, line = LOOKS.get(cause, (1.0, False))
    looks = looks if looks < 1e3 else looks / 1e3 * n
    threshold = sqrt(2 * log(looks / level)) if line else -ndtri(level / (2 * looks))
    return float((threshold + 1.645) ** 2 / 2)


LOOKS = {  # (looks, whether it has two quadratures); from 1000 on in thousandths of the readings
    "mains_alias": (6.0, True),
    "periodic_interference": (1e3, True),
    "wandering_line": (30e3, True),
    "periodic_glitch": (30e3, False),
    "resonance": (200.0, False),
    "step": (0.1e3 + 900, False),
    "ring_down": (500.0, True),
    "thermal_drift": (10.0, False),
    "latency": (10.0, False),
    "range_switching": (1e3, False),  # the threshold may lie between any two readings
    "supply_coupling": (2.0, False),
    "warmup_drift": (10.0, False),
    "changing_noise": (50.0, False),
    "popcorn_noise": (20.0, False),
}


@dataclass(frozen=True)
class Shown:
    """What one unit of an effect adds to each reading, and what else happens to them."""

    unit: np.ndarray
    beside: Disturbances
    slope: float = 0.0
    """Nats of a unit's square beside the mean's: of a bent scale, see `show`."""
    edge: float = 0.0
    """Nats of a unit beside these: of a wider range's offset, see `edge_of_range`."""
    instants: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    """Of what follows shocks whose instants nobody knows; see `ringing` of instants.py."""


def show(run: Run, effect: Effect) -> Shown:
    """Return what a unit of an effect shows.

    A bent scale y = x + b x^2 shows more than its mean: where its slope is large so is the density of x, and of the
    logarithm of 1 + 2 b x the mean is -2 b^2 times the variance of x. The nearest Gaussian process has what this adds
    to the covariance, so all of it is left. (The likelihood came to that, within a nat, on 26 records of 55 nats.)
    """
    unit, beside = unit_template(run, effect), disturbances(run)
    if effect.cause == "nonlinearity":
        return Shown(unit, beside, slope=2 * float(np.sum(squared_deviation(run))))
    if effect.cause == "range_switching":
        return Shown(unit, beside, edge=edge_of_range(run, effect))
    if effect.cause == "ring_down":
        return Shown(unit, beside, instants=ringing(run, effect, beside))
    return Shown(unit, beside)


def squared_deviation(run: Run) -> np.ndarray:
    value = calm(run)
    return (value - value.mean()) ** 2


def edge_of_range(run: Run, effect: Effect) -> float:
    """Return the nats that a volt of the wider range's offset shows where the ranges meet.

    Which reading is offset depends on the reading itself: of the log ratio y'C^-1 m + m'C^-1 m/2 the first part's mean
    is no more 0 but the sum of dm/dy (Stein's lemma), which is the offset times the density of readings at the
    threshold. An offset away from the other range leaves a hole there, where so many readings are missing, and one
    towards it a part that both share: so many less for the mean, but the density there is twice the plant's, which is
    ln 2 for each of twice as many. The density is that of the readings as drawn, smoothed a little.
    """
    value, width_V = calm(run), run.plant.white_sd_V / 5
    threshold_V = float(np.quantile(np.abs(value), effect.shape["part"]))
    away, towards = (
        float(np.sum(np.exp(-(((sign * value - threshold_V) / width_V) ** 2) / 2)) / (width_V * sqrt(2 * pi)))
        for sign in (1, -1)
    )
    return away + (2 * log(2) - 1) * towards


def unit_template(run: Run, effect: Effect) -> np.ndarray:
    if effect.cause in AT_INPUT:
        return template(run, effect)
    if effect.cause == "reading_pattern":
        return (np.arange(run.plant.n) % int(effect.shape["period_readings"]) == 0).astype(float)
    value = calm(run)
    if effect.cause == "supply_coupling":
        return value * (supply(make_world(run)) - 5)
    if effect.cause == "range_switching":
        return (np.abs(value) >= np.quantile(np.abs(value), effect.shape["part"])).astype(float)
    deviation = value - value.mean()
    if effect.cause == "ooc_gain_step":
        return np.where(np.arange(run.plant.n) * run.plant.interval_s >= effect.shape["time_s"], deviation, 0.0)
    return deviation**2 - np.mean(deviation**2)  # nonlinearity


def with_resonance(s: np.ndarray, effect: Effect, plant: Plant) -> np.ndarray:
    f, quality = effect.shape["frequency_hz"], effect.shape["quality"]
    keep, turn = exp(-np.pi * f / quality * plant.interval_s), 2 * np.pi * f * plant.interval_s
    seen = np.sinc(f * plant.inside * plant.step_s) ** 2
    both = markov_spectrum(keep, turns(plant) - turn) + markov_spectrum(keep, turns(plant) + turn)
    return s + effect.size**2 * seen * both / 2


EXTENDED: dict[str, Callable[[np.ndarray, Effect, Plant], np.ndarray]] = {
    "resonance": with_resonance,
    "difference_noise": lambda s, effect, plant: s + effect.size**2 * (2 - 2 * np.cos(turns(plant))),
    "smoothing": lambda s, effect, plant: (
        s * (1 - effect.size) ** 2 / (1 - 2 * effect.size * np.cos(turns(plant)) + effect.size**2)
    ),
    "ooc_echo": lambda s, effect, plant: (
        s * (1 + 2 * effect.size * np.cos(effect.shape["lag_readings"] * turns(plant)) + effect.size**2)
    ),
}
