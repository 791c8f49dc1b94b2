"""Archives for tests: a session cut into segments, as rotation leaves them, and one long recording of the same."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from aemd.block import ESTIMATE, READING, Batch, Block, Status
from aemd.record.description import Description, write_parameters
from aemd.record.reader import Recording
from aemd.record.writer import Recorder

INTERVAL_S = 0.067


def readings_of(count: int, seed: int = 1) -> Block:
    """Return readings of a slow wave with noise, some without a value, with a gap of 7."""
    rng = np.random.default_rng(seed)
    made = np.zeros(count, READING)
    made["index"] = np.arange(count)
    made["t_ns"] = 10**18 + np.arange(count) * 67_000_000
    made["value_V"] = 5e-3 * np.sin(np.arange(count) / 40) + 1e-3 * rng.standard_normal(count)
    made["status"][count // 3], made["value_V"][count // 3] = Status.INVALID, np.nan
    return np.delete(made, slice(count // 2, count // 2 + 7))


def write(path: Path, readings: Block, *, session: str = "", estimator: str = "", first_index: int = 0) -> Path:
    """Write a recording without estimates that says which estimator is its own."""
    path.parent.mkdir(parents=True, exist_ok=True)
    description = Description(
        interval_s=INTERVAL_S,
        first_index=first_index,
        session={"id": session} if session else {},
        estimator=write_parameters(estimator, {}) if estimator else {},
    )
    recorder = Recorder(path, description)
    recorder.write(Batch(readings), np.empty(0, ESTIMATE))
    return recorder.close("end")


def write_json(path: Path, message: Callable[[float], Any]) -> None:
    """Write what another program would: 300 JSON messages on /lab, 10 a second, each made of a standard normal number.

    Args:
        path: to write.
        message: returns what is written of a number.
    """
    with path.open("wb") as out:
        writer = Writer(out)
        writer.start()
        channel = writer.register_channel("/lab", "json", 0)
        for number, value in enumerate(np.random.default_rng(3).standard_normal(300).tolist()):
            time_ns = 10**18 + number * 10**8
            writer.add_message(channel, time_ns, json.dumps(message(value)).encode(), time_ns)
        writer.finish()


def write_segments(folder: Path, readings: Block, count: int, *, session: str = "s", estimator: str = "") -> list[Path]:
    """Write the readings as that many files of one session."""
    parts = np.array_split(readings, count)
    return [
        write(
            folder / f"{session}-{number:03}.mcap",
            part,
            session=session,
            estimator=estimator,
            first_index=int(parts[number - 1]["index"][-1]) + 1 if number else 0,
        )
        for number, part in enumerate(parts)
    ]


def estimates_in(paths: list[Path]) -> np.ndarray:
    """Return the estimates of these recordings, one after the other."""
    found = [np.empty(0, ESTIMATE)]
    for path in paths:
        with Recording(path) as recording:
            found += [estimates for _, estimates in recording.batches_with_estimates()]
    return np.concatenate(found)
