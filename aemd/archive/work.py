"""What a worker does with one file of an archive, and where workers come from."""

import asyncio
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.connection import wait
from threading import Thread
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np

from aemd.archive.manifest import FORM, Entry
from aemd.archive.places import Place
from aemd.archive.state import Carried, digest, load_state, save_state
from aemd.block import READING
from aemd.config import EstimatorChoice
from aemd.errors import InstrumentError, RecordingError
from aemd.estimate.registry import make_estimator
from aemd.estimate.state import save_state as state_as_text
from aemd.pipeline import Tally, run
from aemd.record.disk import NO_ROOM
from aemd.record.source import Selection, open_readings
from aemd.replay import begin_with, choose, recorded_or_none, recording_to

__all__ = ["NoRoomError", "Task", "is_full", "replay_file", "workers"]

_RETRIES = 2  # of a file whose worker was lost, by the cluster

Given = ParamSpec("Given")
Result = TypeVar("Result")


class NoRoomError(RecordingError):
    """A disk is full: no other file of the archive would fare better."""


@dataclass(frozen=True, slots=True)
class Task:
    """One file of a run: from the state after the file before it, to the state after it."""

    name: str
    source: Place
    out: Place
    model: EstimatorChoice | None
    """In the place of the recorded one."""
    estimator: str | None
    """By name, in the place of either."""
    asked: dict[str, str]
    state: bytes | None
    """Before the first reading; None for the beginning of a run."""
    is_last: bool
    """Whether the run ends here, and what the estimator holds back is due."""
    selection: Selection


def replay_file(task: Task) -> tuple[Entry, bytes | None]:
    """Replay one file; return what is to be noted, and the state after it, None after the last.

    The same task has the same result to the byte wherever and however often it runs, so a lost one is run again.

    Raises:
        NoRoomError: the disk is full.
        RecordingError, ConfigError, UsageError: as `replay` does; there is no result then.
    """
    try:
        return _replay_file(task)
    except RecordingError as error:
        if is_full(error):  # said here, since the cause of an error stays behind in the process of a worker
            raise NoRoomError(str(error)) from error
        raise


def is_full(error: BaseException) -> bool:
    """Tell whether a full disk is at the bottom of an error."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, OSError):
        cause = cause.__cause__
    return cause is not None and cause.errno in NO_ROOM


def _replay_file(task: Task) -> tuple[Entry, bytes | None]:
    stamp = task.source.stamp()
    with task.source.fetched() as path, open_readings(path, task.selection) as recording:
        description = recording.description
        if task.state is not None:
            choice, estimator = load_state(task.state, description.interval_s)
            description = replace(description, state=state_as_text(estimator))  # the result replays alone, to the bit
        else:
            is_replaced = task.model is not None or task.estimator is not None
            recorded = recorded_or_none(description, task.source.url, is_replaced=is_replaced)
            choice = choose(task.model or recorded, task.estimator)
            if not description.interval_s > 0:
                raise RecordingError(f"{task.source.url}: has no interval between readings, which an estimator needs")
            estimator = make_estimator(choice.name, choice.options, description.interval_s)
            if description.state and choice == recorded:
                begin_with(estimator, description, task.source.url)
            else:
                description = replace(description, state={})  # what is estimated anew begins at its first reading
        estimator.push(np.empty(0, READING))
        tally = Tally(description.first_index)
        with task.out.made() as made:
            with recording_to(made, description, choice, "end" if task.is_last else "rotate") as recorder:
                source = recording.batches()
                run(source, estimator if task.is_last else Carried(estimator), [tally, cast("Any", recorder)])
            out_sha256 = Place(str(made)).checksum()
        source_sha256 = Place(str(path)).checksum()
    state = None if task.is_last else save_state(choice, estimator)
    entry = Entry(
        source=task.source.url,
        source_stamp=stamp,
        source_sha256=source_sha256,
        out_stamp=task.out.stamp(),
        out_sha256=out_sha256,
        readings=tally.counts.readings,
        estimates=tally.counts.estimates,
        asked=task.asked,
        before_sha256=digest(task.state),
        state_sha256=digest(state),
        form=FORM,
    )
    return entry, state


@contextmanager
def workers(jobs: int, scheduler: str | None) -> Iterator[Executor]:
    """Give what runs tasks: this process, processes of this machine, or the workers of a dask cluster.

    Who leaves by an exception waits for no task: those that were not begun never are, and processes of ours end.

    Raises:
        RecordingError: the cluster's package is not installed.
        InstrumentError: the scheduler does not answer.
    """
    if scheduler is not None:
        try:
            client_type = import_module("distributed").Client
        except ImportError as error:
            raise RecordingError("--scheduler: needs the package distributed; install aemd[cluster]") from error
        try:
            client = client_type(scheduler, timeout="10s", set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise InstrumentError(
                f"--scheduler {scheduler}: does not answer; start one by `dask scheduler`, and name its address"
            ) from error
        with client:
            yield _Cluster(client)
    elif jobs > 1:
        others = active_children()
        # Not by fork: a thread of ours, or of the compression's, may hold a lock at that moment.
        executor = ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=_follow_parent)
        try:
            yield executor
        except BaseException:
            for process in active_children():
                if process not in others:
                    process.terminate()
            raise
        finally:
            executor.shutdown(cancel_futures=True)
    else:
        yield _Here()


class _Here(Executor):
    """Runs a task at once, in this process."""

    def submit(self, fn: Callable[Given, Result], /, *args: Given.args, **kwargs: Given.kwargs) -> Future[Result]:
        done: Future[Result] = Future()
        try:
            done.set_result(fn(*args, **kwargs))
        except Exception as error:  # noqa: BLE001 - it is raised again where the result is asked for
            done.set_exception(error)
        return done


class _Cluster(Executor):
    """Runs tasks on a dask cluster, until its client is closed.

    Not by the client's own executor: where a worker dies with a result that was not fetched yet, and the task fails
    when it is run again, its future never ends; and at the end it waits for all tasks that were handed out.
    """

    def __init__(self, client: Any) -> None:
        self._client = client

    def submit(self, fn: Callable[Given, Result], /, *args: Given.args, **kwargs: Given.kwargs) -> Future[Result]:
        # Not pure: the same task again is run again, since its result may be gone.
        handed_out = self._client.submit(fn, *args, **kwargs, pure=False, retries=_RETRIES)
        return asyncio.run_coroutine_threadsafe(self._fetch(handed_out), self._client.loop.asyncio_loop)

    async def _fetch(self, handed_out: Any) -> Any:
        return await self._client.gather(handed_out, asynchronous=True)


def _follow_parent() -> None:
    """Make this process end when the one that started it does, however that ends; Ctrl-C is for that one alone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
