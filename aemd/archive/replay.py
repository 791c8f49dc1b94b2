"""An archive replayed: each file a task, each run of files one long replay, an unfinished archive gone on with.

Within a run the files follow each other, since an estimator's memory has no end: each task gets the state after the
file before it, some kilobytes, and so gives the bits that one replay of all of them would give. Runs are independent
and go in parallel. States are kept beside the results, so that what is added to a run later begins where it ended.
"""

import time
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from aemd.archive.manifest import Entry, Manifest
from aemd.archive.places import Found, Place, find
from aemd.archive.runs import find_runs
from aemd.archive.state import digest
from aemd.archive.work import NoRoomError, Task, is_full, replay_file, workers
from aemd.config import load_estimator, name_estimator
from aemd.display import counting
from aemd.errors import AemdError, RecordingError
from aemd.record.source import Selection

__all__ = ["ArchiveSummary", "replay_archive"]

_STATES = "states"
_MOST_RUNS = 4096  # under way at a time: more than a cluster has workers
_SAVE_EVERY_S = 5.0  # the manifest: what a kill of this process may cost


@dataclass(frozen=True, slots=True)
class ArchiveSummary:
    """What a replay of an archive did."""

    archive: str
    out: str
    files: int
    runs: int
    """Files that follow each other are one."""
    replayed: int
    unchanged: int
    """Files whose result was there."""
    readings: int
    """In the files that were replayed."""
    readings_per_s: float
    failed: tuple[str, ...]
    """One line for each file that could not be replayed."""


def replay_archive(
    pattern: str,
    out: str,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    estimator: str | None = None,
    model: Path | None = None,
    selection: Selection | None = None,
    console: Console | None = None,
) -> ArchiveSummary:
    """Replay all files of an archive into a folder, each under its name; those that are there and unchanged are left.

    Args:
        pattern: which files, such as `DIR/**/*.mcap`; a folder; or either with a scheme that fsspec knows.
        out: the folder of the results, of `manifest.json` and of `states`.
        jobs: processes on this machine.
        scheduler: address of a dask cluster, in the place of processes; its workers must reach all files.
        estimator: by name; None for the model's, or for each run's recorded one.
        model: a file with an estimator and its options.
        selection: which number is the reading, in files of another program.
        console: where progress is shown; None for nowhere.

    Raises:
        UsageError: no such file, estimator or scheme.
        ConfigError: the model file is wrong.
        RecordingError: the folder of the results cannot be written, or is full, or its manifest is none.
        InstrumentError: the scheduler does not answer.
    """
    begun = time.monotonic()
    if "://" not in out:
        try:
            Path(out).mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise RecordingError(f"{out}: is a file: name a folder by --out") from error
        except OSError as error:
            raise RecordingError(f"{out}: cannot be made: {(error.strerror or str(error)).lower()}") from error
    folder = Place(out)
    choice = None if model is None else load_estimator(model)
    if estimator is not None:
        name_estimator(estimator, choice)
    asked = {} if choice is None else choice.as_text()
    if estimator is not None:
        asked["asked"] = estimator
    selection = selection or Selection()
    asked |= {f"selected {name}": text for name, text in asdict(selection).items() if text is not None}
    files = find(pattern, besides=folder)
    runs = find_runs(files)
    manifest = Manifest.load(folder)
    manifest.begin(found.name for found in files)
    make = _Maker(folder, choice, estimator, asked, selection)
    try:
        with counting("files", console) as bar, workers(jobs, scheduler) as executor:
            most = 1 if jobs == 1 and scheduler is None else _MOST_RUNS
            done = _Loop(executor, manifest, make, bar, len(files)).go(runs, most)
    except BaseException:  # who interrupts it finds at the next run what was made until now
        folder.tidy()  # first: what is half made may be what fills the disk
        with suppress(RecordingError):
            manifest.save()
        folder.tidy()
        raise
    manifest.end()
    folder.tidy()
    return ArchiveSummary(
        archive=pattern,
        out=out,
        files=len(files),
        runs=len(runs),
        replayed=done.replayed,
        unchanged=done.unchanged,
        readings=done.readings,
        readings_per_s=done.readings / max(time.monotonic() - begun, 1e-9),
        failed=tuple(sorted(done.failed)),
    )


@dataclass(frozen=True, slots=True)
class _Maker:
    """What all tasks have in common."""

    folder: Place
    model: Any
    estimator: str | None
    asked: dict[str, str]
    selection: Selection

    def task(self, found: Found, state: bytes | None, *, is_last: bool) -> Task:
        return Task(
            name=found.name,
            source=found.place,
            out=self.folder / found.name,
            model=self.model,
            estimator=self.estimator,
            asked=self.asked,
            state=state,
            is_last=is_last,
            selection=self.selection,
        )

    def state_of(self, name: str) -> Place:
        return self.folder / _STATES / f"{name}.state"


