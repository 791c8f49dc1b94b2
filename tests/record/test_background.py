import math
import threading
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from aemd.block import ESTIMATE, Batch, Estimates
from aemd.errors import RecordingError
from aemd.record.background import Background
from aemd.record.reader import Recording
from aemd.record.writer import Recorder
from tests.record.made import DESCRIPTION, readings_of

NO_ESTIMATES = np.empty(0, ESTIMATE)


class _Gate:
    """A sink that stands still until it is let go, and fails if told to."""

    def __init__(self, error: Exception | None = None) -> None:
        self.go = threading.Event()
        self.entered = threading.Event()
        self.error = error
        self.taken: list[int] = []
        self.threads: set[str] = set()
        self.empty = threading.Event()
        self.closed = False
        self.due_in_s = math.inf

    def write(self, batch: Batch, estimates: Estimates) -> None:
        if not len(batch.readings):
            self.empty.set()
            return
        self.entered.set()
        assert self.go.wait(60)
        self.threads.add(threading.current_thread().name)
        if self.error is not None:
            raise self.error
        self.taken += batch.readings["index"].tolist()

    def close(
        self, reason: str = "", *, facts: Mapping[str, str] | None = None, clock: Mapping[str, str] | None = None
    ) -> Path:
        self.closed = True
        return Path(reason)

    def discard(self) -> None:
        self.closed = True


def test_every_reading_arrives_in_order_from_a_named_thread(tmp_path: Path) -> None:
    readings = readings_of(1000)
    background = Background(Recorder(tmp_path / "r.mcap", DESCRIPTION), queue_batches=2)
    for at in range(0, 1000, 10):
        background.write(Batch(readings[at : at + 10]), NO_ESTIMATES)
    path = background.close("stop", facts={"acquired": "1000"})

    assert background.close() == path
    assert background.in_flight == 0
    with Recording(path) as recording:
        read = np.concatenate([batch.readings for batch in recording.batches()])
        assert recording.metadata["aemd.close"]["acquired"] == "1000"
    assert read.tobytes() == readings.tobytes()


def test_what_the_sink_has_not_taken_is_in_flight_and_a_full_queue_makes_the_caller_wait() -> None:
    sink, readings = _Gate(), readings_of(4)
    background = Background(sink, queue_batches=2)
    background.write(Batch(readings[:1]), NO_ESTIMATES)
    assert sink.entered.wait(60)
    background.write(Batch(readings[1:2]), NO_ESTIMATES)
    background.write(Batch(readings[2:3]), NO_ESTIMATES)
    waits = threading.Thread(target=background.write, args=(Batch(readings[3:]), NO_ESTIMATES))
    waits.start()
    waits.join(0.3)

    assert waits.is_alive()
    assert background.in_flight == 4
    sink.go.set()
    waits.join(60)
    background.close("x")
    assert (sink.taken, background.in_flight) == ([0, 1, 2, 3], 0)
    assert sink.threads == {"aemd-_gate"}


def test_what_the_sink_raises_reaches_a_caller_that_waits_for_it() -> None:
    sink = _Gate(RecordingError("disk full"))
    background = Background(sink, queue_batches=1)
    background.write(Batch(readings_of(1)), NO_ESTIMATES)
    assert sink.entered.wait(60)
    background.write(Batch(readings_of(1)), NO_ESTIMATES)
    sink.go.set()

    with pytest.raises(RecordingError, match="disk full"):
        background.write(Batch(readings_of(1)), NO_ESTIMATES)
    assert background.in_flight == 2  # taken, and never with the sink
    assert background.close("x") == Path("x")  # told already
    assert sink.closed


def test_what_the_sink_raises_at_last_is_raised_by_close_which_closes_it_all_the_same() -> None:
    sink = _Gate(RecordingError("disk full"))
    background = Background(sink)
    background.write(Batch(readings_of(1)), NO_ESTIMATES)
    sink.go.set()

    with pytest.raises(RecordingError, match="disk full"):
        background.close("x")
    assert sink.closed


def test_a_sink_to_which_nothing_comes_may_look_at_its_clock() -> None:
    sink = _Gate()
    background = Background(sink, tick_s=0.01)

    assert sink.empty.wait(60)
    background.discard()
    assert sink.closed


def test_a_sink_that_is_due_is_not_left_to_wait_for_the_next_batch() -> None:
    sink = _Gate()
    sink.due_in_s = 0.01
    background = Background(sink, tick_s=60.0)

    assert sink.empty.wait(60)
    background.discard()
