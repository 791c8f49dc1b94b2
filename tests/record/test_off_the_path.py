"""Waiting for the disk is the writer's business: never that of the thread that estimates, or of that which acquires."""

import os
import threading
from pathlib import Path

import pytest
from rich.console import Console

from aemd.block import Batch, Estimates
from aemd.config import load_config
from aemd.record.check import check
from aemd.session import acquire

CONFIG = """
[instrument]
resource = "sim"
range_V = 10.0
aperture_s = 100e-6
autozero = "off"
trigger_delay_s = 0.0
interval_s = 0.0001
[recording]
flush_interval_s = 0.2
rotate_bytes = 500000
min_free_bytes = 0
[simulator]
seed = 1
"""


class _Streaming:
    """A watcher that knows whether readings are coming."""

    def __init__(self) -> None:
        self.is_on = False

    def write(self, batch: Batch, estimates: Estimates) -> None:
        self.is_on = len(estimates) > 0


def test_at_10000_readings_a_second_and_through_rotations_only_the_writers_threads_wait_for_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "c.toml"
    path.write_text(CONFIG)
    streaming, waited = _Streaming(), set[str]()
    sync = os.fdatasync

    def fdatasync(fd: int) -> None:
        if streaming.is_on:
            waited.add(threading.current_thread().name)
        sync(fd)

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    monkeypatch.setattr(os, "fsync", fdatasync)
    config = load_config(path)

    found = acquire(
        config, seconds=3, directory=tmp_path, console=Console(stderr=True, quiet=True), watchers=[streaming]
    )

    paths = list(tmp_path.glob("*.mcap"))
    assert waited == {"aemd-rollover", "aemd-finish"}
    assert len(paths) > 1
    assert all(check(path).whole for path in paths)
    assert sum(check(path).readings for path in paths) == found.readings == 30_000
