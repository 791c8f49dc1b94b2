"""The command line: parse, call, print, exit code; no logic.

Exit codes: 0 done (gaps and losses are results, not failures); 1 the instrument or a recording failed, or `--check`
found a difference; 2 usage; 78 the config file is wrong.
"""

import sys
import threading
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from aemd import __version__
from aemd.errors import AemdError

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Read a digital multimeter without losing a reading, estimate the true input, record both.",
)

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON, alone, on stdout.")]
Plot = Annotated[Path | None, typer.Option("--plot", metavar="FILE.png", help="Draw readings, estimate and window.")]
EstimatorName = Annotated[str | None, typer.Option("--estimator", metavar="NAME", help="Estimator to use.")]
Model = Annotated[
    Path | None, typer.Option("--model", metavar="M.toml", help="Estimator and options from a file, as tune writes it.")
]


@app.command()
def acquire(
    config: Annotated[
        Path | None, typer.Argument(metavar="[CONFIG]", help="Config file; without one, the simulated meter.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(min=0.0, help="Stop after so many seconds of readings.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder of the recording.")] = None,
    resource: Annotated[str | None, typer.Option(help='VISA resource of the meter, or "sim".')] = None,
    estimator: EstimatorName = None,
    model: Model = None,
    plot: Plot = None,
    json: Json = False,
) -> None:
    """Acquire from a meter into a recording, estimating online, until --seconds are over or Ctrl-C."""
    from aemd import session
    from aemd.config import load_config, load_estimator, name_estimator

    settings = load_config(config)
    if resource is not None:
        settings = settings.with_resource(resource)
    if model is not None:
        settings = settings.with_estimator(load_estimator(model))
    if estimator is not None:
        settings = settings.with_estimator(name_estimator(estimator, settings.estimator))
    result = session.acquire(settings, seconds=seconds, directory=out, console=_stderr())
    _show(result, "Acquired", json=json)
    _draw(result.file, plot)


@app.command()
def replay(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording.")],
    estimator: EstimatorName = None,
    model: Model = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write readings and new estimates here.")] = None,
    check: Annotated[bool, typer.Option("--check", help="Compare with the recorded estimates, bit for bit.")] = False,
    plot: Plot = None,
    json: Json = False,
) -> None:
    """Run a recording through the pipeline again: to the same bits, or with another estimator."""
    from aemd import replay as offline

    result = offline.replay(file, estimator=estimator, model=model, out=out, check=check, console=_stderr())
    _show(result, "Replayed", json=json)
    if plot is not None:
        _draw(result.out or result.file, plot)
    if result.identical is False:
        raise typer.Exit(1)


@app.command(name="import")
def import_table(
    file: Annotated[Path, typer.Argument(metavar="FILE.csv[.gz]", help="Header time,value[,...]: seconds, reading.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE.mcap", help="The new recording.")],
    unit: Annotated[str, typer.Option(help="Unit of value times scale: V, mV, uV, nV become volts.")] = "V",
    scale: Annotated[float, typer.Option(help="Factor of every value.")] = 1.0,
    json: Json = False,
) -> None:
    """Make a recording of a table; columns after the second become witness topics."""
    from aemd.tables import import_csv

    _show(import_csv(file, out, unit=unit, scale=scale), "Imported", json=json)


@app.command()
def export(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE.csv|.parquet", help="The new table.")],
    json: Json = False,
) -> None:
    """Write a recording as a table: index, time_s, value_V, status, estimate_V, sigma_V, window."""
    from aemd.tables import export as export_table

    _show(export_table(file, out), "Exported", json=json)


@app.command()
def info(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording.")],
    json: Json = False,
) -> None:
    """Tell what a recording holds."""
    from aemd.info import inspect

    _show(inspect(file), "Recording", json=json)


@app.command()
def sim(
    config: Annotated[
        Path | None, typer.Argument(metavar="[CONFIG]", help="Config file whose [simulator] is served.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0 takes a free one.")] = 5025,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
) -> None:
    """Serve the simulated meter to anyone's client, until Ctrl-C."""
    from aemd import session
    from aemd.config import load_config
    from aemd.service import stopping_on_signals

    settings = load_config(config).with_resource("sim")
    stop = threading.Event()
    with session.simulated(settings, host, port) as resource, stopping_on_signals(stop.set):
        print(resource, flush=True)
        stop.wait()


@app.command(name="check-config")
def check_config(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A config file.")],
    json: Json = False,
) -> None:
    """Check a config file and print every key with its value, defaults included."""
    from aemd.config import load_config
    from aemd.report import as_json, as_toml

    tables = load_config(file).as_tables()
    print(as_json(tables) if json else as_toml(tables))


def _show(result: Any, title: str, *, json: bool) -> None:
    from aemd.report import as_json, as_table

    if json:
        print(as_json(result))
    else:
        Console().print(as_table(result, title))


def _draw(recording: str, picture: Path | None) -> None:
    if picture is not None:
        from aemd.picture import draw

        draw(Path(recording), picture)
        _stderr().print(f"picture={picture}", highlight=False)


def _stderr() -> Console:
    return Console(stderr=True)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"aemd {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print it.")] = False,
) -> None:
    """Options of every command."""


def main() -> None:
    """Run the command line; an error that a user can meet becomes one line and its exit code."""
    try:
        app()
    except AemdError as error:
        print(f"aemd: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print("aemd: interrupted", file=sys.stderr)
        sys.exit(130)
