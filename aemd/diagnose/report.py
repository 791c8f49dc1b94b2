"""A diagnosis as text for a terminal: the verdict, then two lines a finding."""

import re
from math import ceil, isfinite, isnan, log, log10

from aemd.diagnose.result import Diagnosis, Finding, Gain, Promise, Value

__all__ = ["format_diagnosis", "format_finding", "format_promise"]

_UNIT = r"(_V|_hz)?_per_(rt_s|s|[A-Z]+)$|_(V|hz|s|readings)$"
_TOLD_APART = 5.4
"""Nats between two names from which the likelier is right in 95 %: Phi(sqrt(D/2))."""
_VISIBLE = 0.005
"""Relative change of a figure of three digits that shows."""
_TIMES_A_FREQUENCY = 1e-3
"""Of a harmonic's number, off a whole one: what is no further off was not folded."""
_HARMONIC = r"amplitude_(\d+)_V$"
_HARMONICS = 3
"""That are told."""
_WORDS = {
    ("missing_samples", "fraction"): "part of the readings",
    ("replayed_block", "fraction"): "part of the readings",
    ("stuck_readings", "fraction"): "part of the readings",
    ("saturation", "fraction"): "part of the readings",
    ("dead_band", "fraction"): "part of the readings",
    ("heavy_tails", "fraction"): "part of the readings",
    ("heavy_tails", "sd_V"): "sd of what these have more",
    ("popcorn_noise", "fraction"): "part of the time above",
    ("shock_law", "fraction"): "part that is positive",
    ("signal_dependent_noise", "fraction"): "sd over the reading",
    ("smoothing", "fraction"): "part of the last reading in the next",
    ("supply_coupling", "coefficient_per_V"): "gain",
    ("quantisation", "ratio"): "step over what is new in a reading",
    ("changing_noise", "ratio"): "noise then over noise elsewhere",
    ("ring_down", "ratio"): "first swing over the shock",
    ("clock_error", "ratio"): "interval over the nominal one, or over its quickest",
    ("range_switching", "level_V"): "wider range from",
    ("range_switching", "sd_V"): "noise added there",
}
"""Of parameters whose name does not say what they are of."""
_SURE = 1e-290
"""What p-values are not told below."""
_MANY = 1e4
"""From here on numbers are written out, with their thousands apart."""
_PREFIXES = {0: "", -3: "m", -6: "µ", -9: "n", -12: "p", 3: "k", 6: "M"}


def format_diagnosis(diagnosis: Diagnosis) -> str:
    """Return the whole report, lines ending with a newline."""
    lines = [_verdict(diagnosis), ""]
    for finding in diagnosis.findings:
        lines += [*_finding(finding), ""]
    sized = [finding.cause for finding in diagnosis.findings if finding.parameters]
    if "smoothing" in sized and len(sized) > 1:
        lines.append("Sizes are those before the smoothing; the readings show less of what is fast.")
    if diagnosis.not_covered:
        lines.append(f"Not looked for: {', '.join(diagnosis.not_covered)}.")
    if any(finding.gain.nats_total for finding in diagnosis.findings):
        lines.append("Nats say how much more probable the readings become: 5 nats are odds of 150 to 1.")
    if diagnosis.gain is not None and sum(finding.gain.nats_total != 0 for finding in diagnosis.findings) > 1:
        lines.append(f"All that was found together is {_worth(diagnosis.gain)}.")
    if diagnosis.promise is not None:
        lines.append(format_promise(diagnosis.promise))
    if diagnosis.allan:
        lines.append(_steadiness(diagnosis))
    first = "The first " if diagnosis.left_out else ""
    rest = f" The {diagnosis.left_out:,} readings behind them were not looked at." if diagnosis.left_out else ""
    judged = f"{diagnosis.n:,} readings at {diagnosis.rate_hz:.4g} /s, judged in {diagnosis.seconds:.1f} s"
    lines.append(f"{first}{judged}.{rest}")
    return "\n".join(lines) + "\n"


def format_finding(finding: Finding) -> str:
    """Return the two lines of one finding."""
    return "\n".join(_finding(finding))


