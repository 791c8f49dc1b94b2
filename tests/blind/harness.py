"""Seal, run, open: envelopes become files, the critic sees a file and nothing else, and then the key is opened.

A run is kept in a folder: key.json, whose hash is published before anything is run, and answers.jsonl, to which each
answer is appended as it comes. What was interrupted, by whatever means, goes on from there.
"""

import hashlib
import json
import os
import signal
import tempfile
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from multiprocessing import get_context, parent_process
from pathlib import Path
from threading import Thread
from time import monotonic, process_time
from typing import Any

import numpy as np

from aemd.diagnose import diagnose
from aemd.errors import AemdError
from tests.blind.baseline import suspect
from tests.blind.envelope import Envelope, Mix, draw
from tests.blind.files import write_csv, write_mcap
from tests.blind.injector import make_record
from tests.blind.oracle import oracle_gain
from tests.blind.plant import Effect, Plant, Record, Run
from tests.blind.rivals import rival_nats

__all__ = ["Answer", "Sealed", "ask", "open_folder", "run_all", "seal", "shut"]

KEY, ANSWERS = "key.json", "answers.jsonl"
AHEAD = 4
"""Envelopes that wait for each worker."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Answer:
    """What was said of one file, and what else is known of it when its readings are at hand."""

    number: int
    verdict: str
    """Of the critic, or `failed`."""
    findings: tuple[dict[str, Any], ...]
    """Each with cause, names, probability, p_value, d_nats, parameters and gain."""
    seconds: float
    """Of the processor, for the diagnosis alone."""
    baseline: tuple[str, ...]
    rival: tuple[float, str] | None = None
    """Nats by which the truth is told from what is most like it, and its name; see rivals.py."""
    oracle_nats: float | None = None
    """What knowing the truth is worth on held-out blocks of these readings; see oracle.py. In `gain` envelopes only."""


@dataclass(frozen=True)
class Sealed:
    """A key on disk."""

    folder: Path
    salt: str
    key_hash: str
    envelopes: list[Envelope]
    answers: dict[int, Answer]
    """Those that there are already, by number."""


def seal(salt: str, mix: Mix, jobs: int, folder: Path) -> Sealed:
    """Draw the envelopes of a mix, shuffle them, write the key and return it with its hash.

    Raises:
        FileExistsError: the folder has a key already; its run is resumed, or the folder is another one.
    """
    with pool(jobs) as workers:
        drawn = list(workers.map(partial(draw, salt), mix.tickets(), chunksize=4))
    return shut(salt, mix, drawn, folder)


def shut(salt: str, mix: Mix, drawn: list[Envelope], folder: Path) -> Sealed:
    """Shuffle envelopes, write their key and return it."""
    folder.mkdir(parents=True, exist_ok=True)
    np.random.default_rng([*salt.encode()]).shuffle(drawn)  # type: ignore[arg-type] # a list is shuffled in place
    envelopes = [replace(envelope, number=number) for number, envelope in enumerate(drawn)]
    key = json.dumps({"salt": salt, "mix": asdict(mix), "envelopes": [asdict(envelope) for envelope in envelopes]})
    with (folder / KEY).open("x") as file:
        file.write(key)
    return Sealed(folder, salt, hashlib.sha256(key.encode()).hexdigest(), envelopes, {})


def open_folder(folder: Path) -> Sealed:
    """Return a key that was sealed before, with the answers that it has."""
    text = (folder / KEY).read_text()
    key = json.loads(text)
    envelopes = []
    for entry in key["envelopes"]:
        effects = tuple(Effect(**effect) for effect in entry["run"]["effects"])
        run = Run(Plant(**entry["run"]["plant"]), entry["run"]["seed"], effects)
        envelopes.append(Envelope(**entry | {"run": run, "d_nats": tuple(entry["d_nats"])}))
    answers = {}
    for line in (folder / ANSWERS).read_text().splitlines() if (folder / ANSWERS).exists() else []:
        try:
            answer = Answer(**json.loads(line))
        except ValueError:  # torn by what ended the run
            continue
        answers[answer.number] = answer
    return Sealed(folder, key["salt"], hashlib.sha256(text.encode()).hexdigest(), envelopes, answers)


def run_all(sealed: Sealed, jobs: int, seconds: float) -> Iterator[tuple[Envelope, Answer]]:
    """Ask of every envelope without an answer, for so long at most; append and yield the answers as they come.

    Each run's file is all that it is asked by; workers keep nothing from one to the next.
    """
    begun = monotonic()
    left = iter([envelope for envelope in sealed.envelopes if envelope.number not in sealed.answers])
    with pool(jobs) as workers, (sealed.folder / ANSWERS).open("a") as file:
        print(file=file)  # ends a line that was torn
        try:
            asked: dict[Future[Answer], Envelope] = {}
            while monotonic() - begun < seconds:
                for envelope in islice(left, AHEAD * jobs - len(asked)):
                    asked[workers.submit(ask, envelope)] = envelope
                if not asked:
                    return
                done, _ = wait(asked, timeout=5.0, return_when=FIRST_COMPLETED)
                for future in done:
                    answer = future.result()
                    print(json.dumps(asdict(answer)), file=file, flush=True)
                    yield asked.pop(future), answer
        except BrokenProcessPool:  # out of memory, or ended by someone; what there is stays
            return
        finally:
            workers.shutdown(wait=False, cancel_futures=True)


def pool(jobs: int) -> ProcessPoolExecutor:
    """Return workers of one thread each, which leave it to their parent to be interrupted."""
    for name in THREADS:
        os.environ[name] = "1"  # before a worker imports what reads it
    return ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=begin_work)


def begin_work() -> None:
    """Make this process a worker that is not interrupted, and that ends when its parent does, however that ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def ask(envelope: Envelope) -> Answer:
    """Write the file of one envelope under a name that tells nothing, and ask."""
    record = make_record(envelope.run)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{envelope.number:04d}{envelope.suffix}"
        write(record, path, envelope)
        begun = process_time()
        try:
            diagnosis = diagnose(path)
        except (AemdError, ArithmeticError, ValueError, IndexError) as error:  # a failure is an answer, and a bad one
            verdict, findings = f"failed: {type(error).__name__}: {error}", ()
        else:
            verdict, findings = diagnosis.verdict, tuple(plain(asdict(finding)) for finding in diagnosis.findings)
        seconds = process_time() - begun
    alone = envelope.run.effects[0] if len(envelope.run.effects) == 1 else None
    known = alone is not None and envelope.group in ("ladder", "single", "gain")
    return Answer(
        envelope.number,
        verdict,
        findings,
        seconds,
        tuple(suspect(record)),
        rival_nats(envelope.run, alone) if known and alone else None,
        oracle_gain(envelope.run, alone, record) if alone and envelope.group == "gain" else None,
    )


def write(record: Record, path: Path, envelope: Envelope) -> None:
    if path.suffix == ".csv":
        write_csv(record, path)
    else:
        write_mcap(record, path, envelope.run.plant.interval_s, envelope.run.plant.aperture_s)


def plain(value: Any) -> Any:
    """Return numbers of numpy as Python's, so that answers travel and print."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value
