"""The critic: fit, check, name, add, again; then what each finding is worth.

Checks decide whether there is anything (Holm over checks, 0.3 % in the first round, half as much in each further one).
Joint refits decide what it is called. Held-out blocks decide what it is worth. None of the three serves for another.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.catalogue import COVERED, NOT_COVERED, experiment_for
from aemd.diagnose.checks.integrity import check_raw
from aemd.diagnose.checks.residuals import check_all
from aemd.diagnose.evidence import Defect, Evidence
from aemd.diagnose.fit import Fit, fit_base, refit, residuals, restart_base
from aemd.diagnose.gain import SLOW, HeldOut, block_of, measure_gain
from aemd.diagnose.given import BOUNDED, Given, accept
from aemd.diagnose.hidden import hidden
from aemd.diagnose.hypothesis import Data, make_data
from aemd.diagnose.intervals import covariance, describe
from aemd.diagnose.naming import Named, name
from aemd.diagnose.result import Diagnosis, Discrepancy, Finding, Gain, Verdict
from aemd.diagnose.series import Series, load_series
from aemd.diagnose.steadiness import compare_allan
from aemd.diagnose.translate import as_tables, to_model
from aemd.simulate import read_model

__all__ = ["criticise", "diagnose"]

Floats = NDArray[np.float64]
Progress = Callable[[str], None]

_LEVEL = 0.003
"""Family-wise probability of any finding on a clean record, first round."""
_ROUNDS = 6
_LEAST_NATS = 4.0
"""Log-likelihood that a term must add to be called an explanation: what a check sees and no term can use is
`unexplained`."""


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
    for number in range(_ROUNDS):
        tell(f"checking the residuals, round {number + 1}")
        evidence = check_all(fit, line_frequency_hz)
        left = _significant(evidence, _LEVEL / 2**number)
        seen = seen or left
        if not left:
            break
        tell(f"fitting what could explain: {left[0].check}")
        candidates = [term for item in left for term in item.terms]
        found = name(fit, candidates, _LEAST_NATS)
        if found is None:
            break
        named.append((_nominating(left, found), found))
        before, fit = fit, restart_base(found.fit)
    full = fit
    fit, named = _pruned(fit, named)
    tell("measuring gains on held-out blocks")
    findings = [_from_defect(defect, base) for defect in defects if defect.cause not in expected]
    spread = covariance(fit)
    explained = _explained(fit, named, spread, before if fit is full else None)
    judged = [_judge(item, found) for item, (_, found) in zip(explained, named, strict=True)]
    findings += [item for item, _ in judged]
    if not all(stays for _, stays in judged):  # what does not predict is no explanation, however well it fits
        kept = [0, *(number for number, (_, stays) in enumerate(judged, start=1) if stays)]
        fit = refit([fit.terms[number] for number in kept], fit.data, np.concatenate([fit.parts_of(at) for at in kept]))
        spread = covariance(fit)
    if left:
        findings.append(_unexplained(left, fit))
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
        ),
        base_model=_tables(base, series.aperture_s, spread if base is fit else covariance(base)),
        extended_model=_tables(fit, series.aperture_s, spread),
        allan=compare_allan(base, fit),
        path=series.path,
        seconds=time.perf_counter() - begun,
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


def _pruned(fit: Fit, named: list[tuple[Evidence, Named]]) -> tuple[Fit, list[tuple[Evidence, Named]]]:
    """Take out terms of earlier rounds that later ones made superfluous."""
    number = 1
    while number < len(named):  # the last was added in full knowledge of the others
        kept = [at for at in range(len(fit.terms)) if at != number]
        without = refit([fit.terms[at] for at in kept], fit.data, np.concatenate([fit.parts_of(at) for at in kept]))
        lost = fit.log_likelihood - without.log_likelihood
        if lost < max(_LEAST_NATS, fit.terms[number].cost_nats):
            fit, named = without, [*named[: number - 1], *named[number:]]
        else:
            number += 1
    return fit, named


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


def _explained(fit: Fit, named: list[tuple[Evidence, Named]], spread: Floats, before: Fit | None) -> list[Finding]:
    """Return a finding for each term, measured against the same model without it.

    Args:
        fit: base and terms.
        named: the terms with their evidence.
        spread: covariance of the fit's free numbers.
        before: the fit without the last term, where it is known.
    """
    findings = []
    for number, (evidence, found) in enumerate(named, start=1):
        if before is not None and number == len(named):
            without = before
        else:
            terms = [term for at, term in enumerate(fit.terms) if at != number]
            start = np.concatenate([fit.parts_of(at) for at in range(len(fit.terms)) if at != number])
            without = restart_base(refit(terms, fit.data, start))
        held, forward = HeldOut(fit.data, block_of(fit.data, found.term)), found.term.cause in SLOW
        findings.append(
            Finding(
                cause=found.names[0],
                names=found.names,
                probability=found.probability,
                p_value=evidence.p_value,
                d_nats=max(fit.log_likelihood - without.log_likelihood - 0.5 * found.term.start.size, 0.0),
                parameters=describe(fit, number, spread),
                gain=measure_gain(
                    held.score(without.terms, without.theta, forward=forward),
                    held.score(fit.terms, fit.theta, forward=forward),
                    fit.data.n,
                ),
                rms_before=without.innovation_rms,
                rms_after=fit.innovation_rms,
                experiment=experiment_for(found.names[0], getattr(found.term, "witness", "")),
            )
        )
    return findings


def _judge(finding: Finding, found: Named) -> tuple[Finding, bool]:
    """Return a finding without its name where that is more than the data can carry, and whether its term stays.

    A name claims that other readings are predicted better by it, so its gain on held-out blocks must be above 0: else
    it is `unexplained`, and out of the model. Not the gain's lower bound: whether there is something at all is what the
    check's p-value says, and a few blocks' spread would hide most of what is just large enough to be seen. A term that
    predicts but whose name was refused stays, so that what else there is can be found beside it.
    """
    gain, name = finding.gain, finding.cause
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


def _nameless(finding: Finding, text: str) -> Finding:
    return replace(finding, cause="unexplained", names=("unexplained",), experiment=text)


def _unexplained(left: list[Evidence], fit: Fit) -> Finding:
    nearest = next((term.cause for item in left for term in item.terms), "none of the catalogue")
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
        experiment=f"{left[0].check}: looks most like {nearest}, which does not explain it; record again"
        " to see it twice",
    )