def format_promise(promise: Promise) -> str:
    """Return what an estimator of the extended model should deliver, as one sentence.

    Ratios have two digits after the point: they are of a few drawn records.
    """
    if not promise.taken:
        return "No estimator here has a place for what was found: with -o it stays the one of the base model."
    before, after = (_engineer(error_V, "V", 3) for error_V in (promise.error_before_V, promise.error_after_V))
    ratio = promise.ratio
    range_ = f"on a further record of this kind {ratio.low:.2f} to {ratio.high:.2f} times as much"
    if before == after:
        return (
            "An estimator that knows of it (-o) gains nothing for the input, only for the readings: it should err by "
            f"{after} rms over the record, a constant apart, as without it ({range_})."
        )
    return (
        f"An estimator that knows of it (-o) should err by {after} rms of the input instead of {before}, over the "
        f"record and a constant apart: {range_}."
    )


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
    named = [finding for finding in diagnosis.findings if finding.cause != "unexplained"]
    rest = len(diagnosis.findings) - len(named)
    doubted = sum("unexplained" in finding.names for finding in named)
    one = len(named) == 1
    known = f"{len(named)} finding{',' if one else 's, each'} consistent with a mechanism of the catalogue"
    if doubted:
        known += (
            ", but perhaps something else" if one else f", {_count(doubted, len(named))} of them perhaps something else"
        )
    match diagnosis.verdict:
        case "nothing_found":
            return "Nothing found: the base model predicts these readings as well as it claims, as far as was looked."
        case "explained":
            return f"{known}."
        case _ if named:
            return f"{known}, and {rest} more that {'is' if rest == 1 else 'are'} not explained by it."
        case _:
            return f"{rest} finding{'s' if rest > 1 else ''}, not explained by the catalogue of mechanisms."


def _count(some: int, of: int) -> str:
    return "all" if some == of else str(some)


def _finding(finding: Finding) -> tuple[str, str]:
    sizes = _sizes(finding)
    then = finding.experiment
    if finding.cause == "unexplained":
        what = finding.remark or "Unexplained"
        seen, _, after = then.rpartition("; ")
        if seen and not finding.remark:
            what, then = f"{what}: {seen}", after
    elif len(finding.names) == 1:
        what = f"Consistent with {_call(finding)}"
    else:
        others = " or ".join(
            "something unexplained" if n == "unexplained" else n.replace("_", " ") for n in finding.names[1:]
        )
        what = f"Consistent with {_call(finding)} ({finding.probability:.0%}), not told apart from {others}"
        what += f" {finding.remark}" if "unexplained" in finding.names else _longer(finding)
    evidence = "certain" if finding.p_value == 0 else f"{_probability(finding.p_value)} over all places it was sought"
    worth = ""
    if finding.gain.nats_total:
        worth = f"; {_worth(finding.gain)}"
        if finding.rms_after < finding.rms_before:  # what is worth more where predictions are sure may not lower it
            before, after = (_engineer(rms_V, "V") for rms_V in (finding.rms_before, finding.rms_after))
            worth += f", prediction error {before} -> {after} rms"
    mark = ";" if ":" in what or (finding.remark and finding.cause != "unexplained") else ":"
    return f"{what}{mark} {sizes + '; ' if sizes else ''}{evidence}{worth}.", f"  Next: {then}."


def _probability(p_value: float) -> str:
    return f"p = {p_value:.1g}" if p_value > _SURE else f"p below {_SURE:.0g}"


def _sizes(finding: Finding) -> str:
    """Return the parameters in words; of many harmonics the strongest; the JSON has all."""
    harmonics = [name for name in finding.parameters if re.match(_HARMONIC, name)]
    strongest = sorted(harmonics, key=lambda name: -finding.parameters[name].value)[:_HARMONICS]
    told = [
        f"{_WORDS.get((finding.cause, name)) or _plain(name)} {_say(value)}"
        for name, value in finding.parameters.items()
        if name not in harmonics or name in strongest
    ]
    weaker = len(harmonics) - len(strongest)
    return ", ".join(told) + (f" and {weaker} weaker {'one' if weaker == 1 else 'ones'}" if weaker else "")


def _worth(gain: Gain) -> str:
    return (
        f"worth {gain.nats_total:.0f} nats ({gain.low:.0f} to {gain.high:.0f}; {gain.nats_per_reading:.2g} a reading) "
        "on readings the fit never saw"
    )


