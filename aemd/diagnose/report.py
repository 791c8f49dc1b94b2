"""A diagnosis as text for a terminal: the verdict, then two lines a finding."""

import re
from math import isfinite, log, log10

from aemd.diagnose.result import Diagnosis, Finding, Value

__all__ = ["format_diagnosis", "format_finding"]

_UNIT = r"(_V|_hz)?_per_(rt_s|s|[A-Z]+)$|_(V|hz|s|readings)$"
_TOLD_APART = 5.4
"""Nats between two names from which the likelier is right in 95 %: Phi(sqrt(D/2))."""
_VISIBLE = 0.005
"""Relative change of a figure of three digits that shows."""
_PREFIXES = {0: "", -3: "m", -6: "µ", -9: "n", -12: "p", 3: "k", 6: "M"}


def format_diagnosis(diagnosis: Diagnosis) -> str:
    """Return the whole report, lines ending with a newline."""
    lines = [_verdict(diagnosis), ""]
    for finding in diagnosis.findings:
        lines += [*_finding(finding), ""]
    if diagnosis.not_covered:
        lines.append(f"Not looked for: {', '.join(diagnosis.not_covered)}.")
    if any(finding.gain.nats_total for finding in diagnosis.findings):
        lines.append("Nats say how much more probable the readings become: 5 nats are odds of 150 to 1.")
    if diagnosis.allan:
        lines.append(_steadiness(diagnosis))
    lines.append(f"{diagnosis.n:,} readings at {diagnosis.rate_hz:.4g} /s, judged in {diagnosis.seconds:.1f} s.")
    return "\n".join(lines) + "\n"


def format_finding(finding: Finding) -> str:
    """Return the two lines of one finding."""
    return "\n".join(_finding(finding))


def _steadiness(diagnosis: Diagnosis) -> str:
    """Return the Allan deviations, and what they would be without what the findings account for."""
    parts = []
    for item in diagnosis.allan:
        text = f"{_engineer(item.before_V, 'V')} at {item.averaging_s:.3g} s"
        if abs(item.after_V / item.before_V - 1) > _VISIBLE:
            text += f" ({_engineer(item.after_V, 'V')} without what is explained)"
        parts.append(text)
    return f"Allan deviation: {', '.join(parts)}."


def _verdict(diagnosis: Diagnosis) -> str:
    count = len(diagnosis.findings)
    match diagnosis.verdict:
        case "nothing_found":
            return "Nothing found: the base model predicts these readings as well as it claims, as far as was looked."
        case "explained":
            return f"{count} finding{'s' if count > 1 else ''}, each consistent with a mechanism of the catalogue."
        case _:
            return f"{count} finding{'s' if count > 1 else ''}, not all of them explained by the catalogue."


def _finding(finding: Finding) -> tuple[str, str]:
    sizes = ", ".join(f"{_plain(name)} {_say(value)}" for name, value in finding.parameters.items())
    if finding.cause == "unexplained":
        what = finding.remark or "Unexplained"
    elif len(finding.names) == 1:
        what = f"Consistent with {_plain(finding.cause)}"
    else:
        others = ", ".join(_plain(name) for name in finding.names[1:])
        what = f"Consistent with {_plain(finding.cause)} ({finding.probability:.0%}), not told apart from {others}"
        what += _longer(finding)
    evidence = (
        "certain" if finding.p_value == 0 else f"p = {max(finding.p_value, 1e-300):.1g} over all places it was sought"
    )
    gain = finding.gain
    worth = ""
    if gain.nats_total:
        worth = (
            f"; worth {gain.nats_total:.0f} nats ({gain.low:.0f} to {gain.high:.0f}) on readings the fit never saw, "
            f"prediction error {_engineer(finding.rms_before, 'V')} -> {_engineer(finding.rms_after, 'V')} rms"
        )
    return f"{what}: {sizes + '; ' if sizes else ''}{evidence}{worth}.", f"  Next: {finding.experiment}."


def _longer(finding: Finding) -> str:
    """Return how much longer a record would tell the names apart, if evidence goes on to come as it did."""
    nats = log(finding.probability / max(1 - finding.probability, 1e-6))
    if nats < _TOLD_APART / 50:
        return " by any record of this kind"
    return f" (about {max(_TOLD_APART / nats, 1.5):.1f} times as long a record would)"


def _plain(name: str) -> str:
    """Return a parameter's or mechanism's name in words, without its unit.

    >>> _plain("coefficient_V_per_C"), _plain("step_V"), _plain("chirp_hz_per_s"), _plain("mains_alias")
    ('coefficient', 'step', 'chirp', 'mains alias')
    """
    return re.sub(_UNIT, "", name).replace("_", " ")


def _say(value: Value) -> str:
    text = _engineer(value.value, value.unit)
    if value.low == value.high or not (isfinite(value.low) and isfinite(value.high)):
        return text
    return f"{text} ({_engineer(value.low, value.unit)} to {_engineer(value.high, value.unit)})"


def _engineer(value: float, unit: str) -> str:
    """Return a number with four digits and a prefix.

    >>> _engineer(0.00012346, "V")
    '123.5 µV'
    """
    if unit in ("", "s", "Hz", "C") or value == 0 or not isfinite(value):
        return f"{value:.6g} {unit}".strip()
    power = max(min(int(log10(abs(value)) // 3) * 3, 6), -12)
    return f"{value / 10.0**power:.4g} {_PREFIXES[power]}{unit}"
