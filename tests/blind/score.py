"""From sealed truth and answers to figures; nothing here decides what counts as found after having seen it.

found      the critic said anything that is not exempt (a loss that is truly in the file is no false alarm)
named      the most probable name of the first finding that is not exempt is the truth
in set     the truth is among the names of some finding
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import exp, log10, nan, pi, sqrt
from statistics import mean
from typing import Any

import numpy as np
from scipy.stats import beta, binom

from tests.blind.certificate import KINDS
from tests.blind.envelope import FACTORS, STRONG, Envelope
from tests.blind.gaussian import numbers
from tests.blind.harness import Answer
from tests.blind.plant import Effect, Plant, Run, make_world, supply
from tests.blind.rivals import TOLD_APART

__all__ = [
    "ALONE",
    "CELLS",
    "SILENT",
    "Pair",
    "Row",
    "Share",
    "at_odds",
    "both_named",
    "by_mechanism",
    "cell_alarms",
    "clean_alarms",
    "confident_wrong",
    "confusion",
    "coverage",
    "flagged",
    "found",
    "in_band",
    "in_set",
    "leak",
    "loud",
    "named",
    "oracle_ratio",
    "pooled",
    "probability_of_truth",
    "rows",
    "rung",
    "share",
    "share_band",
    "strong",
    "told_apart",
]

Share = tuple[int, int]
"""Hits and tries."""
ALONE = ("single", "ladder")
"""Groups in which one effect of the catalogue is hidden, of some multiple of the clairvoyant's amplitude."""
SILENT = ("clean", "provocative")

SURE = 0.9  # probability from which a name is a confident one


@dataclass(frozen=True)
class Pair:
    """A run's truth beside what was said of it."""

    envelope: Envelope
    answer: Answer

    @property
    def causes(self) -> tuple[str, ...]:
        return tuple(effect.cause for effect in self.envelope.run.effects)

    @property
    def findings(self) -> list[dict[str, Any]]:
        """Findings, without a true loss that is not what was hidden."""
        lossy = self.envelope.run.plant.lost_fraction > 0 and "missing_samples" not in self.causes
        return [item for item in self.answer.findings if not (lossy and item["cause"] == "missing_samples")]


def found(pair: Pair) -> bool:
    return bool(pair.findings)


def named(pair: Pair) -> bool:
    return bool(pair.findings) and pair.findings[0]["cause"] == pair.causes[0]


def in_set(pair: Pair) -> bool:
    return any(pair.causes[0] in item["names"] for item in pair.findings)


@dataclass(frozen=True)
class Row:
    """One mechanism: shares as (hits, tries)."""

    cause: str
    covered: bool
    kind: str
    by_factor: dict[float, Share]
    """Found, by the rung of its amplitude over the clairvoyant's; 0 where the effect is counted."""
    named: Share
    """Of what was found."""
    in_set: Share
    probability: float
    """Mean probability given to the truth, where something was found."""
    apart: Share
    """Named, of what was found and is far enough from its nearest rival."""
    baseline: Share


def rows(pairs: Sequence[Pair], covered: Sequence[str]) -> list[Row]:
    """Return a row for each mechanism that was hidden alone."""
    alone = [pair for pair in pairs if pair.envelope.group in ALONE]
    made = []
    for cause in sorted({pair.causes[0] for pair in alone}):
        mine = [pair for pair in alone if pair.causes[0] == cause]
        heard = [pair for pair in mine if found(pair)]
        made.append(
            Row(
                cause,
                cause in covered,
                KINDS[cause],
                {
                    factor: share(found, [pair for pair in mine if rung(pair) == factor])
                    for factor in sorted({rung(pair) for pair in mine})
                },
                share(named, heard),
                share(in_set, heard),
                mean(probability_of_truth(pair) for pair in heard) if heard else nan,
                share(named, [pair for pair in heard if is_apart(pair)]),
                share(lambda pair: bool(pair.answer.baseline), mine),
            )
        )
    return made


def loud(pairs: Sequence[Pair]) -> dict[str, list[Pair]]:
    """Return, by mechanism, the runs at which power is owed: those at LADDER, and all where the effect is counted."""
    owed = [pair for pair in pairs if pair.envelope.group == "ladder"]
    return {cause: [pair for pair in owed if pair.causes[0] == cause] for cause in sorted({p.causes[0] for p in owed})}


def rung(pair: Pair) -> float:
    """Return the highest of FACTORS that an effect's reaches, within a hundredth, or the least; 0 where it has none."""
    own = pair.envelope.factor
    return max((factor for factor in FACTORS if factor <= 1.01 * own), default=FACTORS[0]) if own else 0.0


