"""Commands that look at a running acquisition: its state in one go, and a view for a terminal over ssh."""

from typing import Annotated

import typer

from aemd.cli.common import Json, app, show

Url = Annotated[
    str | None, typer.Argument(metavar="[URL]", help="Address that `aemd acquire --live` printed; found if left out.")
]


@app.command()
def status(url: Url = None, json: Json = False) -> None:
    """Show how a running acquisition fares: rate, losses, file, disk, window, last reading, estimate."""
    from aemd.report import as_json
    from aemd.watch.remote import ask_status, find_url, summarise

    state = ask_status(find_url(url))
    if json:
        print(as_json(state))
    else:
        show(summarise(state), str(state["instrument"]), json=False)


@app.command()
def watch(url: Url = None, json: Json = False) -> None:
    """Watch a running acquisition on a terminal: readings, estimate, health; q or Ctrl-C ends it."""
    from aemd.watch.remote import find_url
    from aemd.watch.terminal import watch

    watch(find_url(url), json=json)
