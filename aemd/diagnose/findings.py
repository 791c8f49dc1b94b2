"""What the terms that were found are worth, and what may be said of each: its name, a set of names, or none.

Held-out blocks decide whether a term stays. What does not predict them is no explanation, however well it fits.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.catalogue import COVERED, experiment_for
from aemd.diagnose.evidence import Defect, Evidence
from aemd.diagnose.figures import remark_on
from aemd.diagnose.fit import Fit, refit, restart_base
from aemd.diagnose.gain import SLOW, HeldOut, block_of, measure_gain
from aemd.diagnose.goodness import leaves_a_line, leaves_a_wave, share_a_period, why_unfit
from aemd.diagnose.hypothesis import Data, Term
from aemd.diagnose.intervals import covariance, describe
from aemd.diagnose.naming import NOT_WHITE, Named, is_coloured
from aemd.diagnose.result import Finding, Gain
from aemd.diagnose.search import LEAST_NATS, Searched
from aemd.diagnose.terms.courses import BreathingNoise
from aemd.diagnose.terms.lines import Sines
from aemd.diagnose.terms.noise import ChangingNoise, SwellingNoise
from aemd.diagnose.terms.packets import Packet
from aemd.diagnose.terms.shapes import Hump
from aemd.diagnose.terms.stated import OtherFigures

__all__ = ["Judged", "judge", "judge_all"]

Floats = NDArray[np.float64]

_BROAD = (
    "resonance",
    "flicker_noise",
    "random_walk",
    "smoothing",
    "extra_gauss_markov",
    "popcorn_noise",
    "changing_noise",
    "wandering_line",
    "periodic_glitch",
    "nonlinearity",
    "shock_law",
    "ring_down",
    "warmup_drift",
    "heavy_tails",
    "range_switching",
)
"""Mechanisms that many a shape passes for."""
_SURE = 1e-5
"""p of a check from which what does not predict held-out blocks is a finding still, and no name. Of what is there, but
is not in the catalogue, p is far less; of chance alone it is more, nine times in ten that a check is surprised."""
_OUTSIDE = {
    Hump: ("a hump that comes once", "step"),
    Packet: ("a wave that comes once", "ring_down"),
    ChangingNoise: ("all that varies is larger or smaller for a while", "changing_noise"),
    SwellingNoise: ("noise that swells or fades once", "changing_noise"),
    BreathingNoise: ("noise that swells and fades evenly", "changing_noise"),
}
"""What of no catalogue can be fitted, in words, and what of the catalogue is nearest."""
_HUM = "run the source or the meter from a battery, or move the cable: hum of the mains goes or changes its size"
_OTHER_FIGURES = "state these figures and diagnose again; then ask what has changed since the old ones were measured"


@dataclass(frozen=True, slots=True)
class Judged:
    """What stays of a search."""

    fit: Fit
    """Base and the terms that stay."""
    findings: tuple[Finding, ...]
    together: Gain | None
    """Of all that stay; none where none does."""
    spread: Floats
    """Covariance of the fit's free numbers."""


def judge_all(searched: Searched, defects: list[Defect]) -> Judged:
    """Measure what was found on held-out blocks, keep what predicts them, and say what may be said of each.

    Args:
        searched: the base, the terms and what they leave.
        defects: of the readings themselves, findings without a measurement.
    """
    fit, judged, refused, spread = _what_stays(searched)
    findings = [_from_defect(defect, searched.base) for defect in defects]
    findings += [_doubted(item, _part_of_a_wave(fit, number)) for number, item in enumerate(judged, start=1)]
    # What held-out blocks contradict has to surprise for more than one reason to be said at all.
    findings += [item for item in refused if item.p_value < _SURE]
    together = _measure_together(searched.base, fit, [item.gain for item in judged])
    if searched.left:
        findings.append(_unexplained(searched.left, fit, searched.stopped))
    if any(item.cause == "unexplained" and not item.remark for item in findings):
        why = "there is more that is not explained, and it may be part of that"
    else:
        why = why_unfit(fit, searched.evidence) if findings else ""
    # Where the search stopped, more is known to be there; a band with a top of its own is no part of it.
    sharp = ("resonance",) if searched.stopped else ()
    # What surprises less than what is left may all be part of that, whatever its name asks for.
    left = 1.0 if searched.stopped else min((item.p_value for item in searched.left), default=1.0)
    findings = [
        _doubted(item, why) if item.p_value > left or (item.cause in _BROAD and item.cause not in sharp) else item
        for item in findings
    ]
    return Judged(fit, tuple(findings), together, spread)


