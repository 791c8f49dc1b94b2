"""The command that makes a service of it: install-service."""

from pathlib import Path
from typing import Annotated

import typer

from aemd.cli.common import Json, app, show
from aemd.errors import UsageError


@app.command(name="install-service")
def install_service(
    user: Annotated[bool, typer.Option("--user", help="For your own account.")] = False,
    system: Annotated[bool, typer.Option("--system", help="For this machine, as root.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Write nothing: show what would be written.")] = False,
    root: Annotated[
        Path, typer.Option(metavar="DIR", help="With --system: write below DIR, to make a package.")
    ] = Path("/"),
    json: Json = False,
) -> None:
    """Put aemd's systemd unit, and what it needs, in place; say what to run next."""
    from aemd.install import install, plan_system, plan_user

    if user == system:
        raise UsageError("install-service: name one of --user and --system")
    if user and root != Path("/"):
        raise UsageError("--root: only with --system")
    plan = plan_user() if user else plan_system(root)
    result = install(plan, user=user, dry_run=dry_run)
    if dry_run and not json:
        for each in plan:
            if str(each.path) in result.written:
                print(f"# {each.path}\n{each.text}")
    show(result, "Would install" if dry_run else "Installed", json=json)
