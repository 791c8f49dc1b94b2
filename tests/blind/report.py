"""The figures as a page that a person reads and a release keeps: what is owed first, then where each comes from."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isnan, sqrt
from statistics import mean, median

from tests.blind.certificate import LEVEL
from tests.blind.envelope import FACTORS, LADDER, STRONG
from tests.blind.rivals import TOLD_APART
from tests.blind.score import (
    ALONE,
    SILENT,
    Pair,
    Row,
    Share,
    at_odds,
    both_named,
    by_mechanism,
    cell_alarms,
    clean_alarms,
    confident_wrong,
    confusion,
    coverage,
    flagged,
    found,
    in_band,
    in_set,
    leak,
    loud,
    named,
    oracle_ratio,
    pooled,
    probability_of_truth,
    rows,
    rung,
    share,
    share_band,
    strong,
    told_apart,
)

__all__ = ["write_report"]


@dataclass(frozen=True)
class Owed:
    """A figure, what it came to, what was promised of it, and whether that was kept."""

    what: str
    came_to: str
    target: str
    met: bool | None
    """None where there is no run to tell."""


def write_report(pairs: Sequence[Pair], *, sealed: int, salt: str, key_hash: str, covered: Sequence[str]) -> str:
    """Return the report as Markdown.

    Args:
        pairs: of the envelopes that were run.
        sealed: how many there are in the key.
        salt: that makes the key again.
        key_hash: of the key.
        covered: mechanisms that the critic looks for.
    """
    by_row = rows(pairs, covered)
    failed = sorted({pair.answer.verdict for pair in pairs if pair.answer.verdict.startswith("failed")})
    ran = f"all {sealed}" if len(pairs) == sealed else f"{len(pairs)} of {sealed}, as they came in a shuffled order,"
    areas = ", ".join(f"{name} {area:.2f}" for name, area in leak(pairs).items())
    sections = [
        "# Blind injection",
        "",
        f"Envelopes sealed with the salt `{salt}`, key SHA-256",
        f"`{key_hash}` (made before the first run; the same salt and mix make it again);",
        f"{ran} were run. The injector shares no code with the critic. What each figure means: tests/blind/score.py;",
        "how D is computed, mechanism by mechanism: tests/blind/certificate.py. In brackets: exact 95 % interval.",
        "",
        *table(("figure", "came to", "owed", ""), (cells(item) for item in owed(pairs, by_row))),
        "",
        f"Crashes: {len(failed)}{': ' if failed else ''}{'; '.join(failed[:3])}. Leak probe, areas under the curve of",
        f"what surrounds the readings (0.5 is chance): {areas}.",
        "",
        *false_alarms(pairs),
        *powers(pairs, by_row),
        *names(pairs),
        *intervals(pairs),
        *gains(pairs),
        "## Misses, each",
        "",
        *table(("run", "hidden", "D", "of the clairvoyant's amplitude", "readings", "said"), misses(pairs)),
        "",
    ]
    return "\n".join(sections)


# --- what is owed ----------------------------------------------------------------------------------------------------


def owed(pairs: Sequence[Pair], by_row: Sequence[Row]) -> Iterable[Owed]:
    """Yield each figure that was promised."""
    silent = pooled(clean_alarms(pairs)[group] for group in SILENT)
    yield Owed("alarms on clean runs", f"{text(silent)} {band(silent)}", "<= 0.4 %", is_most(silent, 0.004))
    cell, alarms = max(cell_alarms(pairs).items(), key=lambda item: item[1][0] / max(item[1][1], 1))
    yield Owed(f"worst cell: {cell}", f"{text(alarms)} {band(alarms)}", "<= 1.5 %", is_most(alarms, 0.015))
    below = clean_alarms(pairs)["below"]
    yield Owed("claims of what nobody could see", f"{text(below)} {band(below)}", "<= 1 %", is_most(below, 0.01))

    power = {cause: share(found, mine) for cause, mine in loud(pairs).items()}
    total = pooled(power.values())
    yield Owed(f"found at {LADDER} times or counted", f"{text(total)} {band(total)}", ">= 95 %", is_least(total, 0.95))
    short = [f"{cause} {text(one)}" for cause, one in power.items() if not is_least(one, 0.95)]
    yield Owed("the same, each mechanism", listed(short), ">= 95 %", none_of(short, power))
    odd = [f"{cause} {text(one)}" for cause, one in power.items() if at_odds(one, 0.95, 0.999)]
    yield Owed("of these at odds with 95 % (99.9 % of its law)", listed(odd), "none", none_of(odd, power))

    plain = share(found, strong(pairs))
    times = f"at {STRONG:g} times and more"
    yield Owed(f"found {times}", f"{text(plain)} {band(plain)}", ">= 95 %", is_least(plain, 0.95))

    apart = [(row.cause, row.apart) for row in by_row if row.apart[1]]
    average = mean(hits / tries for _, (hits, tries) in apart) if apart else 0.0
    yield Owed(
        f"named first, D_rival >= {TOLD_APART} or counted, mean of rows",
        f"{average:.1%} of {len(apart)} rows, {text(pooled(value for _, value in apart))}",
        ">= 97 %",
        average >= 0.97 if apart else None,
    )
    low = [f"{cause} {text(value)}" for cause, value in apart if not is_least(value, 0.9)]
    yield Owed("the same, worst row", listed(low), ">= 90 %", none_of(low, apart))
    sure = share(named, told_apart(strong(pairs)))
    yield Owed(
        f"named first {times}, D_rival >= {TOLD_APART}", f"{text(sure)} {band(sure)}", ">= 97 %", is_least(sure, 0.97)
    )
    heard = [pair for mine in loud(pairs).values() for pair in mine if found(pair)]
    given = mean(map(probability_of_truth, heard)) if heard else 0.0
    yield Owed("probability given to the truth, mean", f"{given:.3f}", ">= 0.90", given >= 0.9 if heard else None)

    wrong = confident_wrong(pairs)
    yield Owed(
        "outside the catalogue: sure wrong names", f"{text(wrong)} {band(wrong)}", "<= 2 %", is_most(wrong, 0.02)
    )
    told = flagged(pairs)
    yield Owed(
        "outside the catalogue: called unexplained", f"{text(told)} {band(told)}", ">= 90 %", is_least(told, 0.9)
    )
    both = both_named(pairs)
    yield Owed("both of two named", f"{text(both)} {band(both)}", ">= 90 %", is_least(both, 0.9))

    held = pooled(coverage(pairs).values())
    inside = 0.93 <= held[0] / held[1] <= 0.97 if held[1] else None
    yield Owed("95 % intervals that hold the truth", f"{text(held)} {band(held)}", "93 to 97 %, of 2,000", inside)
    off = [f"{cause} {text(one)}" for cause, one in by_mechanism(coverage(pairs)).items() if not in_band(one, 0.95)]
    yield Owed("the same, mechanisms outside 99.9 % of their law", listed(off), "none", none_of(off, coverage(pairs)))
    gained, oracle, runs = oracle_ratio(pairs)
    yield Owed(
        "held-out nats over the oracle's, D of 60 to 120",
        f"{gained / oracle:.2f} of {oracle:.0f} nats in {runs} runs" if runs else "",
        ">= 0.85",
        gained >= 0.85 * oracle if runs else None,
    )

    apart_from = max(abs(area - 0.5) for area in leak(pairs).values())
    probed = not isnan(apart_from)
    yield Owed("leak probe, farthest from 0.5", f"{apart_from:.2f}", "<= 0.05", apart_from <= 0.05 if probed else None)
    seconds = [pair.answer.seconds for pair in pairs] or [0.0]
    longest = max(pairs, key=lambda pair: pair.answer.seconds, default=None)
    readings = f" ({longest.envelope.run.plant.n} readings)" if longest else ""
    took = f"{median(seconds):.1f}, at most {max(seconds):.0f}{readings}"
    yield Owed("seconds of a processor for a diagnosis, median", took, "", None)
    clean = [pair for pair in pairs if pair.envelope.group in SILENT]
    yield Owed("baseline: anything said on clean runs", band(share(spoke, clean)), "", None)
    hidden = [pair for mine in loud(pairs).values() for pair in mine]
    yield Owed(f"baseline: anything said at {LADDER} times or counted", band(share(spoke, hidden)), "", None)


def spoke(pair: Pair) -> bool:
    """Return whether the baseline said anything."""
    return bool(pair.answer.baseline)


def is_most(share: Share, target: float) -> bool | None:
    return share[0] <= target * share[1] if share[1] else None


def is_least(share: Share, target: float) -> bool | None:
    return share[0] >= target * share[1] if share[1] else None


def none_of(short: Sequence[str], tried: Iterable[object]) -> bool | None:
    return not short if list(tried) else None


def listed(items: Sequence[str]) -> str:
    return ", ".join(items) or "none below" if len(items) < 40 else f"{len(items)}"


def cells(item: Owed) -> tuple[str, str, str, str]:
    return item.what, item.came_to, item.target, {True: "met", False: "**missed**", None: ""}[item.met]


# --- where it comes from ---------------------------------------------------------------------------------------------


def false_alarms(pairs: Sequence[Pair]) -> list[str]:
    groups = clean_alarms(pairs)
    return [
        "## False alarms",
        "",
        *table(("group", "alarms", "share"), ((group, text(value), band(value)) for group, value in groups.items())),
        "",
        "`clean` is in the model; `provocative` too, with loud and frequent shocks, numbers ten times less or more,",
        "few readings or very many, and gaps; `below` hides an effect of D = 1.5 nats, which should not be claimed.",
        "",
        *table(
            ("clean runs with", "alarms", "share"),
            ((name, text(value), band(value)) for name, value in cell_alarms(pairs).items()),
        ),
        "",
        "Each alarm:",
        "",
        *table(("run", "group", "readings", "said"), alarms(pairs)),
        "",
    ]


def alarms(pairs: Sequence[Pair]) -> Iterable[Sequence[str]]:
    for pair in pairs:
        if pair.envelope.group in (*SILENT, "below") and found(pair):
            why = pair.findings[0]["experiment"].split("; ")[0]
            hidden = f" ({', '.join(pair.causes)})" if pair.causes else ""
            yield (
                str(pair.envelope.number),
                pair.envelope.group + hidden,
                str(pair.envelope.run.plant.n),
                f"{said(pair)}: {why}",
            )


def powers(pairs: Sequence[Pair], by_row: Sequence[Row]) -> list[str]:
    alone = [pair for pair in pairs if pair.envelope.group in ALONE]
    factors = []
    for factor in FACTORS:
        mine = [pair for pair in alone if rung(pair) == factor]
        root_d = mean(sqrt(pair.envelope.d_nats[0]) for pair in mine) if mine else 0.0
        factors.append((f"{factor:g}", f"{root_d:.1f}", text(share(found, mine)), band(share(found, mine))))
    lengths = []
    for n in sorted({pair.envelope.run.plant.n for pair in alone}):
        mine = [p for p in alone if p.envelope.run.plant.n == n and rung(p) == LADDER]
        lengths.append((str(n), text(share(found, mine)), band(share(found, mine))))
    return [
        "## Power",
        "",
        "Found at multiples of the amplitude at which a clairvoyant, who knows plant and family, finds 95 % at the",
        f"level {LEVEL:.1e}; `counted` effects have no such amplitude. Over all that are not counted. Where none of",
        "many plants carries three or ten times that amplitude, what is hidden is the most that one does, and is told",
        "with the last multiple below it.",
        "",
        *table(("times that amplitude", "root of D, mean", "found", "share"), factors),
        "",
        *table(("readings", f"found at {LADDER} times", "share"), lengths),
        "",
        "By mechanism, each hidden alone. Mechanisms marked - are not looked for, so what is found of them is found",
        f"as something else; `apart`: named first, D against the nearest rival being {TOLD_APART} or more, or counted.",
        "",
        *table(
            (
                "mechanism",
                "D by",
                *(f"{factor:g}" for factor in FACTORS),
                "counted",
                f"share at {LADDER} times or counted",
                "named",
                "apart",
                "in set",
                "p(truth)",
                "baseline",
            ),
            map(cells_of, by_row),
        ),
        "",
    ]


def cells_of(row: Row) -> Sequence[str]:
    owed_share = row.by_factor.get(0.0 if row.kind == "counted" else LADDER, (0, 0))
    return (
        f"{'' if row.covered else '- '}{row.cause}",
        row.kind,
        *(text(row.by_factor.get(factor, (0, 0))) for factor in (*FACTORS, 0.0)),
        band(owed_share),
        text(row.named),
        text(row.apart),
        text(row.in_set),
        f"{row.probability:.2f}" if row.named[1] else "",
        text(row.baseline),
    )


def names(pairs: Sequence[Pair]) -> list[str]:
    heard = [pair for pair in pairs if pair.envelope.group in ALONE and found(pair)]
    outside = [pair for pair in pairs if pair.envelope.group == "outside"]
    shares = (
        ("named first, of all found", share(named, heard)),
        (f"named first, D against the nearest rival >= {TOLD_APART} or counted", share(named, told_apart(pairs))),
        ("truth in the set, of all found", share(in_set, heard)),
        ("both of two named", both_named(pairs)),
        ("outside the catalogue: found", share(found, outside)),
        ("outside the catalogue: called unexplained", flagged(pairs)),
        ("outside the catalogue: a sure wrong name", confident_wrong(pairs)),
    )
    return [
        "## Names",
        "",
        *table(("figure", "hits", "share"), ((what, text(value), band(value)) for what, value in shares)),
        "",
        "What each was called first. How D against the nearest rival is computed: tests/blind/rivals.py.",
        "",
        *table(
            ("hidden", "called"),
            (
                (cause, ", ".join(f"{name} {count}" for name, count in called.most_common()))
                for cause, called in sorted(confusion(pairs).items())
            ),
        ),
        "",
    ]


def intervals(pairs: Sequence[Pair]) -> list[str]:
    held = coverage(pairs)
    return [
        "## Intervals",
        "",
        "Of right names, by mechanism: inside means within the central 99.9 % of the binomial law of 95 %.",
        "",
        *table(
            ("mechanism", "holds", "share", "inside"),
            (
                (cause, text(value), band(value), "yes" if in_band(value, 0.95) else "**no**")
                for cause, value in by_mechanism(held).items()
            ),
        ),
        "",
        *table(
            ("parameter", "holds", "share"),
            ((f"{cause}: {name}", text(value), band(value)) for (cause, name), value in sorted(held.items())),
        ),
        "",
    ]


def gains(pairs: Sequence[Pair]) -> list[str]:
    measured = [pair for pair in pairs if pair.answer.oracle_nats is not None]
    lines = []
    for cause in sorted({pair.causes[0] for pair in measured}):
        gained, oracle, runs = oracle_ratio([pair for pair in measured if pair.causes[0] == cause])
        lines.append((cause, str(runs), f"{gained:.0f}", f"{oracle:.0f}", f"{gained / oracle:.2f}"))
    return [
        "## Held-out gain",
        "",
        "Over the best clean model, on blocks that no fit saw; the oracle knows the true model: tests/blind/oracle.py.",
        "All runs, also those in which nothing was found.",
        "",
        *table(("mechanism", "runs", "nats gained", "the oracle's", "ratio"), lines),
        "",
    ]


def misses(pairs: Sequence[Pair]) -> Iterable[Sequence[str]]:
    """Yield each run whose first finding is not what was hidden at a size at which it is owed."""
    for pair in pairs:
        envelope = pair.envelope
        if envelope.group in (*SILENT, "below") or (envelope.group == "single" and envelope.factor < 1):
            continue
        if envelope.group == "double":
            missed = not set(pair.causes) <= {item["cause"] for item in pair.findings}
        else:
            unnamed = envelope.group == "outside" and found(pair) and pair.findings[0]["cause"] == "unexplained"
            missed = not named(pair) and not unnamed
        if missed:
            d = ", ".join(f"{value:.0f}" for value in envelope.d_nats)
            n = str(envelope.run.plant.n)
            yield str(envelope.number), ", ".join(pair.causes), d, f"{envelope.factor:g}", n, said(pair)


def said(pair: Pair) -> str:
    return (
        "; ".join(
            f"{item['cause']} (p {item['p_value']:.0e}, probability {item['probability']:.2f})"
            for item in pair.findings
        )
        or "(nothing)"
    )


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *lines)]


def text(share: Share) -> str:
    return f"{share[0]}/{share[1]}" if share[1] else ""


def band(share: Share) -> str:
    if not share[1]:
        return ""
    low, high = share_band(*share)
    return f"{share[0] / share[1]:.1%} [{low:.1%}, {high:.1%}]"