def strong(pairs: Sequence[Pair]) -> list[Pair]:
    """Return the runs with one effect of STRONG times the clairvoyant's amplitude or more."""
    return [pair for pair in pairs if pair.envelope.group == "single" and pair.envelope.factor >= STRONG]


def probability_of_truth(pair: Pair) -> float:
    """Return the probability that the first finding gives to the truth; 0 where it has another name."""
    return float(pair.findings[0]["probability"]) if named(pair) else 0.0


def share(holds: Callable[[Pair], bool], pairs: Sequence[Pair]) -> Share:
    return sum(map(holds, pairs)), len(pairs)


def at_odds(share: Share, owed: float, mass: float) -> bool:
    """Return whether so few hits lie outside the binomial law's central part of this mass; its upper end is no fault.

    >>> at_odds((25, 30), 0.95, 0.999), at_odds((20, 30), 0.95, 0.999)
    (False, True)
    """
    return share[1] > 0 and bool(binom.cdf(share[0], share[1], owed) < (1 - mass) / 2)


def in_band(share: Share, owed: float, mass: float = 0.999) -> bool:
    """Return whether a share lies inside the central part of the binomial law of what is owed."""
    low, high = binom.interval(mass, share[1], owed) if share[1] else (0, 0)
    return bool(low <= share[0] <= high)


def clean_alarms(pairs: Sequence[Pair]) -> dict[str, Share]:
    """Return alarms of runs in which nothing, or nothing that could be seen, is hidden, by group."""
    return {
        group: share(found, [pair for pair in pairs if pair.envelope.group == group]) for group in (*SILENT, "below")
    }


def cell_alarms(pairs: Sequence[Pair]) -> dict[str, Share]:
    """Return alarms of clean runs by what their plants have in common."""
    silent = [pair for pair in pairs if pair.envelope.group in SILENT]
    return {name: share(found, [pair for pair in silent if within(pair.envelope)]) for name, within in CELLS.items()}


def signal_share(plant: Plant) -> tuple[float, float, float]:
    """Return the logarithms, of base 10, of what draw_plant draws: time constant, white noise and drift rate."""
    unit_V = plant.signal_sd_V
    rate = plant.drift_rate_V_per_rt_s / (unit_V * sqrt(2 / plant.drift_tau_s))
    return log10(plant.signal_tau_s), log10(plant.white_sd_V / unit_V), log10(rate)


USUAL = ((-0.6, 0.3), (-0.6, 0.1), (-0.5, 0.5))
"""Where these lie in a plant that is not provocative."""


def is_less(plant: Plant) -> bool:
    return any(value < low for value, (low, _) in zip(signal_share(plant), USUAL, strict=True))


def is_more(plant: Plant) -> bool:
    return any(value > high for value, (_, high) in zip(signal_share(plant), USUAL, strict=True))


CELLS: Mapping[str, Callable[[Envelope], bool]] = {
    "500 to 1,000 readings": lambda e: e.run.plant.n <= 1000,
    "1,500 to 9,000 readings": lambda e: 1000 < e.run.plant.n <= 9000,
    "20,000 to 100,000 readings": lambda e: e.run.plant.n > 9000,
    "no gaps": lambda e: e.run.plant.lost_fraction == 0,
    "gaps, 2 % lost": lambda e: 0 < e.run.plant.lost_fraction < 0.05,
    "gaps, 5 % lost": lambda e: e.run.plant.lost_fraction >= 0.05,
    "no shocks": lambda e: e.run.plant.shocks_per_s == 0,
    "up to 3 shocks a minute": lambda e: 0 < 60 * e.run.plant.shocks_per_s < 5.99,
    "6 loud shocks a minute": lambda e: 60 * e.run.plant.shocks_per_s >= 5.99,
    "numbers of the plant as usual": lambda e: not is_less(e.run.plant) and not is_more(e.run.plant),
    "a number of the plant a tenth of the usual": lambda e: is_less(e.run.plant),
    "a number of the plant ten times the usual": lambda e: is_more(e.run.plant),
    "with a thermometer and a supply beside it": lambda e: e.run.plant.witness,
    "a table": lambda e: e.suffix == ".csv",
    "a recording": lambda e: e.suffix == ".mcap",
}
"""Groups of clean runs; a run is in one of each kind, and may be a tenth in one number and tenfold in another."""