def judge(finding: Finding, found: Named) -> tuple[Finding, bool]:
    """Return a finding without its name where that is more than the data can carry, and whether its term stays.

    A name claims that other readings are predicted better by it, so its gain on held-out blocks must be above 0: else
    it is `unexplained`, and out of the model. Not the gain's lower bound: whether there is something at all is what the
    check's p-value says, and a few blocks' spread would hide most of what is just large enough to be seen. A term that
    predicts but whose name was refused stays, so that what else there is can be found beside it.
    """
    if finding.remark:  # its figures are wrong as stated, whatever predicts better
        return finding, True
    gain, name = finding.gain, found.names[0].replace("_", " ")
    witness = getattr(found.term, "witness", "")
    name += f" with the {witness.replace('_', ' ')}" if witness else ""
    lag = finding.parameters.get("lag_s")
    if gain.nats_total <= 0:
        why = f"which fits but does not predict held-out blocks ({gain.nats_total:+.1f} nats)"
    elif lag is not None and lag.value < 0:
        why = f"by {-lag.value:.3g} s the wrong way: nothing follows what has not happened yet"
    elif found.term.cause == "unexplained" and type(found.term) in _OUTSIDE:
        what, nearest = _OUTSIDE[type(found.term)]
        nearest = found.names[0] if found.names[0] in COVERED else nearest
        return _nameless(finding, f"{what}, most like {nearest.replace('_', ' ')}; record again to see it twice"), True
    elif found.refused:
        return _nameless(finding, f"looks most like {name}, {found.refused}; record again to see it twice"), True
    else:
        return finding, True
    nothing = Gain(0.0, 0.0, 0.0, 0.0)
    out = replace(finding, parameters={}, gain=nothing, rms_after=finding.rms_before)
    return _nameless(out, f"looks most like {name}, {why}; record for longer"), False


def _what_stays(searched: Searched) -> tuple[Fit, list[Finding], list[Finding], Floats]:
    """Return the fit with the terms that predict, the findings of those and of the others, and the fit's covariance."""
    fit, named, lacking = _pruned(searched.fit, searched.named)
    refused = list[Finding]()
    while True:
        spread = covariance(fit)
        before = searched.without_last if fit is searched.fit else None
        named = _reheard(fit, named)
        explained = _explained(fit, named, spread, lacking, before)
        judged = [judge(item, found) for item, (_, found) in zip(explained, named, strict=True)]
        gone = [number for number, (_, stays) in enumerate(judged, start=1) if not stays]
        if not gone:
            return fit, [item for item, _ in judged], refused, spread
        # What was measured beside a term that goes is measured again without it.
        refused += [item for item, stays in judged if not stays]
        named = [item for item, (_, stays) in zip(named, judged, strict=True) if stays]
        fit, named, lacking = _pruned(_without(fit, *gone), named)


def _reheard(fit: Fit, named: list[tuple[Evidence, Named]]) -> list[tuple[Evidence, Named]]:
    """Return what was named, a noise no longer refused for a colour that another finding, not refused, has taken off.

    Of two effects at once, a line and a noise that changes, the first to be named is named beside the other.
    """
    if any(found.refused and found.refused != NOT_WHITE for _, found in named):
        return named
    return [
        (item, replace(found, refused="") if found.refused and not is_coloured(fit, found.term) else found)
        for item, found in named
    ]


def _pruned(fit: Fit, named: list[tuple[Evidence, Named]]) -> tuple[Fit, list[tuple[Evidence, Named]], dict[int, Fit]]:
    """Take out terms of earlier rounds that later ones made superfluous.

    Returns:
        The fit, its named terms, and by its number the fit without each of them; not without the last, which was added
        in full knowledge of the others, if nothing was taken out.
    """
    number, lacking, whole = 1, dict[int, Fit](), fit
    while number < len(named) + (fit is not whole):
        less = _without(fit, number)
        lost = fit.log_likelihood - less.log_likelihood
        if number < len(named) and lost < max(LEAST_NATS, fit.terms[number].cost_nats):
            fit, named, number, lacking = less, [*named[: number - 1], *named[number:]], 1, {}
        else:
            lacking[number] = less
            number += 1
    return fit, named, lacking


def _without(fit: Fit, *numbers: int) -> Fit:
    """Return the fit begun from this one without the terms of these numbers."""
    kept = [at for at in range(len(fit.terms)) if at not in numbers]
    return refit([fit.terms[at] for at in kept], fit.data, np.concatenate([fit.parts_of(at) for at in kept]))


def _from_defect(defect: Defect, base: Fit) -> Finding:
    return Finding(
        cause=defect.cause,
        names=(defect.cause, *defect.rivals),
        probability=1.0 if not defect.rivals else 0.5,
        p_value=defect.p_value,
        d_nats=0.0,
        parameters=defect.parameters,
        gain=Gain(0.0, 0.0, 0.0, 0.0),
        rms_before=base.innovation_rms,
        rms_after=base.innovation_rms,
        experiment=defect.experiment,
    )


