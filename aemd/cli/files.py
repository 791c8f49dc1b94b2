"""Commands on files: recover what a crash has left, check, compact."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from aemd.cli.common import Json, app, show, stderr

Compression = Literal["zstd", "none"]


@app.command()
def recover(
    file: Annotated[Path, typer.Argument(metavar="FILE.mcap.active", help="What a crash or a power cut has left.")],
    json: Json = False,
) -> None:
    """Finish an unfinished or damaged recording in place, and say what was lost; it becomes FILE.mcap."""
    from aemd.record.recovery import recover as finish

    show(finish(file), "Recovered", json=json)


@app.command()
def check(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings.")],
    json: Json = False,
) -> None:
    """Say whether recordings are whole: checksums, indexes, continuity; exit code 1 if one is not."""
    from aemd.display import counting
    from aemd.errors import RecordingError
    from aemd.record.check import CheckResult
    from aemd.record.check import check as inspect
    from aemd.report import as_json

    results = []
    for file in files:
        try:
            with counting("MiB", stderr()) as bar:
                result = inspect(file, progress=bar)
        except RecordingError as error:  # the others are checked all the same
            finding = str(error).removeprefix(f"{file}: ")
            result = CheckResult(str(file), False, (finding,), (), chunks=0, readings=0, estimates=0, lost=0, gaps=0)
        results.append(result)
        if not json:
            for finding in result.findings:
                print(f"{file}: {finding}")
            for note in result.notes:
                print(f"{file}: note: {note}")
            if result.whole:
                print(f"{file}: whole: {result.readings} readings, {result.estimates} estimates, {result.lost} lost")
    if json:
        print(as_json(results))
    if not all(result.whole for result in results):
        raise typer.Exit(1)


@app.command()
def compact(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="OUT", help="The new recording.")],
    compression: Annotated[Compression, typer.Option(help="Of the chunks.")] = "zstd",
    json: Json = False,
) -> None:
    """Write a recording again with its small live chunks put together: smaller, faster to read, the same messages."""
    from aemd.record.compact import compact as put_together

    show(put_together(file, out, compression=compression), "Compacted", json=json)