def confident_wrong(pairs: Sequence[Pair]) -> tuple[int, int]:
    """Return how often something outside the catalogue got one name of it with confidence."""
    outside = [pair for pair in pairs if pair.envelope.group == "outside"]
    return share(
        lambda pair: any(
            item["cause"] != "unexplained" and len(item["names"]) == 1 and item["probability"] >= SURE
            for item in pair.findings
        ),
        outside,
    )


def both_named(pairs: Sequence[Pair]) -> tuple[int, int]:
    """Return how often both of two effects were named."""
    double = [pair for pair in pairs if pair.envelope.group == "double"]
    return share(lambda pair: set(pair.causes) <= {item["cause"] for item in pair.findings}, double)


def is_apart(pair: Pair) -> bool:
    """Return whether the truth can be told from what else looks like it; what is counted always can."""
    if KINDS[pair.causes[0]] == "counted":
        return True
    return pair.answer.rival is not None and pair.answer.rival[0] >= TOLD_APART


def told_apart(pairs: Sequence[Pair]) -> list[Pair]:
    """Return, of what was found of effects hidden alone, where names can be told apart."""
    return [pair for pair in pairs if pair.envelope.group in ALONE and found(pair) and is_apart(pair)]


def flagged(pairs: Sequence[Pair]) -> Share:
    """Return how often what is outside the catalogue was called unexplained, alone or beside other names."""
    outside = [pair for pair in pairs if pair.envelope.group == "outside"]
    return share(lambda pair: any("unexplained" in item["names"] for item in pair.findings), outside)


def oracle_ratio(pairs: Sequence[Pair]) -> tuple[float, float, int]:
    """Return the held-out nats gained and those that the oracle gains on the same blocks of the same readings; runs.

    All runs, whatever they were called and whether anything was found: what was not found gained nothing.
    """
    known = [pair for pair in pairs if pair.answer.oracle_nats is not None]
    gained = sum(item["gain"]["nats_total"] for pair in known for item in pair.findings)
    return gained, sum(pair.answer.oracle_nats or 0.0 for pair in known), len(known)


def confusion(pairs: Sequence[Pair]) -> dict[str, Counter[str]]:
    """Return what each mechanism, hidden alone or outside the catalogue, was called first."""
    table: dict[str, Counter[str]] = {}
    for pair in pairs:
        if pair.envelope.group in (*ALONE, "outside"):
            said = pair.findings[0]["cause"] if pair.findings else "(nothing)"
            table.setdefault(pair.causes[0], Counter())[said] += 1
    return table


def coverage(pairs: Sequence[Pair]) -> dict[tuple[str, str], Share]:
    """Return, by cause and parameter, how often the 95 % interval of a right name holds the truth."""
    table: dict[tuple[str, str], Share] = {}
    for pair in pairs:
        for effect in pair.envelope.run.effects:
            truths = true_parameters(effect, pair.envelope.run)
            for item in pair.findings:
                if item["cause"] != effect.cause:
                    continue
                for name, truth in truths.items():
                    told = item["parameters"].get(name)
                    if told is not None and told["high"] > told["low"]:
                        hits, tries = table.get((effect.cause, name), (0, 0))
                        table[effect.cause, name] = hits + (told["low"] <= truth <= told["high"]), tries + 1
    return table


def by_mechanism(table: Mapping[tuple[str, str], Share]) -> dict[str, Share]:
    """Return the shares of a table of parameters pooled over those of each mechanism."""
    causes = sorted({cause for cause, _ in table})
    return {cause: pooled(value for (of, _), value in table.items() if of == cause) for cause in causes}


def pooled(shares: Iterable[Share]) -> Share:
    shares = list(shares)
    return sum(hits for hits, _ in shares), sum(tries for _, tries in shares)


