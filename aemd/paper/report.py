"""The result as text, ours beside the paper's, and as plain values for JSON."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from aemd.paper.claims import PAPER_VARIANCES_MV2, explanations, paper_verdicts, rival_verdicts
from aemd.paper.measure import MEASURES
from aemd.paper.methods import BETTER, METHODS, PAPERS
from aemd.paper.protocol import CONDITIONS, IMPULSE_LIMIT_V, IMPULSES, SHOCK_GROUPS, SQUARE_WAVES
from aemd.paper.run import Interval, PaperResult

__all__ = ["as_mapping", "as_text"]

TABLE_1 = (
    ("likelihood", "eq. 4 to 10 over the last v readings", "the same, in closed form"),
    ("window v", "15, 10 or 5 by the spread of slopes (eq. 17)", "the same; 10 in REM, which the paper does not say"),
    ("E step", "KF over the window", "the same (the smoother of section 3 is an option)"),
    ("M step", "u: mean of z - x over the window (eq. 15)", "the same"),
    ("stop", "eq. 16 with 0.01, or r_max (not stated)", "the same on sizes, |dQ| < 0.01 |Q|, or 10 passes"),
    ("result", "x at the end of the window", "the same"),
)


def as_mapping(result: PaperResult) -> dict[str, Any]:
    """Return the result as plain values: by condition and method each measure's [low, mean, high], NaN as None."""
    mapping: dict[str, Any] = {
        condition: {method: {name: _plain(figures[name]) for name in MEASURES} for method, figures in methods.items()}
        for condition, methods in result.figures.items()
    }
    mapping["better"] = BETTER
    mapping["seeds"] = result.seeds
    mapping["scales"] = asdict(result.scales)
    mapping["ratios"] = {
        condition: {
            method: {other: list(ratio) for other, ratio in others.items()} for method, others in methods.items()
        }
        for condition, methods in result.ratios.items()
    }
    mapping["sweep"] = [asdict(row) for row in result.sweep]
    mapping["parameters"] = [
        {name: asdict(options) for name, options in parameters.items()} for parameters in result.parameters
    ]
    mapping["claims"] = [asdict(verdict) for verdict in paper_verdicts(result)]
    mapping["limits"] = [asdict(verdict) for verdict in rival_verdicts(result)]
    return mapping


def as_text(result: PaperResult) -> str:
    """Return everything for a reader at a terminal, at most 120 columns wide where the words allow it."""
    return "\n".join(line.rstrip() for line in _lines(result)) + "\n"


def _lines(result: PaperResult) -> Iterator[str]:
    yield f"Records of 1,000 readings, {result.seeds} seeds; [low, high] is a 95 % confidence interval of the mean."
    yield ""
    yield "Table 1. The method, as the paper states it and as it is run here"
    yield from _table(("step", "paper", "here"), TABLE_1)
    yield ""
    yield "Table 2. Disturbances of the static test (displacements from the paper, voltages by the rule)"
    yield from _table(
        ("displacement", "shocks", "cycle", "in a reading"),
        [
            (
                f"{g.displacement_mm:g} mm",
                g.shocks,
                f"{g.cycle_s:g} s",
                _millivolts(g.displacement_mm * result.scales.shock_V_per_mm),
            )
            for g in SHOCK_GROUPS
        ],
    )
    yield f"and a slow fluctuation of {_millivolts(result.scales.slow_V)} rms"
    yield ""
    yield from _variances("static", "Table 3", result)
    yield ""
    yield "Table 4. Disturbances of the dynamic test"
    yield from _table(
        ("amplitude", "frequency", "duration", "load", "before the aperture"),
        [
            ("3 mm", "-", "12 us", f"{IMPULSES} impulses", f"within {_millivolts(IMPULSE_LIMIT_V)} in a reading"),
            *(
                (
                    f"{w.amplitude_mm:g} mm",
                    f"{w.frequency_hz:g} Hz",
                    f"{w.duration_s:g} s",
                    "square wave",
                    _millivolts(w.amplitude_mm * result.scales.square_V_per_mm),
                )
                for w in SQUARE_WAVES
            ),
        ],
    )
    yield ""
    yield from _variances("dynamic", "Table 5", result)
    yield ""
    for condition in CONDITIONS:
        yield f"{condition.capitalize()} test: what the paper's figure hides"
        yield from _condition(result.figures[condition])
        yield ""
    yield "Passes: REM and AEM with the stop rule off, so that every window takes r_max of them"
    yield from _table(
        ("method", "test", "r_max", "variance mV²", "squared error mV²", "correlation with a window ago"),
        [
            (
                row.method,
                row.condition,
                row.r_max,
                f"{row.variance_mV2:.3g}",
                f"{row.mse_mV2:.3g}",
                f"{row.repeats:.3f}",
            )
            for row in result.sweep
        ],
    )
    yield ""
    yield "The paper's claims"
    for verdict in paper_verdicts(result):
        yield f"  {'reproduced' if verdict.holds else 'NOT reproduced'}: {verdict.claim}; {verdict.because}"
    yield ""
    yield "Why"
    for sentence in explanations(result):
        yield f"  {sentence}"
    yield ""
    verdicts = rival_verdicts(result)
    yield f"The better estimator, {BETTER}: {sum(v.holds for v in verdicts)} of {len(verdicts)} limits met"
    for verdict in verdicts:
        yield f"  {'met' if verdict.holds else 'MISSED'}: {verdict.claim}; {verdict.because}"
    yield ""
    yield from _physics(result)


