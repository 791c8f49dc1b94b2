"""The figures as a page that a person reads and a release keeps."""

from collections.abc import Sequence

from tests.blind.certificate import LEVEL
from tests.blind.envelope import FACTORS
from tests.blind.rivals import TOLD_APART
from tests.blind.score import (
    ALONE,
    Pair,
    both_named,
    clean_alarms,
    confident_wrong,
    confusion,
    coverage,
    found,
    in_set,
    leak,
    named,
    rows,
    share_band,
    told_apart,
)

__all__ = ["write_report"]

Share = tuple[int, int]
ORACLE_D = 60.0


def write_report(pairs: Sequence[Pair], *, salt: str, key_hash: str, covered: Sequence[str]) -> str:
    """Return the report as Markdown."""
    singles = [pair for pair in pairs if pair.envelope.group in ALONE]
    told = [pair for pair in singles if found(pair)]
    apart = told_apart(pairs)
    failed = [pair.answer.verdict for pair in pairs if pair.answer.verdict.startswith("failed")]
    lines = [
        "# Blind injection",
        "",
        f"{len(pairs)} runs, salt `{salt}`, key SHA-256 `{key_hash}` (made before the first run; the same salt makes",
        "it again). The injector shares no code with the critic. What each figure means: tests/blind/score.py; how D",
        "is computed, mechanism by mechanism: tests/blind/certificate.py. In brackets: exact 95 % interval.",
        "",
        "## False alarms",
        "",
        "| group | alarms | share |",
        "| --- | --- | --- |",
        *(f"| {group} | {text(share)} | {band(share)} |" for group, share in clean_alarms(pairs).items()),
        "",
        "`clean` is in the model; `provocative` too, with loud and frequent shocks, extreme parameters, few readings",
        f"and gaps; `below` hides an effect of D = 1.5 nats, which should not be claimed. Crashes: {len(failed)}"
        + (f" ({'; '.join(sorted(set(failed))[:3])})." if failed else "."),
        "",
        "## Power by mechanism, each hidden alone",
        "",
        "Found at multiples of the amplitude at which a clairvoyant, who knows plant and family, finds 95 % at the",
        f"level {LEVEL:.1e}; `counted` effects have no such amplitude. Mechanisms marked - are not looked for yet,",
        "so what is found of them is found as something else. Gain: median of the held-out nats, over that of D, where",
        "D >= 30.",
        "",
        f"| mechanism | D by | {' | '.join(f'{factor:g}' for factor in FACTORS)} | counted | named | in set | p(truth)"
        " | gain/D | baseline |",
        f"| --- | --- |{' --- |' * (len(FACTORS) + 6)}",
    ]
    for row in rows(pairs, covered):
        gain, d, count = row.gain
        cells = [text(row.by_factor.get(factor, (0, 0))) for factor in (*FACTORS, 0.0)]
        cells += [text(row.named), text(row.in_set), f"{row.probability:.2f}" if row.named[1] else ""]
        cells += [f"{gain:.0f}/{d:.0f} ({count})" if count else "", text(row.baseline)]
        lines.append(f"| {'' if row.covered else '- '}{row.cause} | {row.kind} | {' | '.join(cells)} |")
    loud = [pair for pair in singles if pair.causes[0] in covered and pair.envelope.factor >= 1.25]
    lines += [
        "",
        "## Pooled, beside the worst row above",
        "",
        "| figure | hits | share |",
        "| --- | --- | --- |",
        *(
            f"| {what} | {text(share)} | {band(share)} |" if isinstance(share, tuple) else f"| {what} | | {share} |"
            for what, share in (
                ("found, looked for, at 1.25 times or more", (sum(map(found, loud)), len(loud))),
                ("named first, of all found", (sum(map(named, told)), len(told))),
                (
                    f"named first, D against the nearest rival >= {TOLD_APART}",
                    (sum(named(p) for p, _, _ in apart), len(apart)),
                ),
                ("truth in the set, of all found", (sum(map(in_set, told)), len(told))),
                ("both of two named", both_named(pairs)),
                ("outside the catalogue: found", outside_found(pairs)),
                ("outside the catalogue: a confident wrong name", confident_wrong(pairs)),
                ("baseline: anything said on clean runs", baseline_alarms(pairs)),
                ("held-out gain over the oracle's, named right, D >= 60", oracle_share(pairs)),
                ("95 % intervals that hold the truth", pooled(coverage(pairs).values())),
            )
        ),
        "",
        "How D against the nearest rival is computed, and for which mechanisms: tests/blind/rivals.py.",
        "Leak probe, areas under the curve (0.5 is chance): "
        + ", ".join(f"{name} {area:.2f}" for name, area in leak(pairs).items())
        + ".",
        "",
        "## Intervals",
        "",
        "| parameter | holds | share |",
        "| --- | --- | --- |",
        *(f"| {name} | {text(share)} | {band(share)} |" for name, share in sorted(coverage(pairs).items())),
        "",
        "## Misses, each",
        "",
        "| run | hidden | D | of the clairvoyant's amplitude | said |",
        "| --- | --- | --- | --- | --- |",
        *misses(pairs),
        "",
        "## What each was called first",
        "",
        "| hidden | called |",
        "| --- | --- |",
        *(
            f"| {cause} | {', '.join(f'{name} {count}' for name, count in called.most_common())} |"
            for cause, called in sorted(confusion(pairs).items())
        ),
        "",
    ]
    return "\n".join(lines)