def _explained(
    fit: Fit,
    named: list[tuple[Evidence, Named]],
    spread: Floats,
    lacking: dict[int, Fit],
    before: Fit | None,
) -> list[Finding]:
    """Return a finding for each term, measured against the same model without it.

    Args:
        fit: base and terms.
        named: the terms with their evidence.
        spread: covariance of the fit's free numbers.
        lacking: by the number of a term, the fit without it, where it is known; see `_pruned`.
        before: the fit without the last term, begun anew already, where it is known.
    """
    findings, scores = [], dict[tuple[float, bool], Floats]()
    for number, (evidence, found) in enumerate(named, start=1):
        known = before if number == len(named) and before is not None else lacking.get(number)
        less = known or _without(fit, number)
        if less is not before:
            less = restart_base(less)
        block_s, forward = block_of(fit.data, [found.term]), found.term.cause in SLOW
        held = HeldOut(fit.data, block_s, fit.each)
        if (block_s, forward) not in scores:
            scores[block_s, forward] = held.score(fit.terms, fit.theta, forward=forward)
        findings.append(
            Finding(
                cause=_ids(found.names)[0],
                names=_ids(found.names),
                probability=found.probability,
                p_value=evidence.p_value,
                d_nats=max(fit.log_likelihood - less.log_likelihood - 0.5 * found.term.start.size, 0.0),
                parameters=describe(fit, number, spread),
                gain=measure_gain(
                    held.score(less.terms, less.theta, forward=forward),
                    scores[block_s, forward],
                    fit.data.n,
                ),
                rms_before=less.innovation_rms,
                rms_after=fit.innovation_rms,
                experiment=_OTHER_FIGURES
                if isinstance(found.term, OtherFigures)
                else _experiment(found.names[0], found.term, fit.data),
                remark=remark_on(found.term),
            )
        )
    return findings


def _measure_together(base: Fit, fit: Fit, gains: list[Gain]) -> Gain | None:
    """Return what all terms together are worth on held-out blocks; none without a term, the one's own of one.

    Args:
        base: before any term.
        fit: with those that stay.
        gains: of the terms one by one.
    """
    if len(fit.terms) == len(base.terms):
        return None
    if len(gains) == 1:
        return gains[0]
    forward = any(term.cause in SLOW for term in fit.terms)
    held = HeldOut(fit.data, block_of(fit.data, fit.terms), fit.each)
    before, after = (held.score(of.terms, of.theta, forward=forward) for of in (base, fit))
    return measure_gain(before, after, fit.data.n)


def _part_of_a_wave(fit: Fit, number: int) -> str:
    """Return why a term may be part of a wave of another form, in words; empty where it is none."""
    if share_a_period(fit, number):
        return "another finding comes again with it, as parts of one wave do"
    if leaves_a_wave(fit, number):
        return "a wave of its own period is left beside it"
    if leaves_a_line(fit, number):
        return "a line stands in its band still, and some lines beside each other pass for one"
    return ""


def _doubted(finding: Finding, why: str) -> Finding:
    """Return a finding whose name is the nearest, and may not be it, as long as there is a reason."""
    if not why or "unexplained" in finding.names:
        return finding
    return replace(
        finding, names=(*finding.names, "unexplained"), probability=finding.probability / 2, remark=f"because {why}"
    )


def _experiment(name: str, term: Term, data: Data) -> str:
    """Return the cheapest test of a name; hum of the mains that the readings follow does not move with their rate."""
    if (
        name == "mains_alias"
        and isinstance(term, Sines)
        and 2 * term.harmonics[0] * term.frequency_hz * data.interval_s < 1
    ):
        return _HUM
    return experiment_for(name, getattr(term, "witness", ""))


def _ids(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the catalogue's names; a stated model's own figures have none."""
    return tuple(dict.fromkeys(name if name in COVERED else "unexplained" for name in names))


def _nameless(finding: Finding, text: str) -> Finding:
    return replace(finding, cause="unexplained", names=("unexplained",), experiment=text)


def _unexplained(left: list[Evidence], fit: Fit, stopped: str) -> Finding:
    nearest = next((term.cause for item in left for term in item.terms), "none of the catalogue")
    what = f"{left[0].check.split(':')[0].split(', in ')[0]} looks most like {nearest.replace('_', ' ')}"
    # A check for anything says where it is, even where another is more surprised.
    looks = next((item.looks for item in left if item.looks), "")
    if stopped:
        text = f"{looks or what}, which was not fitted: {stopped}; mend what is named above and record again"
    else:
        text = f"{looks or what + ', which does not explain it'}; record again to see it twice"
    return Finding(
        cause="unexplained",
        names=("unexplained",),
        probability=1.0,
        p_value=left[0].p_value,
        d_nats=0.0,
        parameters={},
        gain=Gain(0.0, 0.0, 0.0, 0.0),
        rms_before=fit.innovation_rms,
        rms_after=fit.innovation_rms,
        experiment=text,
    )
