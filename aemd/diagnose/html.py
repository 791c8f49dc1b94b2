"""The report as one self-contained page: the verdict, and for each finding the picture that should convince.

Every picture shows the same figure of the data and of simulations: bands hold 95 % of records simulated from the base
and from the extended model. Where the data leave the base's band and stay in the extended one's, the term is needed and
enough.
"""

from base64 import b64encode
from dataclasses import replace
from html import escape
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from aemd import __version__
from aemd.diagnose.curves import Curve, after_jumps, folded, level_changes, levels, running_deviation, unwound
from aemd.diagnose.extend import model_of
from aemd.diagnose.fit import residuals
from aemd.diagnose.given import accept
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.leftover import LeftOver, left_over
from aemd.diagnose.report import format_diagnosis, format_finding
from aemd.diagnose.result import Diagnosis, Finding
from aemd.diagnose.series import Series, load_series
from aemd.errors import ConfigError, RecordingError
from aemd.model import Model

__all__ = ["write_html"]

Floats = NDArray[np.float64]

_SIMULATIONS = 40
_LONGEST = 20_000
"""Readings of each simulation; of a longer record the first so many are shown, so that the page is there in seconds."""
_COLOURS = {"data": "#1f2933", "base": "#c05621", "extended": "#2b6cb0"}
_KEY = {
    "data": "the readings",
    "base": "95 % of records that the base model makes",
    "extended": "95 % of those that the model with all findings makes",
}
_KEY_OF_RESIDUALS = {
    "data": "residuals of the model with all that has a name; a circle marks what chance gives once in 100 pictures",
    "extended": "where 95 % of the cells are if the model is right",
}
_STEP_S = 5.0
"""Over which a level is averaged on either side of a step."""
_SURPRISE = 2.0
"""Decades below 1 of the chance of a cell, over all cells of the picture, from which it is marked."""
_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>aemd diagnose: {title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #1f2933; }}
h1 {{ font-size: 1.4rem; }} h2 {{ font-size: 1.1rem; margin-top: 2.5rem; }}
img {{ width: 100%; }} pre {{ white-space: pre-wrap; background: #f5f7fa; padding: 1rem; }}
.key span {{ padding: 0 .6rem; border-left: .8rem solid; margin-right: 1rem; }}
</style></head><body>
<h1>{title}</h1>
<p><strong>{verdict}</strong></p>
{body}
<h2>The whole report</h2>
<pre>{text}</pre>
<p><small>aemd {version}; bands hold 95 % of {count} simulated records.</small></p>
</body></html>
"""


def write_html(diagnosis: Diagnosis, path: Path) -> None:
    """Write the page.

    Raises:
        RecordingError: the file that was diagnosed cannot be read again, or the page cannot be written.
    """
    series = _beginning(load_series(Path(diagnosis.path)))
    bands = {name: _simulate(model_of(diagnosis, extended=name == "extended"), series) for name in ("base", "extended")}
    text = format_diagnosis(diagnosis)
    parts = [_section("Readings, spectrum and Allan deviation", "", _overview(series, bands))]
    left: LeftOver | None = None
    shown = 0
    for number, finding in enumerate(diagnosis.findings, start=1):
        title = f"{number}. {finding.cause.replace('_', ' ')}"
        if finding.cause == "unexplained":
            left = left or _left_over(diagnosis, series)
        if finding.cause == "unexplained" and shown:
            text_of = f"{format_finding(finding)}\nWhat the residuals show is with finding {shown}."
            parts.append(_section(title, text_of, None))
        elif finding.cause == "unexplained" and left is not None:
            shown = number
            text_of = f"{left.sentence}\n{format_finding(finding)}"
            parts.append(_section(title, text_of, _residuals(left), key=False))
        else:
            parts.append(_section(title, format_finding(finding), _picture(finding, series, bands)))
    page = _PAGE.format(
        title=escape(Path(diagnosis.path).name),
        verdict=escape(text.splitlines()[0]),
        body="\n".join(parts),
        text=escape(text),
        version=__version__,
        count=_SIMULATIONS,
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {(error.strerror or str(error)).lower()}") from error


def _beginning(series: Series) -> Series:
    n = min(series.value_V.size, _LONGEST)
    return replace(
        series,
        time_s=series.time_s[:n],
        value_V=series.value_V[:n],
        index=series.index[:n],
        status=series.status[:n],
        witnesses={name: values[:n] for name, values in series.witnesses.items()},
    )


def _simulate(model: Model, series: Series) -> Floats:
    """Return simulated records at the data's instants, V, shape (simulations, n)."""
    n, step_s = series.value_V.size, series.interval_s
    start_s = np.arange(n, dtype=np.float64) * step_s
    made = np.empty((_SIMULATIONS, n))
    for number in range(_SIMULATIONS):
        values = replace(model, seed=number + 1).realise().read(start_s, min(series.aperture_s, step_s)).value_V
        made[number] = values[:n] if values.size >= n else np.resize(values, n)
    return made


def _left_over(diagnosis: Diagnosis, series: Series) -> LeftOver | None:
    """Return where the residuals are off that all named findings leave; none of a model without a likelihood."""
    try:
        given, _ = accept(model_of(diagnosis), diagnosis.path)
    except ConfigError:
        return None
    data = make_data(series)
    fit = residuals([replace(given, aperture_s=series.aperture_s)], np.empty(0), data)
    return left_over(fit.z, data.slot, data.used, data.interval_s)


def _residuals(left: LeftOver) -> Figure:
    """Return residuals over time, frequency, both and size; each beside what it should be, which is 1."""
    figure = Figure(figsize=(10, 7), layout="constrained")
    (top, beside), (below, last) = figure.subplots(2, 2)
    for axes, cells, name in (
        (top, left.over_time, "time, s"),
        (beside, left.over_frequency, "frequency, Hz"),
        (last, left.over_size, "residual, in its standard deviations"),
    ):
        axes.stairs(cells.high, cells.edges, baseline=cells.low, fill=True, color=_COLOURS["extended"], alpha=0.3)
        axes.stairs(cells.ratio, cells.edges, baseline=None, color=_COLOURS["data"], lw=1.2)
        what = "how many, over what should be" if cells is left.over_size else "energy, over what should be"
        axes.set(xlabel=name, ylabel=what)
    last.set(ylim=(0, min(2 * float(np.nanmax(left.over_size.high[2:-2])), 8.0)))
    surprise = -np.log10(np.maximum(left.p_value * left.p_value.size, 1e-12))
    mesh = below.pcolormesh(
        left.over_time.edges,
        left.band_edges_hz,
        np.clip(np.log2(np.maximum(left.energy, 1e-3)), -3, 3),
        cmap="PuOr_r",
        vmin=-3,
        vmax=3,
        rasterized=True,
    )
    bar = figure.colorbar(mesh, ax=below, label="energy, over what should be")
    bar.set_ticks([-3, -2, -1, 0, 1, 2, 3], labels=["1/8", "1/4", "1/2", "1", "2", "4", "8"])
    rows, columns = np.nonzero(surprise > _SURPRISE)
    middle_s, middle_hz = ((edges[1:] + edges[:-1]) / 2 for edges in (left.over_time.edges, left.band_edges_hz))
    below.plot(middle_s[columns], middle_hz[rows], "o", ms=4, mfc="none", color=_COLOURS["data"])
    below.set(xlabel="time, s", ylabel="frequency, Hz")
    return figure


def _section(title: str, text: str, figure: Figure | None, *, key: bool = True) -> str:
    lines = f"<h2>{escape(title)}</h2>{''.join(f'<p>{escape(line)}</p>' for line in text.splitlines())}"
    if figure is None:
        return lines
    stream = BytesIO()
    figure.savefig(stream, format="svg", bbox_inches="tight")
    picture = b64encode(stream.getvalue()).decode()
    shown = _KEY if key else _KEY_OF_RESIDUALS
    spans = "".join(f'<span style="border-color: {_COLOURS[name]}">{what}</span>' for name, what in shown.items())
    image = f'<img alt="{escape(title)}" src="data:image/svg+xml;base64,{picture}">'
    return f'{lines}{image}<p class="key">{spans}</p>'


def _overview(series: Series, bands: dict[str, Floats]) -> Figure:
    figure = Figure(figsize=(10, 8), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1)
    top.plot(series.time_s, series.value_V * 1e3, lw=0.5, color=_COLOURS["data"], rasterized=True)
    top.set(xlabel="time, s", ylabel="reading, mV")
    _draw(middle, _spectrum, series, bands)
    middle.set(xscale="log", yscale="log", xlabel="frequency, Hz", ylabel="density, V²/Hz")
    _draw(bottom, _allan, series, bands)
    bottom.set(xscale="log", yscale="log", xlabel="averaging time, s", ylabel="Allan deviation, V")
    return figure


def _picture(finding: Finding, series: Series, bands: dict[str, Floats]) -> Figure:
    """Return the figure that shows this kind of finding best."""
    figure = Figure(figsize=(10, 3.5), layout="constrained")
    axes = figure.subplots()
    values = finding.parameters
    shown = values.get("alias_hz") or values.get("frequency_hz")
    witness = next((name for name in series.witnesses if name.replace("_", " ") in finding.experiment), None)
    if finding.cause == "wandering_line":
        line = unwound(values["frequency_hz"].value, values["chirp_hz_per_s"].value)
        _draw(axes, line, series, bands)
        axes.set(yscale="log", xlabel="frequency with the sweep taken off, Hz", ylabel="density, V²/Hz")
    elif finding.cause == "periodic_glitch":
        _draw(axes, folded(values["period_s"].value), series, bands)
        axes.set(xlabel="time within the period, s", ylabel="mean level, V")
    elif finding.cause in ("ring_down", "shock_law"):
        _draw(axes, after_jumps, series, bands)
        axes.set(xlabel="time after a large change, s", ylabel="mean level, in sizes of the change")
    elif finding.cause in ("changing_noise", "signal_dependent_noise"):
        _draw(axes, running_deviation, series, bands)
        axes.set(xlabel="time, s", ylabel="deviation of neighbours, V")
    elif finding.cause == "range_switching":
        sign = 1.0 if float(np.nanmedian(series.value_V)) >= 0 else -1.0
        width_V = max(6 * abs(values["offset_V"].value), float(np.nanstd(series.value_V)))
        _draw(axes, levels(sign * values["level_V"].value, width_V), series, bands)
        axes.set(xlabel="reading, V", ylabel="readings")
    elif finding.cause in ("thermal_drift", "latency", "supply_coupling") and witness is not None:
        axes.plot(series.time_s, series.value_V * 1e3, lw=0.5, color=_COLOURS["data"], rasterized=True)
        axes.set(xlabel="time, s", ylabel="reading, mV")
        beside = axes.twinx()
        beside.plot(series.time_s, series.witnesses[witness], lw=1.2, color=_COLOURS["extended"], rasterized=True)
        beside.set(ylabel=witness)
    elif finding.cause == "popcorn_noise":
        near = series.time_s < 20 * values["dwell_s"].value
        axes.plot(series.time_s[near], series.value_V[near] * 1e3, ".-", lw=0.5, ms=2, color=_COLOURS["data"])
        axes.set(xlabel="time, s", ylabel="reading, mV")
    elif shown is not None:
        _draw(axes, lambda y, step_s: _fine_spectrum(y, step_s, shown.value), series, bands)
        axes.set(yscale="log", xlabel="frequency, Hz", ylabel="density, V²/Hz")
    elif finding.cause == "step":
        _draw(axes, level_changes(values["time_s"].value, _STEP_S), series, bands)
        axes.axvline(values["time_s"].value, color=_COLOURS["extended"], lw=0.8)
        axes.set(xlabel="time, s", ylabel=f"mean of the {_STEP_S:g} s after, less that before, V")
    elif "time_s" in values:
        at, width = values["time_s"].value, max(10 * series.interval_s, 20.0)
        near = np.abs(series.time_s - at) < 3 * width
        axes.plot(series.time_s[near], series.value_V[near] * 1e3, ".-", lw=0.5, ms=3, color=_COLOURS["data"])
        axes.axvline(at, color=_COLOURS["extended"], lw=0.8)
        axes.set(xlabel="time, s", ylabel="reading, mV")
    elif finding.cause in ("heavy_tails", "quantisation", "saturation", "dead_band"):
        _draw(axes, _tail, series, bands)
        axes.set(yscale="log", xlabel="change from one reading to the next, in its typical size", ylabel="part beyond")
    else:
        _draw(axes, _allan, series, bands)
        axes.set(xscale="log", yscale="log", xlabel="averaging time, s", ylabel="Allan deviation, V")
    return figure


def _draw(axes: Axes, figure_of: Curve, series: Series, bands: dict[str, Floats]) -> None:
    for name, records in bands.items():
        x, _ = figure_of(records[0], series.interval_s)
        curves = np.array([figure_of(record, series.interval_s)[1] for record in records])
        low, high = np.quantile(curves, [0.025, 0.975], axis=0)
        axes.fill_between(x, low, high, color=_COLOURS[name], alpha=0.3, lw=0)
    used = series.used
    filled = np.interp(series.time_s, series.time_s[used], series.value_V[used])
    x, y = figure_of(filled, series.interval_s)
    axes.plot(x, y, color=_COLOURS["data"], lw=1.2)


def _density(y: Floats, step_s: float) -> tuple[Floats, Floats]:
    taper = np.sin(np.pi * (np.arange(y.size) + 0.5) / y.size) ** 2
    power = np.abs(np.fft.rfft((y - y.mean()) * taper)) ** 2 * 2 * step_s / np.sum(taper**2)
    return np.asarray(np.fft.rfftfreq(y.size, step_s)[1:]), np.asarray(power[1:])


def _spectrum(y: Floats, step_s: float) -> tuple[Floats, Floats]:
    f, power = _density(y, step_s)
    edges = np.unique(np.geomspace(1, f.size + 1, 90).astype(int)) - 1
    counts = np.diff(edges)
    return np.add.reduceat(f, edges[:-1]) / counts, np.add.reduceat(power, edges[:-1]) / counts


def _fine_spectrum(y: Floats, step_s: float, centre_hz: float) -> tuple[Floats, Floats]:
    f, power = _density(y, step_s)
    at = int(np.argmin(np.abs(f - centre_hz)))
    near = slice(max(at - 60, 0), at + 60)
    return f[near], power[near]


def _allan(y: Floats, step_s: float) -> tuple[Floats, Floats]:
    """Return averaging times and the overlapping Allan deviation."""
    total = np.concatenate(([0.0], np.cumsum(y - y.mean())))
    counts = np.unique(np.geomspace(1, max(y.size // 5, 2), 30).astype(int))
    deviations = []
    for m in counts:
        means = (total[m:] - total[:-m]) / m
        deviations.append(np.sqrt(0.5 * np.mean((means[m:] - means[:-m]) ** 2)))
    return counts * step_s, np.array(deviations)


def _tail(y: Floats, step_s: float) -> tuple[Floats, Floats]:  # noqa: ARG001 - one of several figures
    change = np.abs(np.diff(y))
    x = np.linspace(0, 12, 200)
    typical = max(float(np.median(change)) * 1.4826, 1e-300)
    beyond = 1 - np.searchsorted(np.sort(change / typical), x) / change.size
    return x, np.maximum(beyond, 0.5 / change.size)
