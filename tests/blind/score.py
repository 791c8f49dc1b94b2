"""From sealed truth and answers to figures; nothing here decides what counts as found after having seen it.

found      the critic said anything that is not exempt (a loss that is truly in the file is no false alarm)
named      the most probable name of the first finding that is not exempt is the truth
in set     the truth is among the names of some finding
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import comb
from statistics import mean, median
from typing import Any

import numpy as np

from tests.blind.certificate import KINDS
from tests.blind.envelope import Envelope
from tests.blind.harness import Answer
from tests.blind.plant import Effect, Plant
from tests.blind.rivals import TOLD_APART, rival_nats

__all__ = [
    "ALONE",
    "Pair",
    "Row",
    "both_named",
    "clean_alarms",
    "confident_wrong",
    "confusion",
    "coverage",
    "found",
    "in_set",
    "leak",
    "named",
    "rows",
    "share_band",
    "told_apart",
]

ALONE = ("single", "ladder")
"""Groups in which one effect of the catalogue is hidden."""

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
    by_factor: dict[float, tuple[int, int]]
    """Found, by amplitude over the clairvoyant's; 0 where the effect is counted."""
    named: tuple[int, int]
    in_set: tuple[int, int]
    probability: float
    """Mean probability given to the truth, where something was found."""
    gain: tuple[float, float, int]
    """Median held-out gain and median D, nats, over runs with D >= 30 named right; how many."""
    baseline: tuple[int, int]


def rows(pairs: Sequence[Pair], covered: Sequence[str]) -> list[Row]:
    """Return a row for each mechanism that was hidden alone."""
    alone = [pair for pair in pairs if pair.envelope.group in ALONE]
    made = []
    for cause in sorted({pair.causes[0] for pair in alone}):
        mine = [pair for pair in alone if pair.causes[0] == cause]
        heard = [pair for pair in mine if found(pair)]
        gains = [
            (pair.findings[0]["gain"]["nats_total"], pair.envelope.d_nats[0])
            for pair in heard
            if named(pair) and pair.envelope.d_nats[0] >= 30
        ]
        made.append(
            Row(
                cause,
                cause in covered,
                KINDS[cause],
                {
                    factor: share(found, [pair for pair in mine if pair.envelope.factor == factor])
                    for factor in sorted({pair.envelope.factor for pair in mine})
                },
                share(named, heard),
                share(in_set, heard),
                mean(pair.findings[0]["probability"] * named(pair) for pair in heard) if heard else float("nan"),
                (median(g for g, _ in gains), median(d for _, d in gains), len(gains)) if gains else (0.0, 0.0, 0),
                share(lambda pair: bool(pair.answer.baseline), mine),
            )
        )
    return made


def share(holds: Callable[[Pair], bool], pairs: Sequence[Pair]) -> tuple[int, int]:
    return sum(map(holds, pairs)), len(pairs)


def clean_alarms(pairs: Sequence[Pair]) -> dict[str, tuple[int, int]]:
    """Return alarms of runs in which nothing, or nothing that could be seen, is hidden, by group."""
    return {
        group: share(found, [pair for pair in pairs if pair.envelope.group == group])
        for group in ("clean", "provocative", "below")
    }


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


def told_apart(pairs: Sequence[Pair]) -> list[tuple[Pair, float, str]]:
    """Return, of what was found of effects hidden alone, where names can be told apart, with D and the rival's name."""
    alone = [pair for pair in pairs if pair.envelope.group in ALONE and found(pair)]
    rivals = [(pair, rival_nats(pair.envelope.run, pair.envelope.run.effects[0])) for pair in alone]
    return [(pair, *rival) for pair, rival in rivals if rival is not None and rival[0] >= TOLD_APART]


def confusion(pairs: Sequence[Pair]) -> dict[str, Counter[str]]:
    """Return what each mechanism, hidden alone or outside the catalogue, was called first."""
    table: dict[str, Counter[str]] = {}
    for pair in pairs:
        if pair.envelope.group in (*ALONE, "outside"):
            said = pair.findings[0]["cause"] if pair.findings else "(nothing)"
            table.setdefault(pair.causes[0], Counter())[said] += 1
    return table


def coverage(pairs: Sequence[Pair]) -> dict[str, tuple[int, int]]:
    """Return, by `cause: parameter`, how often the 95 % interval of a right name holds the truth."""
    table: dict[str, tuple[int, int]] = {}
    for pair in pairs:
        for effect in pair.envelope.run.effects:
            for item in pair.findings:
                if item["cause"] != effect.cause:
                    continue
                for name, truth in true_parameters(effect, pair.envelope.run.plant).items():
                    told = item["parameters"].get(name)
                    if told is not None and told["high"] > told["low"]:
                        hits, tries = table.get(f"{effect.cause}: {name}", (0, 0))
                        table[f"{effect.cause}: {name}"] = (hits + (told["low"] <= truth <= told["high"]), tries + 1)
    return table


def true_parameters(effect: Effect, plant: Plant) -> dict[str, float]:
    """Return the truth of what a finding may tell, as the readings show it."""
    seen = np.sinc(effect.shape.get("frequency_hz", 0.0) * plant.inside * plant.step_s)
    line = {"amplitude_V": effect.size * abs(float(seen))}
    return {
        "mains_alias": {
            "mains_hz": effect.shape.get("frequency_hz", 0.0),
            "alias_hz": effect.shape.get("alias_hz", 0.0),
        }
        | line,
        "periodic_interference": {"frequency_hz": effect.shape.get("frequency_hz", 0.0)} | line,
        "resonance": {"frequency_hz": effect.shape.get("frequency_hz", 0.0)},
        "difference_noise": {"sd_V": effect.size},
        "step": {"time_s": effect.shape.get("time_s", 0.0), "step_V": effect.size},
        "supply_coupling": {"coefficient_per_V": effect.size},
        "thermal_drift": {"coefficient_V_per_C": effect.size, "lag_s": effect.shape.get("lag_s", 0.0)},
        "warmup_drift": {"tau_s": effect.shape.get("tau_s", 0.0), "amplitude_V": effect.size},
        "popcorn_noise": {"step_V": effect.size},
        "ring_down": {
            "frequency_hz": effect.shape.get("frequency_hz", 0.0),
            "decay_s": effect.shape.get("decay_s", 0.0),
        },
        "periodic_glitch": {"period_s": effect.shape.get("period_s", 0.0), "amplitude_V": effect.size},
    }.get(effect.cause, {})


def leak(pairs: Sequence[Pair]) -> dict[str, float]:
    """Return how well what surrounds the readings tells clean files from others: areas under the curve, 0.5 is chance.

    Ladder runs are left out. Length, rate and the like are drawn before what is hidden, but drawn again where a plant
    could not carry it.
    """
    mixed = [pair for pair in pairs if pair.envelope.group != "ladder"]
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
    """Return the 95 % interval of a share, by the exact binomial tails (Clopper and Pearson, 1934), by bisection."""

    def at_least(p: float) -> float:
        return sum(comb(tries, k) * p**k * (1 - p) ** (tries - k) for k in range(hits, tries + 1))

    def solve(target: float, tail: Callable[[float], float]) -> float:
        low, high = 0.0, 1.0
        for _ in range(50):
            middle = (low + high) / 2
            low, high = (middle, high) if tail(middle) < target else (low, middle)
        return low

    low = solve(0.025, at_least) if hits else 0.0
    high = solve(0.975, lambda p: at_least(p) - comb(tries, hits) * p**hits * (1 - p) ** (tries - hits))
    return low, (high if hits < tries else 1.0)
