"""Seal, run, open: envelopes become files, the critic sees a file and nothing else, and then the key is opened."""

import hashlib
import json
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from aemd.diagnose import diagnose
from aemd.errors import AemdError
from tests.blind.baseline import suspect
from tests.blind.envelope import SINGLE, Envelope, draw_envelope, draw_ladder
from tests.blind.files import write_csv, write_mcap
from tests.blind.injector import make_record
from tests.blind.plant import Record

__all__ = ["Answer", "ask", "run_all", "seal"]


@dataclass(frozen=True)
class Answer:
    """What was said of one file."""

    number: int
    verdict: str
    """Of the critic, or `failed`."""
    findings: tuple[dict[str, Any], ...]
    """Each with cause, names, probability, p_value, d_nats, parameters and gain."""
    seconds: float
    baseline: tuple[str, ...]


def seal(salt: str, runs: int, rungs: int, jobs: int) -> tuple[list[Envelope], str]:
    """Draw `runs` envelopes and `rungs` for each mechanism; return them, shuffled, and the key's hash.

    The hash is to be published before anything is run.
    """
    with pool(jobs) as workers:
        envelopes = list(workers.map(partial(draw_envelope, salt), range(runs), chunksize=4))
        envelopes += workers.map(partial(draw_ladder, salt), range(rungs * len(SINGLE)), chunksize=4)
    np.random.default_rng([*salt.encode()]).shuffle(envelopes)
    envelopes = [replace(envelope, number=number) for number, envelope in enumerate(envelopes)]
    key = json.dumps([asdict(envelope) for envelope in envelopes], sort_keys=True)
    return envelopes, hashlib.sha256(key.encode()).hexdigest()


def run_all(envelopes: list[Envelope], jobs: int) -> Iterator[Answer]:
    """Yield the answers as they come; each run is a process's only state."""
    with pool(jobs) as workers:
        yield from workers.map(ask, envelopes, chunksize=2)


def pool(jobs: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(jobs, mp_context=get_context("spawn"))


def ask(envelope: Envelope) -> Answer:
    """Write the file of one envelope under a name that tells nothing, and ask."""
    record = make_record(envelope.run)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{envelope.number:04d}{envelope.suffix}"
        write(record, path, envelope)
        try:
            diagnosis = diagnose(path)
        except (AemdError, ArithmeticError, ValueError, IndexError) as error:  # a failure is an answer, and a bad one
            return Answer(envelope.number, f"failed: {type(error).__name__}: {error}", (), 0.0, tuple(suspect(record)))
    findings = tuple(plain(asdict(finding)) for finding in diagnosis.findings)
    return Answer(envelope.number, diagnosis.verdict, findings, diagnosis.seconds, tuple(suspect(record)))


def write(record: Record, path: Path, envelope: Envelope) -> None:
    if path.suffix == ".csv":
        write_csv(record, path)
    else:
        write_mcap(record, path, envelope.run.plant.interval_s)


def plain(value: Any) -> Any:
    """Return numbers of numpy as Python's, so that answers travel and print."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value
