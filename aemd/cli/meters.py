"""Commands on meters that are there: devices, doctor."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from aemd.cli.common import Json, app, stderr
from aemd.errors import UsageError


@app.command()
def devices(
    timeout: Annotated[float, typer.Option(min=0.1, max=600.0, help="Longest search, s.")] = 5.0,
    host: Annotated[list[str] | None, typer.Option(metavar="HOST[:PORT]", help="Ask there, too; repeatable.")] = None,
    json: Json = False,
) -> None:
    """List what can be reached: USB, serial ports, instruments on the LAN."""
    from aemd.acquire.devices import list_devices
    from aemd.report import as_json

    found = list_devices(timeout, tuple(host or ()))
    if json:
        print(as_json({"devices": found}))
        return
    table = Table(title=f"{len(found)} found")
    for heading in ("resource", "link", "what", "hint"):
        # A resource is there to be copied: on one line, whatever becomes of the others, and never cut short.
        table.add_column(heading, overflow="fold", no_wrap=heading == "resource")
    for device in found:
        _add(table, device.resource, device.link, device.found, device.hint)
    Console().print(table)


@app.command()
def doctor(
    config: Annotated[
        Path | None, typer.Argument(metavar="[CONFIG]", help="Config file; without one, the simulated meter.")
    ] = None,
    resource: Annotated[str | None, typer.Option(help='VISA resource of the meter, or "sim".')] = None,
    characterise: Annotated[
        bool, typer.Option("--characterise", help="Ask the meter what no manual says; ends what it is doing.")
    ] = False,
    out: Annotated[Path | None, typer.Option("-o", "--out", metavar="FILE", help="Report of --characterise.")] = None,
    json: Json = False,
) -> None:
    """Check link, identity, error queue, timing, line frequency and permissions, and say what to do."""
    from aemd import doctor as examiner
    from aemd.config import load_config
    from aemd.report import as_json

    if characterise != (out is not None):
        raise UsageError("doctor: --characterise and --out FILE go together")
    settings = load_config(config)
    if resource is not None:
        settings = settings.with_resource(resource)
    if out is not None:
        with stderr().status("asking the meter; this takes about a minute"):
            answers = examiner.characterise(settings, out)
        print(as_json(answers) if json else "\n".join(f"{key}: {value}" for key, value in answers.items()))
        stderr().print(f"report={out}", highlight=False, markup=False)
        return
    with stderr().status("measuring"):
        found = examiner.examine(settings)
    if json:
        print(as_json(found))
    else:
        table = Table(title=Text(found.resource, style="table.title"))
        for heading in ("", "check", "found", "what to do"):
            table.add_column(heading, overflow="fold")
        for check in found.checks:
            _add(table, "ok" if check.ok else "NO", check.name, check.found, check.advice)
        Console().print(table)
    if not found.ok:
        raise typer.Exit(1)


def _add(table: Table, *cells: str) -> None:
    """Add a row as it is: an instrument's answer and a user's word may look like rich's marks, `[/red]` or `:on:`."""
    table.add_row(*map(Text, cells))