def misses(pairs: Sequence[Pair]) -> list[str]:
    """Return a line for each run whose first finding is not what was hidden, or that says anything of a clean one."""
    lines = []
    for pair in pairs:
        envelope = pair.envelope
        if envelope.group in ("clean", "provocative", "below"):
            missed = found(pair)
        elif envelope.group == "double":
            missed = not set(pair.causes) <= {item["cause"] for item in pair.findings}
        else:
            missed = not named(pair) and not (
                envelope.group == "outside" and pair.findings and pair.findings[0]["cause"] == "unexplained"
            )
        if missed:
            said = "; ".join(
                f"{item['cause']} (p {item['p_value']:.0e}, probability {item['probability']:.2f})"
                for item in pair.findings
            )
            hidden = ", ".join(pair.causes) or envelope.group
            d = ", ".join(f"{value:.0f}" for value in envelope.d_nats)
            lines.append(f"| {envelope.number} | {hidden} | {d} | {envelope.factor:g} | {said or '(nothing)'} |")
    return lines


def oracle_share(pairs: Sequence[Pair]) -> str:
    """Return the sum of gains over that of D, which is what the true model gains on the same blocks on average."""
    gains = [
        (pair.findings[0]["gain"]["nats_total"], pair.envelope.d_nats[0])
        for pair in pairs
        if pair.envelope.group in ALONE and found(pair) and named(pair) and pair.envelope.d_nats[0] >= ORACLE_D
    ]
    total = sum(d for _, d in gains)
    return f"{sum(gain for gain, _ in gains) / total:.2f} over {len(gains)} runs" if gains else "no such run"


def outside_found(pairs: Sequence[Pair]) -> Share:
    outside = [pair for pair in pairs if pair.envelope.group == "outside"]
    return sum(map(found, outside)), len(outside)


def baseline_alarms(pairs: Sequence[Pair]) -> Share:
    clean = [pair for pair in pairs if pair.envelope.group in ("clean", "provocative")]
    return sum(bool(pair.answer.baseline) for pair in clean), len(clean)


def pooled(shares: Sequence[Share]) -> Share:
    shares = list(shares)
    return sum(hits for hits, _ in shares), sum(tries for _, tries in shares)


def text(share: Share) -> str:
    return f"{share[0]}/{share[1]}" if share[1] else ""


def band(share: Share) -> str:
    if not share[1]:
        return ""
    low, high = share_band(*share)
    return f"{share[0] / share[1]:.1%} [{low:.1%}, {high:.1%}]"
