"""Commands at the bench: acquire, serve the simulated meter, check a config."""

from contextlib import ExitStack
from pathlib import Path
from queue import SimpleQueue
from typing import Annotated

import typer

from aemd.cli.common import AddressCommand, EstimatorName, Json, Model, Plot, app, draw, show, stderr


@app.command(cls=AddressCommand)
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
    live: Annotated[
        str | None, typer.Option(metavar="[HOST:PORT]", help="Serve a live page; 127.0.0.1:8410 unless told.")
    ] = None,
    foxglove: Annotated[
        str | None, typer.Option(metavar="[HOST:PORT]", help="Serve the topics to Foxglove; 127.0.0.1:8765.")
    ] = None,
    json: Json = False,
) -> None:
    """Acquire from a meter into a recording, estimating online, until --seconds are over or Ctrl-C."""
    from aemd import session
    from aemd.config import load_config, load_estimator, name_estimator
    from aemd.live.view import open_views

    settings = load_config(config)
    if resource is not None:
        settings = settings.with_resource(resource)
    if model is not None:
        settings = settings.with_estimator(load_estimator(model))
    if estimator is not None:
        settings = settings.with_estimator(name_estimator(estimator, settings.estimator))
    with open_views(live, settings.live, foxglove) as views:
        result = session.acquire(settings, seconds=seconds, directory=out, console=stderr(), views=views)
    show(result, "Acquired", json=json)
    draw(result.file, plot)


@app.command()
def sim(
    config: Annotated[
        Path | None, typer.Argument(metavar="[CONFIG]", help="Config file whose [simulator] is served.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0 takes a free one.")] = 5025,
    vxi11_port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port of VXI-11; 0 takes a free one.")] = 0,
    serial: Annotated[bool, typer.Option("--serial", help="Serve a serial line, too: a pseudo-terminal.")] = False,
    faults: Annotated[
        Path | None, typer.Option(metavar="FILE.toml", help="What goes wrong and when: [[faults]] tables.")
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    json: Json = False,
) -> None:
    """Serve the simulated meter to anyone's client, until Ctrl-C; prints a VISA resource for each of its links."""
    from aemd.acquire.instrument import find_simulator
    from aemd.config import load_config, load_simulator
    from aemd.report import as_json
    from aemd.service import stopping_on_signals

    settings = load_config(config).with_resource("sim")
    if faults is not None:
        settings = load_simulator(faults, settings)
    simulator = find_simulator(settings.driver)
    stop: SimpleQueue[None] = SimpleQueue()  # its put is reentrant, as a signal handler's must be
    with stopping_on_signals(lambda: stop.put(None)), ExitStack() as stack:
        # Several links are more than a simulator owes: somebody's own may have `serve` alone.
        if serve_links := getattr(simulator, "serve_links", None):
            links = serve_links(settings.simulator, host, port=port, vxi11_port=vxi11_port, serial=serial)
            resources = dict(stack.enter_context(links))
        else:
            resources = {"socket": stack.enter_context(simulator.serve(settings.simulator, host, port))}
        first = next(iter(resources.values()))
        print(
            as_json({"resource": first, "resources": resources}) if json else "\n".join(resources.values()), flush=True
        )
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
