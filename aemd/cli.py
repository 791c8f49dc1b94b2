"""The command line: parse, call, print, exit code; no logic.

Exit codes: 0 done (gaps and losses are results, not failures); 1 the instrument or a recording failed, or `--check`
found damage or a difference; 2 usage; 78 a config or model file is wrong; 130 interrupted before there was a result.
"""

import math
import os
import sys
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from typing import Annotated, Any, Literal, NoReturn

import typer
from rich.console import Console
from typer import TyperException

from aemd import __version__
from aemd.errors import AemdError, UsageError

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Read a digital multimeter without losing a reading, estimate the true input, record both.",
)

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON, alone, on stdout.")]
Plot = Annotated[
    Path | None,
    typer.Option(
        "--plot",
        metavar="FILE.png",
        help="Draw readings, estimate and window.",
        callback=lambda path: _picture(path),  # noqa: PLW0108 - it stands further down
    ),
]
EstimatorName = Annotated[str | None, typer.Option("--estimator", metavar="NAME", help="Estimator to use.")]
Slow = Literal["disturbance", "input"]
Model = Annotated[
    Path | None, typer.Option("--model", metavar="M.toml", help="Estimator and options from a file, as tune writes it.")
]


@app.command()
def acquire(
    config: Annotated[
        Path | None, typer.Argument(metavar="[CONFIG]", help="Config file; without one, the simulated meter.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="Stop after so many seconds of readings.")] = None,
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


@app.command()
def tune(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="M.toml", help="The new model file.")],
    from_s: Annotated[float, typer.Option("--from", min=0.0, help="Begin of the stretch, s from the first.")] = 0.0,
    to_s: Annotated[float, typer.Option("--to", min=0.0, help="End of the stretch, s from the first.")] = math.inf,
    lag: Annotated[int, typer.Option(min=0, max=10_000, help="Readings by which the estimate may trail.")] = 0,
    noise_v: Annotated[
        float | None, typer.Option("--noise", min=0.0, help="White noise of a reading, V, where it is known.")
    ] = None,
    slowest_s: Annotated[
        float | None,
        typer.Option("--slowest-signal", min=0.0, help="Longest period of the signal, s; slower is drift."),
    ] = None,
    slow: Annotated[
        Slow, typer.Option(help="What the slow part is: the sensor's drift, or the input's.")
    ] = "disturbance",
    json: Json = False,
) -> None:
    """Find the parameters of the `imm` estimator in a stretch of readings, by their likelihood."""
    from aemd.tune import tune_recording

    result = tune_recording(
        file, out, from_s=from_s, to_s=to_s, lag=lag, noise_V=noise_v, slowest_signal_s=slowest_s, slow=slow
    )
    _show(result, "Tuned", json=json)


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

    with counting("paper", _stderr()) as progress:
        result = run_paper(seeds, jobs, progress)
    print(as_json(as_mapping(result)) if json else as_text(result))
    if figures is not None:
        for picture in draw_figures(result.parameters[0], figures):
            _stderr().print(f"picture={picture}", highlight=False, markup=False)


@app.command()
def diagnose(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording, or a table time,value[,witness,...].")],
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
    line_frequency: Annotated[float | None, typer.Option(min=0.0, help="Of the mains, Hz, where it is known.")] = None,
    json: Json = False,
) -> None:
    """Say what our model gets wrong about measured data, what that is consistent with, and what fixing it is worth."""
    from aemd.diagnose import diagnose as criticise
    from aemd.diagnose import format_diagnosis, write_extended, write_html
    from aemd.report import as_json

    with _stderr().status("reading") as status:
        found = criticise(file, model=model, line_frequency_hz=line_frequency, progress=status.update)
    print(as_json(found) if json else format_diagnosis(found), end="\n" if json else "")
    if out is not None:
        write_extended(found, out)
        _stderr().print(f"model={out}", highlight=False, markup=False)
    if html is not None:
        write_html(found, html)
        _stderr().print(f"report={html}", highlight=False, markup=False)


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
    _show(result, "Simulated", json=json)


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
    json: Json = False,
) -> None:
    """Serve the simulated meter to anyone's client, until Ctrl-C."""
    from aemd import session
    from aemd.config import load_config
    from aemd.report import as_json
    from aemd.service import stopping_on_signals

    settings = load_config(config).with_resource("sim")
    stop: SimpleQueue[None] = SimpleQueue()  # its put is reentrant, as a signal handler's must be
    with stopping_on_signals(lambda: stop.put(None)), session.simulated(settings, host, port) as resource:
        print(as_json({"resource": resource}) if json else resource, flush=True)
        stop.get()


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


def _picture(path: Path | None) -> Path | None:
    """Refuse, before anything is done, a picture that could not be drawn after it."""
    if path is not None and path.suffix not in {".png", ".pdf", ".svg"}:
        raise UsageError(f"--plot {path}: must end in .png, .pdf or .svg")
    if path is not None and not path.absolute().parent.is_dir():
        raise UsageError(f"--plot {path}: no such folder: {path.parent}; make it first")
    return path


def _draw(recording: str, picture: Path | None) -> None:
    if picture is not None:
        from aemd.picture import draw

        draw(Path(recording), picture)
        _stderr().print(f"picture={picture}", highlight=False, markup=False)


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
        code = app(sys.argv[1:] or ["--help"], standalone_mode=False)
        sys.stdout.flush()
    except AemdError as error:
        _fail(str(error), error.exit_code)
    except TyperException as error:
        context = getattr(error, "ctx", None)
        command = context.command_path if context is not None else "aemd"
        _fail(f"{error.format_message().rstrip('.')}; see {command} --help", UsageError.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        _fail("interrupted", 130)
    except BrokenPipeError:  # whoever read us has heard enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        with suppress(OSError):  # what could not be written would be tried again, and told of, at the exit
            sys.stdout.close()
        _fail(f"stdout: cannot be written: {(error.strerror or str(error)).lower()}; redirect it elsewhere", 1)
    else:
        sys.exit(code)


def _fail(message: str, code: int) -> NoReturn:
    print(f"aemd: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(code)
