"""The critic: fit, check, name, add, again; then what each finding is worth.

Checks decide whether there is anything (Holm over checks, 0.3 % in the first round, half as much in each further one).
Joint refits decide what it is called. Held-out blocks decide what it is worth. None of the three serves for another.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.catalogue import COVERED, NOT_COVERED, experiment_for
from aemd.diagnose.checks.integrity import check_raw
from aemd.diagnose.checks.local import best_hump
from aemd.diagnose.checks.residuals import check_all
from aemd.diagnose.evidence import Defect, Evidence
from aemd.diagnose.figures import compare_figures, remark_on, rival_figures
from aemd.diagnose.fit import Fit, fit_base, refit, residuals, restart_base
from aemd.diagnose.gain import SLOW, HeldOut, block_of, measure_gain
from aemd.diagnose.given import BOUNDED, Given, accept
from aemd.diagnose.goodness import fits, leaves_a_wave, share_a_period
from aemd.diagnose.hidden import hidden
from aemd.diagnose.hypothesis import Data, Term, make_data
from aemd.diagnose.intervals import covariance, describe
from aemd.diagnose.naming import Named, name
from aemd.diagnose.result import Diagnosis, Discrepancy, Finding, Gain, Verdict
from aemd.diagnose.series import Series, load_series
from aemd.diagnose.steadiness import compare_allan
from aemd.diagnose.terms.lines import Sines
from aemd.diagnose.terms.stated import OtherFigures
from aemd.diagnose.translate import as_tables, to_model
from aemd.simulate import read_model

__all__ = ["criticise", "diagnose"]

Floats = NDArray[np.float64]
Progress = Callable[[str], None]

_LEVEL = 0.003
"""Family-wise probability of any finding on a clean record, first round."""
_MOST_FINDINGS = 6
"""After so many terms the search stops and says so; on a record that has more, the first are worth the most by far."""
_HEAVIEST = 8.0
_LIGHT = 1.4e7
"""Times the base's cost of a step of the fit, (states + 1)^2 free numbers, from which no term is added any more, unless
the step costs less than so many over all readings: each resonance brings two states and three numbers. A bound on work
and not on time, so that an answer does not depend on what else the machine does."""
_LEAST_NATS = 4.0
"""Log-likelihood that a term must add to be called an explanation: what a check sees and no term can use is
`unexplained`."""
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
)
"""Mechanisms that many a shape passes for."""
_HUMPED = ("nonlinearity", "popcorn_noise", "shock_law", "ring_down")
"""What one hump of the mean passes for: beside these it is fitted as well."""
_HUM = "run the source or the meter from a battery, or move the cable: hum of the mains goes or changes its size"
_OTHER_FIGURES = "state these figures and diagnose again; then ask what has changed since the old ones were measured"


def diagnose(
    path: Path,
    *,
    model: Path | None = None,
    line_frequency_hz: float | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Say what the base model gets wrong about a file.

    Args:
        path: an MCAP recording, or a table `time,value[,...]`, further columns being witnesses.
        model: a model under criticism instead of the fitted base.
        line_frequency_hz: of the mains, where it is known.
        progress: called with a few words at each step.

    Raises:
        RecordingError: the file cannot be read or judged.
        ConfigError: the model cannot be.
    """
    stated = None if model is None else accept(read_model(model), str(model))
    return criticise(load_series(path), stated=stated, line_frequency_hz=line_frequency_hz, progress=progress)


