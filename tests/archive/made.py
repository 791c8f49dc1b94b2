"""Archives for tests: a session cut into segments, as rotation leaves them, and one long recording of the same."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from aemd.block import ESTIMATE, READING, Batch, Block, Status
from aemd.config import EstimatorChoice, name_estimator
from aemd.estimate.registry import make_estimator
from aemd.estimate.state import copy_state, write_state
from aemd.record.description import Description, Scalar, write_parameters
from aemd.record.reader import Recording
from aemd.record.rollover import Rollover, Segment
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


def write(
    path: Path, readings: Block, *, session: str = "", estimator: str = "", first_index: int = 0, **options: Scalar
) -> Path:
    """Write a recording without estimates that says which estimator is its own, with which options."""
    path.parent.mkdir(parents=True, exist_ok=True)
    description = Description(
        interval_s=INTERVAL_S,
        first_index=first_index,
        session={"id": session} if session else {},
        estimator=write_parameters(estimator, options) if estimator else {},
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


def acquire(folder: Path, readings: Block, estimator: str | EstimatorChoice = "aem") -> list[Path]:
    """Record readings with their estimates as an acquisition does that rotates every 20 s, about 300 readings."""
    folder.mkdir(parents=True, exist_ok=True)
    choice = name_estimator(estimator) if isinstance(estimator, str) else estimator
    running = make_estimator(choice.name, choice.options, INTERVAL_S)
    paths: list[Path] = []

    def open_file(segment: Segment) -> Recorder:
        paths.append(folder / f"{len(paths):03}.mcap")
        description = Description(
            interval_s=INTERVAL_S,
            session={"id": "acquired"},
            estimator=choice.as_text(),
            first_index=segment.first_index,
            segment=segment.as_text(),
            state=write_state(segment.state),
        )
        return Recorder(paths[-1], description)

    rollover = Rollover(open_file, rotate_s=20.0)
    for at in range(0, len(readings), 10):
        block = readings[at : at + 10]
        rollover.write(Batch(block), running.push(block))
        rollover._join()  # the file before is finished by a thread; a rotation does not wait for it
        rollover.take_state(copy_state(running))
    rollover.write(Batch(readings[:0]), running.flush())
    rollover.close("stop")
    return paths


def estimates_in(paths: list[Path]) -> np.ndarray:
    """Return the estimates of these recordings, one after the other."""
    found = [np.empty(0, ESTIMATE)]
    for path in paths:
        with Recording(path) as recording:
            found += [estimates for _, estimates in recording.batches_with_estimates()]
    return np.concatenate(found)
