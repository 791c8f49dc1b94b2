"""What a crash has left behind, when the next acquisition is told to stop: its own file comes first."""

from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from aemd.block import Batch
from aemd.files import recovering
from aemd.record.writer import Recorder
from tests.record.made import DESCRIPTION, estimates_of, readings_of


def leave_behind(path: Path) -> None:
    """Write a recording that is never finished."""
    recorder = Recorder(path, DESCRIPTION, chunk_bytes=1000)
    readings = readings_of(100)
    recorder.write(Batch(readings), estimates_of(readings))
    recorder._file.release()


@pytest.mark.parametrize(("is_told_to_stop", "left"), [(False, 0), (True, 2)])
def test_who_is_told_to_stop_leaves_the_rest_for_the_next_time(
    is_told_to_stop: bool, left: int, tmp_path: Path
) -> None:
    for number in range(3):
        leave_behind(tmp_path / f"r{number}.mcap")

    with recovering(tmp_path, Console(file=StringIO()), lambda: is_told_to_stop):
        pass

    assert len(list(tmp_path.glob("*.active"))) == left
    assert len(list(tmp_path.glob("*.mcap"))) == 3 - left