def criticise(
    series: Series,
    *,
    stated: tuple[Given, frozenset[str]] | None = None,
    line_frequency_hz: float | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Say what the base model, or a stated one, gets wrong about a series; see `diagnose`."""
    begun = time.perf_counter()
    tell = progress or (lambda _: None)
    tell("fitting the base model")
    base = _begin(make_data(series), series, stated)
    sd_V = float(np.sqrt(np.median(base.variance[base.data.used]))) * base.data.unit_V
    tell("checking the readings themselves")
    defects = check_raw(series, sd_V)
    expected = stated[1] if stated else frozenset[str]()
    dropped, known = hidden(series, defects, expected & frozenset(BOUNDED), rounded=stated is not None)
    if dropped.any() or known is not None:
        base = _begin(make_data(series, dropped, known), series, stated)

    fit, before, named, seen, left = base, base, list[tuple[Evidence, Named]](), list[Evidence](), list[Evidence]()
    stopped, evidence = "", list[Evidence]()
    for number in count():
        tell(f"checking the residuals, round {number + 1}")
        evidence = check_all(fit, line_frequency_hz)
        left = _significant(evidence, _LEVEL / 2**number)
        seen = seen or left
        stopped = _stop(fit, base, number) if left else ""
        if not left or stopped:
            break
        tell(f"fitting what could explain: {left[0].check}")
        candidates: list[Term] = [term for item in left for term in item.terms]
        hump = best_hump(fit) if any(term.cause in _HUMPED for term in candidates) else None
        candidates += [hump] if hump else []
        if stated is not None:
            candidates += rival_figures(fit)
        found = name(fit, candidates, _LEAST_NATS)
        if found is None:
            break
        named.append((_nominating(left, found), found))
        before, fit = fit, restart_base(found.fit)
    full = fit
    fit, named, lacking = _pruned(fit, named)
    tell("measuring gains on held-out blocks")
    findings = [_from_defect(defect, base) for defect in defects if defect.cause not in expected]
    refused = list[Finding]()
    while True:
        spread = covariance(fit)
        explained = _explained(fit, named, spread, lacking, before if fit is full else None)
        judged = [_judge(item, found) for item, (_, found) in zip(explained, named, strict=True)]
        gone = [number for number, (_, stays) in enumerate(judged, start=1) if not stays]
        if not gone:
            break
        # What does not predict is no explanation, however well it fits; what was measured beside it is measured again.
        refused += [item for item, stays in judged if not stays]
        named = [item for item, (_, stays) in zip(named, judged, strict=True) if stays]
        fit, named, lacking = _pruned(_without(fit, *gone), named)
    numbers = range(1, len(fit.terms))
    parts = [share_a_period(fit, number) or leaves_a_wave(fit, number) for number in numbers]
    findings += [_doubted(item) if of_one else item for (item, _), of_one in zip(judged, parts, strict=True)]
    findings += refused
    together = _measure_together(base, fit, [item.gain for item, _ in judged])
    if left:
        findings.append(_unexplained(left, fit, stopped))
    open_end = any(item.cause == "unexplained" and not item.remark for item in findings)
    if findings and (open_end or not fits(fit, evidence)):
        # Where the search stopped, more is known to be there; a band with a top of its own is no part of it.
        findings = [item if stopped and item.cause == "resonance" else _less_sure(item) for item in findings]
    open_ends = any(item.cause == "unexplained" for item in findings)
    verdict: Verdict = "unexplained" if open_ends else "explained" if findings else "nothing_found"
    return Diagnosis(
        verdict=verdict,
        n=int(np.count_nonzero(series.used)),
        rate_hz=1 / series.interval_s,
        findings=tuple(findings),
        discrepancies=tuple(
            [Discrepancy(d.check, d.observed, 0.0, d.expected, d.p_value) for d in defects]
            + [Discrepancy(e.check, e.observed, e.low, e.high, e.p_value) for e in seen]
            + [item for number in range(len(fit.terms)) for item in compare_figures(fit, number, spread)]
        ),
        base_model=_tables(base, series.aperture_s, spread if base is fit else covariance(base)),
        extended_model=_tables(fit, series.aperture_s, spread),
        allan=compare_allan(base, fit),
        left_out=series.left_out,
        path=series.path,
        seconds=time.perf_counter() - begun,
        gain=together,
        covered=COVERED,
        not_covered=NOT_COVERED,
    )


def _begin(data: Data, series: Series, stated: tuple[Given, frozenset[str]] | None) -> Fit:
    """Return the hypothesis under criticism: the stated one as it is, else the base fitted."""
    if stated is None:
        return fit_base(data)
    return residuals([replace(stated[0], aperture_s=series.aperture_s)], np.empty(0), data)


def _tables(fit: Fit, aperture_s: float, spread: Floats) -> dict[str, Any]:
    """Return a fit as the catalogue's model, and its parameters with their intervals."""
    made, without = to_model(fit, aperture_s)
    return {
        **as_tables(made),
        "aperture_s": aperture_s,
        "without_term": list(without),
        "parameters": {
            ("base" if number == 0 else f"{number}_{term.cause}"): describe(fit, number, spread)
            for number, term in enumerate(fit.terms)
        },
    }


def _nominating(left: list[Evidence], found: Named) -> Evidence:
    """Return the most surprising of the checks that asked for what was found."""
    asked = (item for item in left if any(term.cause == found.term.cause for term in item.terms))
    return next(asked, left[0])


def _significant(evidence: list[Evidence], level: float) -> list[Evidence]:
    """Return what is left by Holm's procedure, most surprising first."""
    ranked = sorted(evidence, key=lambda item: item.p_value)
    for number, item in enumerate(ranked):
        if item.p_value * (len(ranked) - number) > level:
            return ranked[:number]
    return ranked


def _pruned(fit: Fit, named: list[tuple[Evidence, Named]]) -> tuple[Fit, list[tuple[Evidence, Named]], dict[int, Fit]]:
    """Take out terms of earlier rounds that later ones made superfluous.

    Returns:
        The fit, its named terms, and by its number the fit without each of them; not without the last, which was added
        in full knowledge of the others, if nothing was taken out.
    """
    number, lacking, whole = 1, dict[int, Fit](), fit
    while number < len(named) + (fit is not whole):
        without = _without(fit, number)
        lost = fit.log_likelihood - without.log_likelihood
        if number < len(named) and lost < max(_LEAST_NATS, fit.terms[number].cost_nats):
            fit, named, number, lacking = without, [*named[: number - 1], *named[number:]], 1, {}
        else:
            lacking[number] = without
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
        without = known or _without(fit, number)
        if without is not before:
            without = restart_base(without)
        block_s, forward = block_of(fit.data, found.term), found.term.cause in SLOW
        held = HeldOut(fit.data, block_s)
        if (block_s, forward) not in scores:
            scores[block_s, forward] = held.score(fit.terms, fit.theta, forward=forward)
        findings.append(
            Finding(
                cause=_ids(found.names)[0],
                names=_ids(found.names),
                probability=found.probability,
                p_value=evidence.p_value,
                d_nats=max(fit.log_likelihood - without.log_likelihood - 0.5 * found.term.start.size, 0.0),
                parameters=describe(fit, number, spread),
                gain=measure_gain(
                    held.score(without.terms, without.theta, forward=forward),
                    scores[block_s, forward],
                    fit.data.n,
                ),
                rms_before=without.innovation_rms,
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
    held = HeldOut(fit.data, min(block_of(fit.data, term) for term in fit.terms))
    before, after = (held.score(of.terms, of.theta, forward=forward) for of in (base, fit))
    return measure_gain(before, after, fit.data.n)


def _judge(finding: Finding, found: Named) -> tuple[Finding, bool]:
    """Return a finding without its name where that is more than the data can carry, and whether its term stays.

    A name claims that other readings are predicted better by it, so its gain on held-out blocks must be above 0: else
    it is `unexplained`, and out of the model. Not the gain's lower bound: whether there is something at all is what the
    check's p-value says, and a few blocks' spread would hide most of what is just large enough to be seen. A term that
    predicts but whose name was refused stays, so that what else there is can be found beside it.
    """
    if finding.remark:  # its figures are wrong as stated, whatever predicts better
        return finding, True
    gain, name = finding.gain, found.names[0].replace("_", " ")
    lag = finding.parameters.get("lag_s")
    if gain.nats_total <= 0:
        why = f"which fits but does not predict held-out blocks ({gain.nats_total:+.1f} nats)"
    elif lag is not None and lag.value < 0:
        why = f"by {-lag.value:.3g} s the wrong way: nothing follows what has not happened yet"
    elif found.refused:
        return _nameless(finding, f"looks most like {name}, {found.refused}; record again to see it twice"), True
    else:
        return finding, True
    nothing = Gain(0.0, 0.0, 0.0, 0.0)
    out = replace(finding, parameters={}, gain=nothing, rms_after=finding.rms_before)
    return _nameless(out, f"looks most like {name}, {why}; record for longer"), False


def _less_sure(finding: Finding) -> Finding:
    """Return a finding of a model that leaves something: what has no sharp mark may be part of that."""
    return _doubted(finding) if finding.cause in _BROAD else finding


def _doubted(finding: Finding) -> Finding:
    """Return a finding whose name is the nearest, and may not be it."""
    if "unexplained" in finding.names:
        return finding
    return replace(finding, names=(*finding.names, "unexplained"), probability=finding.probability / 2)


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


def _stop(fit: Fit, base: Fit, found: int) -> str:
    """Return why no further term is sought, in words; empty where one is."""
    if found >= _MOST_FINDINGS:
        return f"the search stops after {found} findings"
    if _weight(fit) > max(_HEAVIEST * _weight(base), _LIGHT / fit.data.n):
        return (
            f"the search stops after {found} findings, as the model has grown too large to be fitted in reasonable time"
        )
    return ""


def _weight(fit: Fit) -> float:
    return float((len(fit.states) + 1) ** 2 * max(fit.theta.size, 6))


def _unexplained(left: list[Evidence], fit: Fit, stopped: str) -> Finding:
    nearest = next((term.cause for item in left for term in item.terms), "none of the catalogue")
    what = f"{left[0].check.split(':')[0].split(', in ')[0]} looks most like {nearest.replace('_', ' ')}, which"
    if stopped:
        text = f"{what} was not fitted: {stopped}; mend what is named above and record again"
    else:
        text = f"{what} does not explain it; record again to see it twice"
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
