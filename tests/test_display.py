"""What a person is shown: the rate as it arrives, a line now and then where there is no terminal."""

import io

import numpy as np
import pytest
from rich.console import Console

from aemd.block import ESTIMATE, READING, Batch, Event, make_block
from aemd.config import Scale
from aemd.display import FIRST_LINE_S, LONGEST_LINE_S, Progress, showing
from aemd.pipeline import Tally


class HandClock:
    def __init__(self) -> None:
        self.now_ns = 0

    def __call__(self) -> int:
        return self.now_ns


def feed(sinks: list[object], clock: HandClock, seconds: float, events: tuple[Event, ...] = ()) -> None:
    """Ten readings a second of 1.5 mV, a second at a time."""
    for second in range(round(seconds)):
        block = make_block(np.full(10, 1.5e-3), first_index=10 * second, interval_ns=1e8)
        estimates = np.zeros(10, ESTIMATE)
        estimates["value_V"], estimates["window"] = 1.25e-3, 15
        clock.now_ns += 1_000_000_000
        for sink in sinks:
            sink.write(Batch(block, events), estimates)  # type: ignore[attr-defined]


def test_the_rate_is_that_of_arrival() -> None:
    clock, tally = HandClock(), Tally()
    progress = Progress(tally, Scale(), clock)

    feed([tally, progress], clock, 20)

    assert progress.rate_hz == pytest.approx(10.0)
    assert 'raw="+1.500000 mV" estimate="+1.250000 mV" window=15' in progress.line()


def test_values_are_shown_in_the_sensors_unit() -> None:
    clock, tally = HandClock(), Tally()
    progress = Progress(tally, Scale(factor=200.0, offset=1.0, unit="g"), clock)

    feed([tally, progress], clock, 2)

    assert 'raw="+1.300000 g"' in progress.line()


def test_where_there_is_no_terminal_a_line_comes_ever_more_rarely_and_with_every_event_that_matters() -> None:
    clock, tally, out = HandClock(), Tally(), io.StringIO()
    gap = Event(0, "gap", "three readings lost", 1, 3)
    ordinary = Event(0, "clock", "stamps within 1 ms")
    with showing(tally, Scale(), Console(file=out), clock) as sink:
        feed([tally, sink], clock, 7 * FIRST_LINE_S)  # after 1, 3 and 7 times that
        feed([tally, sink], clock, 1, (gap, ordinary))

    lines = out.getvalue().splitlines()
    assert [line.split("=")[0] for line in lines] == ["readings", "readings", "readings", "event"]
    assert lines[-1] == 'event=gap message="three readings lost"'


def test_a_log_of_months_has_a_line_an_hour() -> None:
    clock, tally, out = HandClock(), Tally(), io.StringIO()
    nothing = Batch(np.empty(0, READING))
    with showing(tally, Scale(), Console(file=out), clock) as sink:
        for _ in range(30 * 24 * 6):
            clock.now_ns += 600_000_000_000
            sink.write(nothing, np.empty(0, ESTIMATE))

    lines = len(out.getvalue().splitlines())
    assert lines == pytest.approx(30 * 24 * 3600 / LONGEST_LINE_S, abs=10)