def _variances(condition: str, table: str, result: PaperResult) -> Iterator[str]:
    yield f"{table}. Variance of the estimate, {condition} test, mV² (KF's by the rule, the others are predictions)"
    printed, ours = PAPER_VARIANCES_MV2[condition], result.figures[condition]
    yield from _table(
        ("method", "paper", "here", "", "paper: AEM / method", "here: AEM / method", "squared error: AEM / method"),
        [
            (
                method,
                f"{printed[method]:g}",
                *_figure(ours[method]["variance_mV2"]),
                f"{100 * printed['AEM'] / printed[method]:.3g} %",
                f"{100 * ours['AEM']['variance_mV2'][1] / ours[method]['variance_mV2'][1]:.3g} %",
                f"{100 * ours['AEM']['mse_mV2'][1] / ours[method]['mse_mV2'][1]:.3g} %",
            )
            for method in PAPERS
        ],
    )


def _condition(methods: Mapping[str, Mapping[str, Interval]]) -> Iterator[str]:
    headings = ["method", "variance mV²", "", "squared error mV²", ""]
    with_gain = not math.isnan(methods["KF"]["gain"][1])
    if with_gain:
        headings += ["gain", "", "undisturbed", "", "phase rad"]
    headings += ["in 95 % quiet", "disturbed"]
    rows = []
    for method in METHODS:
        figures = methods[method]
        row = [method, *_figure(figures["variance_mV2"]), *_figure(figures["mse_mV2"])]
        if with_gain:
            row += [*_figure(figures["gain"]), *_figure(figures["gain_undisturbed"])]
            row.append("-" if math.isnan(figures["phase_rad"][1]) else f"{figures['phase_rad'][1]:+.3f}")
        row += [f"{100 * figures[name][1]:.1f} %" for name in ("coverage_quiet", "coverage_disturbed")]
        rows.append(row)
    yield from _table(headings, rows)


def _physics(result: PaperResult) -> Iterator[str]:
    slow = (1e3 * result.scales.slow_V) ** 2
    one, tuned = result.figures["static"]["imm_one"]["mse_mV2"][1], result.figures["static"]["imm"]["mse_mV2"][1]
    yield (
        f"One set for all tests: its squared error in the static test is {one:.3g} mV²; the slow fluctuation there is "
        f"{slow:.3g} mV². The test's own set, which has no input to estimate, comes to {tuned:.2g} mV² and keeps "
        f"{result.figures['probe']['imm']['gain'][1]:.2g} of the probe. Its intervals hold the truth in "
        f"{100 * result.figures['static']['imm']['coverage_quiet'][1]:.1f} % of quiet readings: the truth there is "
        "the constant that it expects, and an interval of any width about a known constant holds it; sigma is the "
        "hundredth of the noise that tuning allows an input it did not find. Those of the one set hold it in "
        f"{100 * result.figures['static']['imm_one']['coverage_quiet'][1]:.1f} %: slow fluctuation passes for input."
    )
    yield (
        "A model that expects 2 mV² of Markov input with a time constant of a second expects most of what is slow to "
        "be input as well: at the frequencies of the slow fluctuation that input's spectrum lies above it, and where "
        "two spectra overlap no filter can divide a reading better than in their ratio."
    )


def _figure(interval: Interval) -> tuple[str, str]:
    low, middle, high = interval
    return f"{middle:.3g}", f"[{low:.3g}, {high:.3g}]"


def _millivolts(value_V: float) -> str:
    return f"±{1e3 * value_V:.3g} mV"


def _plain(interval: Interval) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in interval]


def _table(headings: Sequence[str], rows: Sequence[Sequence[Any]]) -> Iterator[str]:
    """Yield a table, columns as wide as they need, numbers to the right of their column."""
    cells = [[str(cell) for cell in row] for row in (headings, *rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(headings))]
    for row in cells:
        yield "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