def true_parameters(effect: Effect, run: Run) -> dict[str, float]:
    """Return the truth of what a finding tells with an interval, as the readings show it.

    One number is counted once: an alias and the mains behind it, or a filter's share and its time constant, are the
    same. Of heavy tails there is no truth: two normal laws stand for Student's.
    """
    plant, shape, size = run.plant, effect.shape, effect.size
    frequency = {"frequency_hz": shape.get("frequency_hz", 0.0)}
    # What an aperture lets through of a wave, of which the readings are all that a finding knows.
    seen = size * abs(float(np.sinc(frequency["frequency_hz"] * plant.inside * plant.step_s)))
    truth: dict[str, dict[str, float]] = {
        "mains_alias": {"mains_hz": frequency["frequency_hz"], "amplitude_V": seen},
        "periodic_interference": frequency | {"amplitude_V": seen},
        "resonance": frequency | {"sd_V": seen, "quality": shape.get("quality", 0.0)},
        "difference_noise": {"sd_V": size},
        "smoothing": {"fraction": size},
        "popcorn_noise": {"step_V": size, "dwell_s": shape.get("dwell_s", 0.0), "fraction": 0.5},
        "signal_dependent_noise": {"fraction": size},
        "shock_law": {"fraction": (1 + size) / 2},  # so many are made positive, of the others half are
        "ring_down": frequency | {"decay_s": shape.get("decay_s", 0.0), "ratio": size},
        "step": {"step_V": size},
        "thermal_drift": {"coefficient_V_per_C": size, "lag_s": shape.get("lag_s", 0.0)},
        "periodic_glitch": {"amplitude_V": size},
        "range_switching": {"offset_V": size},
        "nonlinearity": {"coefficient_per_V": size},
        "reading_pattern": {"amplitude_V": size / 2},  # half from lowest to highest
        "dead_band": {"width_V": size},
        "clock_error": {"ratio": 1 + 1e-6 * size},
        "timestamp_jitter": {"sd_s": size * sqrt(1 - 2 / pi)},  # of |N(0, 1)|: the stamps are late, never early
    }.get(effect.cause, {})
    if effect.cause == "wandering_line":  # told at the first reading, whose middle is half an aperture after the start
        first_hz = frequency["frequency_hz"] + shape["sweep_hz_per_s"] * plant.aperture_s / 2
        truth = {"frequency_hz": first_hz, "chirp_hz_per_s": shape["sweep_hz_per_s"], "amplitude_V": seen}
    if effect.cause == "warmup_drift":
        truth = {"tau_s": shape["tau_s"], "amplitude_V": size * exp(-plant.aperture_s / 2 / shape["tau_s"])}
    if effect.cause == "latency":  # the injector is late by whole readings
        late_s = round(shape["lag_s"] / plant.interval_s) * plant.interval_s
        truth = {"coefficient_V_per_C": size, "lag_s": late_s}
    if effect.cause == "supply_coupling":  # told about the supply's mean, hidden about 5 V
        truth = {"coefficient_per_V": size / (1 + size * float(np.mean(supply(make_world(run)) - 5)))}
    if effect.cause == "changing_noise":
        # Told of what neighbours do not share, of which the processes' averaging over an aperture took some.
        alone = exp(float(numbers(plant)[4]))
        truth = {"ratio": sqrt(1 + (size**2 - 1) * plant.white_sd_V**2 / alone)}
    return truth


NEEDY = (
    "thermal_drift",
    "latency",
    "supply_coupling",
    "clock_error",
    "ring_down",
    "shock_law",
    "popcorn_noise",
    "heavy_tails",
)


def leak(pairs: Sequence[Pair]) -> dict[str, float]:
    """Return how well what surrounds the readings tells clean files from others: areas under the curve, 0.5 is chance.

    Of what is drawn as the clean ones are; mechanisms that need a thermometer, a format, shocks, or a long record, as
    tails and the shocks' signs do, are left out, as those are drawn again until there is one.
    """
    mixed = [pair for pair in pairs if pair.envelope.group != "gain" and not {*pair.causes} & {*NEEDY}]
    hidden = np.array([bool(pair.causes) for pair in mixed if pair.envelope.group != "provocative"])
    plants = [pair.envelope for pair in mixed if pair.envelope.group != "provocative"]
    features = {
        "readings": [envelope.run.plant.n for envelope in plants],
        "interval": [envelope.run.plant.interval_s for envelope in plants],
        "format": [envelope.suffix == ".csv" for envelope in plants],
        "thermometer": [envelope.run.plant.witness for envelope in plants],
    }
    areas = {}
    for name, values in features.items():
        column = np.array(values, dtype=float)
        above = np.sign(np.subtract.outer(column[hidden], column[~hidden]))
        areas[name] = float(np.mean(above) / 2 + 0.5) if above.size else float("nan")
    return areas


def share_band(hits: int, tries: int) -> tuple[float, float]:
    """Return the 95 % interval of a share, by the exact binomial tails (Clopper and Pearson, 1934).

    >>> [round(end, 4) for end in share_band(0, 100)]
    [0.0, 0.0362]
    """
    low = float(beta.ppf(0.025, hits, tries - hits + 1)) if hits else 0.0
    high = float(beta.ppf(0.975, hits + 1, tries - hits)) if hits < tries else 1.0
    return low, high