def _call(finding: Finding) -> str:
    """Return the mechanism in words; hum of the mains that the sampling has not folded is no alias."""
    if finding.cause == "mains_alias" and {"alias_hz", "mains_hz"} <= set(finding.parameters):
        harmonic = finding.parameters["alias_hz"].value / finding.parameters["mains_hz"].value
        if round(harmonic) > 0 and abs(harmonic - round(harmonic)) < _TIMES_A_FREQUENCY:
            return f"hum of the mains at {round(harmonic)} times its frequency" if round(harmonic) > 1 else "mains hum"
    return finding.cause.replace("_", " ")


def _longer(finding: Finding) -> str:
    """Return how much longer a record would tell the names apart, if evidence goes on to come as it did."""
    nats = log(finding.probability / max(1 - finding.probability, 1e-6))
    if nats < _TOLD_APART / 50:
        return " by any record of this kind"
    return f" (about {max(_TOLD_APART / nats, 1.5):.1f} times as long a record would)"


def _plain(name: str) -> str:
    """Return a parameter's name in words, without its unit.

    >>> _plain("coefficient_V_per_C"), _plain("chirp_hz_per_s"), _plain("amplitude_2_V")
    ('coefficient', 'chirp', '2nd harmonic')
    """
    harmonic = re.match(_HARMONIC, name)
    if harmonic:
        return f"{_ordinal(int(harmonic[1]))} harmonic"
    words = re.sub(_UNIT, "", name).replace("_", " ")
    return "seen at" if words == "alias" else words


def _ordinal(number: int) -> str:
    """Return a number as an ordinal.

    >>> [_ordinal(number) for number in (1, 2, 3, 4, 11, 22)]
    ['1st', '2nd', '3rd', '4th', '11th', '22nd']
    """
    ending = {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th") if number // 10 % 10 != 1 else "th"
    return f"{number}{ending}"


def _say(value: Value) -> str:
    """Return a number with its interval, as many digits as that tells; an end that is open is said to be.

    Where nothing is said of an interval, the number is alone.

    >>> _say(Value(62.2261, 55.5205, 69.7416, "")), _say(Value(62.2261, 62.2261, float("inf"), "s"))
    ('62.23 (55.52 to 69.74)', '62.23 s (or more)')
    """
    here, low, high = value.value, value.low, value.high
    open_below, open_above = low == 0 or not isfinite(low), not isfinite(high)
    digits = 4
    if not (open_below or open_above) and high > low:
        digits = min(max(ceil(log10(max(abs(here), abs(low), abs(high)) / (high - low))) + 1, 3), 9)
    text = _engineer(here, value.unit, digits)
    if low == high or (open_below and open_above):
        return text if low == high or isnan(low) else f"{text} (of any size)"
    if open_above or open_below:
        end, way = _engineer(low if open_above else high, value.unit, digits), "more" if open_above else "less"
        return f"{text} (or {way})" if end == text else f"{text} ({end} or {way})"
    ends = [_engineer(end, value.unit, digits) for end in (low, high)]
    unit = text.partition(" ")[2]
    if unit and all(end.partition(" ")[2] == unit for end in ends):  # said once where all three have it
        ends = [end.partition(" ")[0] for end in ends]
    return f"{text} ({ends[0]} to {ends[1]})"


def _engineer(value: float, unit: str, digits: int = 4) -> str:
    """Return a number with so many digits, with a prefix where the unit takes one.

    >>> _engineer(0.00012346, "V"), _engineer(42463.7, "s"), _engineer(-2081.3, "1/V")
    ('123.5 µV', '42,460 s', '-2081 /V')
    """
    if unit in ("", "s", "Hz", "C") or unit.startswith("1/") or value == 0 or not isfinite(value):
        digits = max(digits, 4)
        plain = _MANY <= abs(value) < 1e9
        whole = round(value, digits - 1 - int(log10(abs(value)))) if plain else value
        number = f"{whole:,.{max(digits - 1 - int(log10(abs(value))), 0)}f}" if plain else f"{value:.{digits}g}"
        return f"{number} {unit.removeprefix('1')}".strip()
    power = max(min(int(log10(abs(value)) // 3) * 3, 6), -12)
    return f"{value / 10.0**power:.{digits}g} {_PREFIXES[power]}{unit}"
