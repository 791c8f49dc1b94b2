"""A recording that is still being written opens, at any moment, as what its writer has flushed."""

import threading
from pathlib import Path

import numpy as np
import pytest

import aemd
from aemd.block import ESTIMATE, Batch
from aemd.record.description import Description
from aemd.record.writer import Recorder
from tests.record.made import readings_of

BLOCK = 50
BLOCKS = 400


@pytest.mark.parametrize("keep_room", [False, True], ids=["as it grows", "with room kept for its end"])
def test_each_look_at_a_growing_file_finds_whole_blocks_and_no_fewer_than_the_look_before(
    tmp_path: Path, keep_room: bool
) -> None:
    readings = readings_of(BLOCK * BLOCKS)
    recorder = Recorder(tmp_path / "r.mcap", Description(), flush_interval_s=0.0, keep_room=keep_room)
    recorder.write(Batch(readings[:BLOCK]), np.empty(0, ESTIMATE))

    def write() -> None:
        for at in range(BLOCK, len(readings), BLOCK):
            recorder.write(Batch(readings[at : at + BLOCK]), np.empty(0, ESTIMATE))

    writer = threading.Thread(target=write)
    writer.start()
    looks = [aemd.open(recorder.active)]
    while writer.is_alive():
        looks.append(aemd.open(recorder.active))
    writer.join()
    looks.append(aemd.open(recorder.active))
    recorder.close()

    counts = [look.readings for look in looks]
    assert counts == sorted(counts)
    assert counts[-1] == len(readings)
    assert all(count > 0 and count % BLOCK == 0 for count in counts)
    for look in looks:
        np.testing.assert_array_equal(look["index"], readings["index"][: look.readings])
        np.testing.assert_array_equal(look["value_V"], readings["value_V"][: look.readings])