@dataclass(slots=True)
class _Done:
    replayed: int = 0
    unchanged: int = 0
    readings: int = 0
    failed: list[str] = field(default_factory=list)


class _Loop:
    """Keeps the workers busy: a file is handed out when the one before it in its run is done."""

    def __init__(self, executor: Executor, manifest: Manifest, make: _Maker, bar: Any, total: int) -> None:
        self._executor = executor
        self._manifest = manifest
        self._make = make
        self._bar = bar
        self._total = total
        self._done = _Done()
        self._saved_s = time.monotonic()
        self._under_way: dict[Future[tuple[Entry, bytes | None]], tuple[Task, list[Found]]] = {}
        self._full: AemdError | None = None
        self._late: list[tuple[Task, Entry, bytes]] = []  # made, and its state found no room

    def go(self, runs: Sequence[Sequence[Found]], most: int) -> _Done:
        """Replay all runs, so many at a time: what is done is noted before another one begins.

        Raises:
            NoRoomError: the disk is full; what was under way has ended, and what is whole is noted.
        """
        for run in runs:
            self._advance(list(run), None)
            while len(self._under_way) >= most:
                self._go_on()
        while self._under_way:
            self._go_on()
        if self._full is not None:
            self._make.folder.tidy()  # what is half made may be what fills the disk
            for task, entry, state in self._late:
                self._note(task, entry, state)
            raise NoRoomError(
                f"{self._make.folder.url}: no space left; {self._done.replayed + self._done.unchanged} of "
                f"{self._total} files are there and whole; make room, and run it again: it goes on from there"
            ) from self._full
        return self._done

    def _go_on(self) -> None:
        """Wait for a file, and hand out the one behind it."""
        ended, _ = wait(self._under_way, return_when=FIRST_COMPLETED)
        for future in ended:
            task, rest = self._under_way.pop(future)
            self._advance(rest, self._take(future, task))

    def _advance(self, rest: list[Found], state: bytes | None) -> None:
        """Pass over the files whose results are there, and hand out the first one that is not."""
        while rest and self._full is None:
            found, rest = rest[0], rest[1:]
            task = self._make.task(found, state, is_last=not rest)
            entry = self._manifest.entries.get(found.name)
            if self._manifest.holds(found.name, task.out, task.source, task.asked, digest(state)) and entry is not None:
                after = self._kept_state(found.name, entry)
                if (after is None) == task.is_last:
                    self._done.unchanged += 1
                    self._show()
                    state = after
                    continue
            if not self._manifest.made(found.name, task.out):
                self._done.failed.append(f"{task.out.url}: exists, and is no result of this archive; move it away")
                self._show()
                continue
            try:
                future = self._executor.submit(replay_file, task)
            except BrokenExecutor:
                self._done.failed.append(f"{task.source.url}: not begun: the workers have died; run it again")
                self._show()
                continue
            self._under_way[future] = (task, rest)
            return

    def _take(self, future: "Future[tuple[Entry, bytes | None]]", task: Task) -> bytes | None:
        """Note what became of a file; return the state that the next one begins with."""
        state = task.state
        try:
            entry, state = future.result()
            self._note(task, entry, state)
        except AemdError as error:
            if isinstance(error, NoRoomError) or is_full(error):
                self._full = error
                if future.exception() is None and state is not None:
                    self._late.append((task, entry, state))
            else:
                self._done.failed.append(str(error))
        except BrokenExecutor:
            self._done.failed.append(f"{task.source.url}: its worker died, of memory perhaps; run it again")
        except Exception as error:  # noqa: BLE001 - a fault of one file, ours included, must not cost the others
            self._done.failed.append(f"{task.source.url}: {type(error).__name__}: {' '.join(str(error).split())}")
        self._show()
        if time.monotonic() - self._saved_s > _SAVE_EVERY_S:
            self._manifest.save()
            self._saved_s = time.monotonic()
        return state

    def _note(self, task: Task, entry: Entry, state: bytes | None) -> None:
        if state is not None:
            self._make.state_of(task.name).write_bytes(state)
        self._manifest.entries[task.name] = entry
        self._done.replayed += 1
        self._done.readings += entry.readings

    def _kept_state(self, name: str, entry: Entry) -> bytes | None:
        """Return the state after a file as it was kept; None where it is gone or not the one of the manifest."""
        place = self._make.state_of(name)
        if not entry.state_sha256 or not place.stamp():
            return None
        state = place.head(-1)
        return state if digest(state) == entry.state_sha256 else None

    def _show(self) -> None:
        done = self._done
        self._bar(done.replayed + done.unchanged + len(done.failed), self._total)
