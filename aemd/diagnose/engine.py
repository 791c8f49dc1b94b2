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

from aemd.diagnose.catalogue import COVERED, NOT_COVERED
from aemd.diagnose.checks.integrity import check_raw
from aemd.diagnose.figures import compare_figures
from aemd.diagnose.findings import judge_all
from aemd.diagnose.fit import Fit, fit_base, residuals
from aemd.diagnose.given import BOUNDED, Given, accept
from aemd.diagnose.hidden import hidden
from aemd.diagnose.hypothesis import Data, make_data
from aemd.diagnose.intervals import covariance, describe
from aemd.diagnose.promise import promise
from aemd.diagnose.result import Diagnosis, Discrepancy, Finding, Verdict
from aemd.diagnose.search import search
from aemd.diagnose.series import Series, load_series
from aemd.diagnose.steadiness import compare_allan
from aemd.diagnose.translate import Told, as_tables, to_model
from aemd.simulate import read_model

__all__ = ["criticise", "diagnose"]

Floats = NDArray[np.float64]
Progress = Callable[[str], None]


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
    expected = stated[1] if stated else frozenset[str]()
    tell("fitting the base model")
    base = _begin(make_data(series), series, stated)
    sd_V = float(np.sqrt(np.median(base.variance[base.data.used]))) * base.data.unit_V
    tell("checking the readings themselves")
    defects = check_raw(series, sd_V)
    dropped, known = hidden(series, defects, expected & frozenset(BOUNDED), rounded=stated is not None)
    if dropped.any() or known is not None:
        base = _begin(make_data(series, dropped, known), series, stated)
    searched = search(base, line_frequency_hz, tell)
    tell("measuring gains on held-out blocks")
    judged = judge_all(searched, [defect for defect in defects if defect.cause not in expected])
    base, fit, spread = searched.base, judged.fit, judged.spread
    told = _told(fit, spread)
    return Diagnosis(
        verdict=_verdict(judged.findings),
        n=int(np.count_nonzero(series.used)),
        rate_hz=1 / series.interval_s,
        findings=judged.findings,
        discrepancies=tuple(
            [Discrepancy(d.check, d.observed, 0.0, d.expected, d.p_value) for d in defects]
            + [Discrepancy(e.check, e.observed, e.low, e.high, e.p_value) for e in searched.seen]
            + [item for number in range(len(fit.terms)) for item in compare_figures(fit, number, spread)]
        ),
        base_model=_tables(base, series.aperture_s, told if base is fit else _told(base, covariance(base))),
        extended_model=_tables(fit, series.aperture_s, told),
        allan=compare_allan(base, fit),
        promise=promise(base, fit, spread, series.aperture_s, told) if len(fit.terms) > len(base.terms) else None,
        left_out=series.left_out,
        path=series.path,
        seconds=time.perf_counter() - begun,
        gain=judged.together,
        covered=COVERED,
        not_covered=NOT_COVERED,
    )


def _begin(data: Data, series: Series, stated: tuple[Given, frozenset[str]] | None) -> Fit:
    """Return the hypothesis under criticism: the stated one as it is, else the base fitted."""
    if stated is None:
        return fit_base(data)
    stated[0].refuse(data)
    return residuals([replace(stated[0], aperture_s=series.aperture_s)], np.empty(0), data)


def _verdict(findings: tuple[Finding, ...]) -> Verdict:
    if not findings:
        return "nothing_found"
    return "unexplained" if any(item.cause == "unexplained" for item in findings) else "explained"


def _told(fit: Fit, spread: Floats) -> Told:
    """Return what is reported of each term, by its number."""
    return {number: describe(fit, number, spread) for number in range(len(fit.terms))}


def _tables(fit: Fit, aperture_s: float, told: Told) -> dict[str, Any]:
    """Return a fit as the catalogue's model, and its parameters with their intervals."""
    made, without = to_model(fit, aperture_s, told)
    return {
        **as_tables(made),
        "aperture_s": aperture_s,
        "without_term": list(without),
        "parameters": {
            ("base" if number == 0 else f"{number}_{term.cause}"): told[number] for number, term in enumerate(fit.terms)
        },
    }
