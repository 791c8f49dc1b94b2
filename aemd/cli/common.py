"""What the commands share: the app, options that several take, and how a result is shown."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from typer.core import TyperCommand

from aemd.errors import UsageError

if TYPE_CHECKING:
    from aemd.record.foreign import Selection

__all__ = [
    "AddressCommand",
    "EstimatorName",
    "Field",
    "Jobs",
    "Json",
    "Model",
    "Plot",
    "Scheduler",
    "TimeOf",
    "Topic",
    "app",
    "draw",
    "report_failures",
    "select",
    "show",
    "stderr",
]

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
Model = Annotated[
    Path | None, typer.Option("--model", metavar="M.toml", help="Estimator and options from a file, as tune writes it.")
]
Topic = Annotated[
    str | None, typer.Option("--topic", metavar="NAME", help="Topic with the readings, in another program's MCAP file.")
]
Field = Annotated[str | None, typer.Option("--field", metavar="A.B", help="Field with the reading, in its messages.")]
TimeOf = Annotated[
    Literal["publish", "log"] | None,
    typer.Option("--time", help="Which time of its messages is the reading's; publish where there is one."),
]

Jobs = Annotated[int, typer.Option("--jobs", min=1, metavar="N", help="Processes, where FILE means many files.")]
Scheduler = Annotated[
    str | None,
    typer.Option("--scheduler", metavar="ADDRESS", help="dask cluster in the place of processes: tcp://HOST:8786."),
]


class AddressCommand(TyperCommand):
    """A command whose address options may stand without their value, which then is empty.

    A word that follows one is its value only if it looks like an address: `--live bench.toml` is an option and a file.
    A name without a port is written `--live=NAME`.
    """

    options = ("--live", "--foxglove")
    looks_like_address = re.compile(r"\d+|localhost|(\d+\.){3}\d+|(\[[0-9a-fA-F:.]+\]|[\w.-]*):\w*|\[[0-9a-fA-F:.]+\]")

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put in the empty values, and parse."""
        for at, word in reversed(list(enumerate(args))):
            if word in self.options and not self.looks_like_address.fullmatch("".join(args[at + 1 : at + 2])):
                args = [*args[:at], f"{word}=", *args[at + 1 :]]
        return super().parse_args(ctx, args)


def select(topic: str | None, field: str | None, time: Literal["publish", "log"] | None) -> "Selection":
    """Return which number of another program's file is the reading."""
    from aemd.record.foreign import Selection

    return Selection(topic, field, time)


def show(result: Any, title: str, *, json: bool) -> None:
    """Print a result on stdout, as a table or as JSON."""
    from aemd.report import as_json, as_table

    if json:
        print(as_json(result))
    else:
        Console().print(as_table(result, title))


def report_failures(failed: Sequence[str]) -> None:
    """Tell of the files of an archive that failed, a line each, and end with exit code 1 if there are any."""
    for line in failed:
        stderr().print(f"aemd: {line}", highlight=False, markup=False, soft_wrap=True)
    if failed:
        raise typer.Exit(1)


def _picture(path: Path | None) -> Path | None:
    """Refuse, before anything is done, a picture that could not be drawn after it."""
    if path is not None and path.suffix not in {".png", ".pdf", ".svg"}:
        raise UsageError(f"--plot {path}: must end in .png, .pdf or .svg")
    if path is not None and not path.absolute().parent.is_dir():
        raise UsageError(f"--plot {path}: no such folder: {path.parent}; make it first")
    return path


def draw(recording: str, picture: Path | None, selection: "Selection | None" = None) -> None:
    """Draw a recording if a picture was asked for."""
    if picture is not None:
        from aemd.picture import draw

        draw(Path(recording), picture, selection=selection, console=stderr())
        stderr().print(f"picture={picture}", highlight=False, markup=False)


def stderr() -> Console:
    """Return the console for progress and for what is not the result."""
    return Console(stderr=True)
