"""The command line: parse, call, print, exit code; no logic.

Exit codes: 0 done (gaps and losses are results, not failures); 1 the instrument or a recording failed, or `--check`
found damage or a difference; 2 usage; 78 a config or model file is wrong; 130 interrupted before there was a result.
"""

import os
import sys
from contextlib import suppress
from typing import Annotated, NoReturn

import typer
from typer import TyperException

from aemd import __version__
from aemd.cli import bench, daemon, files, installation, meters, models, offline  # their commands register themselves
from aemd.cli.common import app
from aemd.errors import AemdError, UsageError

__all__ = ["app", "bench", "daemon", "files", "installation", "main", "meters", "models", "offline"]


_INTERRUPTED = 130  # as a shell says it: 128, and the number of SIGINT


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
        if code == _INTERRUPTED:  # typer's own word for it, without a line
            _fail("interrupted", _INTERRUPTED)
    except AemdError as error:
        _fail(str(error), error.exit_code)
    except TyperException as error:
        context = getattr(error, "ctx", None)
        command = context.command_path if context is not None else "aemd"
        _fail(f"{error.format_message().rstrip('.')}; see {command} --help", UsageError.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        _fail("interrupted", _INTERRUPTED)
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
