"""An archive on a real dask cluster of two workers: the bytes that one process makes, also when a worker is killed."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from aemd.archive import replay_archive
from tests.archive.made import readings_of, write, write_segments

distributed = pytest.importorskip("distributed", reason="no dask cluster: install aemd[cluster]")

pytestmark = [
    pytest.mark.slow,
    # The cluster's own machinery, when a worker goes away under it.
    pytest.mark.filterwarnings("ignore"),
]


@pytest.fixture
def cluster() -> Iterator["distributed.LocalCluster"]:
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as running:
        yield running


def _archive_of_64(folder: Path) -> None:
    for number in range(12):
        write_segments(folder / f"day{number:02}", readings_of(3000, number), 5, session=f"s{number}")
    for number in range(4):
        write(folder / f"alone{number}.mcap", readings_of(3000, 100 + number))


def _bytes_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.mcap")}


def test_64_files_on_two_workers_are_the_bytes_of_one_process(
    cluster: "distributed.LocalCluster", tmp_path: Path
) -> None:
    _archive_of_64(tmp_path / "in")

    one = replay_archive(str(tmp_path / "in"), str(tmp_path / "one"))
    two = replay_archive(str(tmp_path / "in"), str(tmp_path / "two"), scheduler=cluster.scheduler_address)

    assert (one.files, one.runs, one.failed) == (64, 16, ())
    assert (two.replayed, two.failed) == (64, ())
    assert _bytes_of(tmp_path / "two") == _bytes_of(tmp_path / "one")


class _Killer(distributed.SchedulerPlugin):
    """Kills the worker that has the 32nd result at the moment at which the scheduler hears of it.

    Nobody has fetched that result: it is lost, and its file is in its place.
    """

    def __init__(self, cluster: "distributed.LocalCluster") -> None:
        self._cluster = cluster
        self._results = 0
        self.has_killed = False

    def transition(self, key: str, start: str, finish: str, *_: object, **__: object) -> None:
        self._results += finish == "memory"
        if self._results == 32 and not self.has_killed:
            (holder,) = self._cluster.scheduler.tasks[key].who_has
            (victim,) = (
                nanny.pid for nanny in self._cluster.workers.values() if nanny.worker_address == holder.address
            )
            os.kill(victim, signal.SIGKILL)
            self.has_killed = True


def test_a_worker_killed_half_way_costs_nothing(cluster: "distributed.LocalCluster", tmp_path: Path) -> None:
    _archive_of_64(tmp_path / "in")
    one = replay_archive(str(tmp_path / "in"), str(tmp_path / "one"))
    killer = _Killer(cluster)
    cluster.scheduler.add_plugin(killer)

    two = replay_archive(str(tmp_path / "in"), str(tmp_path / "two"), scheduler=cluster.scheduler_address)

    assert killer.has_killed
    assert (one.replayed, two.replayed, two.failed) == (64, 64, ())
    assert _bytes_of(tmp_path / "two") == _bytes_of(tmp_path / "one")
    assert not list((tmp_path / "two").rglob(".aemd-scratch"))
