"""Commands on models: tune, paper, diagnose, simulate."""

import math
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import typer
from rich.console import Console

from aemd.cli.common import (
    Field,
    Jobs,
    Json,
    Scheduler,
    TimeOf,
    Topic,
    app,
    report_failures,
    select,
    show,
    stderr,
)
from aemd.errors import UsageError

Slow = Literal["disturbance", "input"]


@app.command()
def tune(
    file: Annotated[str, typer.Argument(metavar="FILE", help="A recording, or many: a folder or a quoted pattern.")],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="M.toml", help="The new model file; of many, the folder of theirs.")
    ],
    model: Annotated[
        Path | None,
        typer.Option("--model", metavar="M.toml", help="A model whose estimator is refined, its parts as they are."),
    ] = None,
    from_s: Annotated[float, typer.Option("--from", min=0.0, help="Begin of the stretch, s from the first.")] = 0.0,
    to_s: Annotated[float, typer.Option("--to", min=0.0, help="End of the stretch, s from the first.")] = math.inf,
    lag: Annotated[
        int | None,
        typer.Option(min=0, max=10_000, help="Readings by which the estimate may trail; 0, or the model's."),
    ] = None,
    noise_v: Annotated[
        float | None, typer.Option("--noise", min=0.0, help="White noise of a reading, V, where it is known.")
    ] = None,
    slowest_s: Annotated[
        float | None,
        typer.Option("--slowest-signal", min=0.0, help="Longest period of the signal, s; slower is drift."),
    ] = None,
    slow: Annotated[
        Slow | None, typer.Option(help="What the slow part is: the sensor's drift (the default), or the input's.")
    ] = None,
    resonances: Annotated[
        int, typer.Option(min=0, max=32, help="Most resonances of an input that vibrates, 0 for none; 20 take minutes.")
    ] = 0,
    html: Annotated[Path | None, typer.Option(metavar="FILE.html", help="Of many: write the table as a page.")] = None,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    json: Json = False,
) -> None:
    """Find the parameters of the `imm` estimator in a stretch of readings, by their likelihood."""
    from aemd.archive import is_pattern, tune_archive
    from aemd.tune import read_start, tune_recording

    if model is not None:  # what is wrong with it is said once, not of each file
        read_start(model, slow=slow, slowest_signal_s=slowest_s, resonances=resonances)
    options: dict[str, Any] = {
        "model": model,
        "from_s": from_s,
        "to_s": to_s,
        "lag": lag,
        "noise_V": noise_v,
        "slowest_signal_s": slowest_s,
        "resonances": resonances,
        "slow": slow,
    }
    if is_pattern(file):
        many = tune_archive(file, out, jobs=jobs, scheduler=scheduler, console=stderr(), **options)
        _show_table(many, "aemd tune", html, json=json)
        return
    result = tune_recording(Path(file), out, **options)
    show(result, "Tuned", json=json)


@app.command()
def paper(
    seeds: Annotated[int, typer.Option(min=2, max=100_000, help="Records of each test.")] = 200,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes; one for each processor.")] = None,
    figures: Annotated[Path | None, typer.Option(metavar="DIR", help="Draw Figures 4 and 5 here.")] = None,
    json: Json = False,
) -> None:
    """Run the paper's tests again: its tables and figures beside ours, judged by error against truth and by gain."""
    from aemd.display import counting
    from aemd.paper import as_mapping, as_text, draw_figures, run_paper
    from aemd.report import as_json

    with counting("paper", stderr()) as progress:
        result = run_paper(seeds, jobs, progress)
    print(as_json(as_mapping(result)) if json else as_text(result))
    if figures is not None:
        for picture in draw_figures(result.parameters[0], figures):
            stderr().print(f"picture={picture}", highlight=False, markup=False)


@app.command()
def diagnose(
    file: Annotated[
        str,
        typer.Argument(
            metavar="FILE", help="A recording, a table time,value[,witness,...], or many: a folder or a quoted pattern."
        ),
    ],
    model: Annotated[
        Path | None,
        typer.Option("--model", metavar="M.toml", help="The model to criticise instead of the fitted base."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="M.toml", help="Write the extended model, for simulate.")
    ] = None,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Write the report as one page with pictures.")
    ] = None,
    line_frequency: Annotated[float | None, typer.Option(min=1.0, help="Of the mains, Hz, where it is known.")] = None,
    topic: Topic = None,
    field: Field = None,
    time: TimeOf = None,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    json: Json = False,
) -> None:
    """Say what our model gets wrong about measured data, what that is consistent with, and what fixing it is worth."""
    from aemd.archive import diagnose_archive, is_pattern
    from aemd.diagnose import diagnose as criticise
    from aemd.diagnose import format_diagnosis, write_extended, write_html
    from aemd.report import as_json

    if is_pattern(file):
        if out is not None:
            raise UsageError(f"{file}: means many files, which have no one extended model; leave out --out")
        many = diagnose_archive(
            file,
            jobs=jobs,
            scheduler=scheduler,
            model=model,
            line_frequency_hz=line_frequency,
            selection=select(topic, field, time),
            console=stderr(),
        )
        _show_table(many, "aemd diagnose", html, json=json)
        return
    with ExitStack() as stack:
        source = Path(file)
        if selection := select(topic, field, time):
            from aemd.tables import import_mcap

            source = Path(stack.enter_context(TemporaryDirectory())) / source.name
            import_mcap(Path(file), source, selection=selection)
        with stderr().status("reading") as status:
            found = criticise(source, model=model, line_frequency_hz=line_frequency, progress=status.update)
        told = replace(found, path=file)
        print(as_json(told) if json else format_diagnosis(told), end="\n" if json else "")
        if out is not None:
            write_extended(told, out)
            stderr().print(f"model={out}", highlight=False, markup=False)
        if html is not None:
            write_html(found, html)
            stderr().print(f"report={html}", highlight=False, markup=False)


@app.command()
def simulate(
    model: Annotated[Path, typer.Option(metavar="M.toml", help="Terms and effects that make the readings.")],
    seconds: Annotated[float, typer.Option(help="Length, s.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE.mcap", help="The new recording.")],
    seed: Annotated[int | None, typer.Option(min=0, help="Of the history; without one, the model's.")] = None,
    interval: Annotated[float, typer.Option(help="From reading to reading, s.")] = 0.06712,
    aperture: Annotated[float, typer.Option(help="Time that a reading averages over, s.")] = 0.02,
    json: Json = False,
) -> None:
    """Make the recording that a model would make."""
    from aemd.simulate import simulate as make

    result = make(model, seconds=seconds, seed=seed, out=out, interval_s=interval, aperture_s=aperture)
    show(result, "Simulated", json=json)


def _show_table(many: Any, title: str, html: Path | None, *, json: bool) -> None:
    """Print what an archive's files gave, write the page if one was asked for, and tell of those that gave nothing."""
    from aemd.archive import write_page
    from aemd.report import as_json

    if json:
        print(as_json(many.as_mapping()))
    else:
        Console().print(many)
    if html is not None:
        write_page(many, title, html)
        stderr().print(f"report={html}", highlight=False, markup=False)
    report_failures(many.failed)
