"""A diagnosis as text for a terminal: the verdict, then two lines a finding."""

from math import isfinite, log10

from aemd.diagnose.result import Diagnosis, Finding, Value

__all__ = ["format_diagnosis", "format_finding"]

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
        what = "Unexplained"
    elif len(finding.names) == 1:
        what = f"Consistent with {_plain(finding.cause)}"
    else:
        others = ", ".join(_plain(name) for name in finding.names[1:])
        what = f"Consistent with {_plain(finding.cause)} ({finding.probability:.0%}), not told apart from {others}"
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


def _plain(name: str) -> str:
    for unit in ("_V_per_rt_s", "_V_per_C", "_per_V", "_per_s", "_readings", "_hz", "_V", "_s"):
        name = name.removesuffix(unit)
    return name.replace("_", " ")


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
