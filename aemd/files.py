"""The files of an acquisition: made and described one after the other, and those of earlier ones finished."""

import platform
import socket
import threading
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from rich.console import Console

from aemd import __version__
from aemd.acquire.instrument import Instrument
from aemd.config import Config
from aemd.errors import RecordingError
from aemd.estimate.state import write_state
from aemd.record.description import Description
from aemd.record.recovery import recover_folder
from aemd.record.rollover import Rollover, Segment
from aemd.record.writer import Recorder

__all__ = ["open_files", "recovering"]

LAST_RECOVERY_S = 10.0
"""For what is under way when a stop is asked for; one that is cut short can be repeated."""


def open_files(config: Config, instrument: Instrument, folder: Path, console: Console) -> Rollover:
    """Create the first recording in the folder, and describe it and those that follow it."""
    now = datetime.now(UTC)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        raise RecordingError(f"{folder}: cannot be made: {why}; choose another folder") from error
    description = Description(
        interval_s=instrument.interval_s,
        session={
            "id": str(uuid.uuid4()),
            "start": now.isoformat(),
            "host": socket.gethostname(),
            "aemd": __version__,
            "python": platform.python_version(),
            **{name: version(name) for name in ("numpy", "numba", "pyvisa", "pyvisa-py", "mcap")},
        },
        instrument={**instrument.identity, **instrument.settings},
        calibration={key: str(value) for key, value in asdict(config.scale).items()},
        estimator=config.estimator.as_text(),
        config_toml=config.text,
    )
    options = config.recording

    def open_file(segment: Segment) -> Recorder:
        """Create a recording, named by the second at which it begins."""
        return Recorder(
            _free_name(folder, datetime.now(UTC)),
            replace(
                description,
                first_index=segment.first_index,
                segment=segment.as_text(),
                state=write_state(segment.state),
            ),
            flush_interval_s=options.flush_interval_s,
            chunk_bytes=options.chunk_bytes,
            compression=options.compression,
            durability=options.durability,
            keep_room=True,
        )

    return Rollover(
        open_file,
        rotate_bytes=options.rotate_bytes,
        rotate_s=options.rotate_s,
        min_free_bytes=options.min_free_bytes,
        tell=lambda line: console.print(line, highlight=False, markup=False, soft_wrap=True),
    )


@contextmanager
def recovering(folder: Path, console: Console, is_stopping: Callable[[], bool]) -> Iterator[None]:
    """Finish, meanwhile, what earlier acquisitions left unfinished in the folder; a line is shown about each.

    Who is told to stop leaves the rest for the next time: a service that takes too long over it would be killed.
    """

    def work() -> None:
        for line in recover_folder(folder):
            console.print(line, highlight=False, markup=False, soft_wrap=True)
            if is_stopping():
                return

    thread = threading.Thread(target=work, name="aemd-recover", daemon=True)
    thread.start()
    try:
        yield
    finally:
        thread.join(LAST_RECOVERY_S if is_stopping() else None)


def _free_name(folder: Path, now: datetime) -> Path:
    """Return the recording's path: its UTC second, and a number where a second has several."""
    stem = now.strftime("aemd-%Y%m%dT%H%M%SZ")
    names = (folder / f"{stem}{suffix}.mcap" for suffix in ("", *(f"-{number}" for number in range(2, 1000))))
    return next(path for path in names if not path.exists() and not path.with_name(path.name + ".active").exists())
