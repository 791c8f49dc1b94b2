"""Commands on recordings: replay, import, export, info."""

import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from aemd.cli.common import (
    EstimatorName,
    Field,
    Jobs,
    Json,
    Model,
    Plot,
    Scheduler,
    TimeOf,
    Topic,
    app,
    draw,
    report_failures,
    select,
    show,
    stderr,
)
from aemd.errors import UsageError


@app.command()
def replay(
    file: Annotated[
        str,
        typer.Argument(metavar="FILE", help="A recording, or many: a folder or a quoted pattern, as 'DIR/**/*.mcap'."),
    ],
    estimator: EstimatorName = None,
    model: Model = None,
    out: Annotated[
        str | None,
        typer.Option("-o", "--out", metavar="FILE", help="Write readings and new estimates here; of many, the folder."),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Compare with the recorded estimates, bit for bit.")] = False,
    plot: Plot = None,
    topic: Topic = None,
    field: Field = None,
    time: TimeOf = None,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    json: Json = False,
) -> None:
    """Run a recording through the pipeline again: to the same bits, or with another estimator; or many."""
    from aemd import replay as offline
    from aemd.archive import is_pattern, replay_archive

    # As by Ctrl-C: what is half made is removed, and what was made of an archive is noted.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    selection = select(topic, field, time)
    if is_pattern(file):
        if out is None or check or plot is not None:
            raise UsageError(f"{file}: means many files; name a folder by --out, and leave out --check and --plot")
        many = replay_archive(
            file,
            out,
            jobs=jobs,
            scheduler=scheduler,
            estimator=estimator,
            model=model,
            selection=selection,
            console=stderr(),
        )
        show(many, "Replayed", json=json)
        report_failures(many.failed)
        return
    result = offline.replay(
        Path(file),
        estimator=estimator,
        model=model,
        out=None if out is None else Path(out),
        check=check,
        selection=selection,
        console=stderr(),
    )
    show(result, "Replayed", json=json)
    draw(result.out or result.file, plot, None if result.out else selection)
    if result.identical is False:
        raise typer.Exit(1)


@app.command(name="import")
def import_table(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Table time,value[,...] (.csv, .csv.gz), or any MCAP file.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE.mcap", help="The new recording.")],
    unit: Annotated[
        str | None,
        typer.Option(help="Unit of value times scale: V (if nothing says another), mV, uV, nV become volts."),
    ] = None,
    scale: Annotated[float, typer.Option(help="Factor of every value.")] = 1.0,
    topic: Topic = None,
    field: Field = None,
    time: TimeOf = None,
    json: Json = False,
) -> None:
    """Make a recording of a table, columns after the second becoming witness topics; or of a number in an MCAP file."""
    from aemd.tables import import_csv, import_mcap

    selection = select(topic, field, time)
    if selection or file.suffix == ".mcap":
        result = import_mcap(file, out, selection=selection, unit=unit, scale=scale, console=stderr())
    else:
        result = import_csv(file, out, unit=unit or "V", scale=scale)
    show(result, "Imported", json=json)


@app.command()
def export(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE.csv|.parquet", help="The new table.")],
    topic: Topic = None,
    field: Field = None,
    time: TimeOf = None,
    json: Json = False,
) -> None:
    """Write a recording as a table: index, time_s, value_V, status, estimate_V, sigma_V, window."""
    from aemd.tables import export as export_table

    show(export_table(file, out, selection=select(topic, field, time), console=stderr()), "Exported", json=json)


@app.command()
def info(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording.")],
    json: Json = False,
) -> None:
    """Tell what a recording holds."""
    from aemd.info import inspect

    show(inspect(file), "Recording", json=json)
