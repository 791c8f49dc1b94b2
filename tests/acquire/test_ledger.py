"""The books, kept of the simulated meter over its real link, on a clock that is moved by hand."""

import re
from collections.abc import Iterator
from contextlib import closing, contextmanager

import numpy as np
import pytest

import agilent34410
from aemd.acquire.clock import DeviceClock
from aemd.acquire.instrument import Drain, Instrument
from aemd.acquire.ledger import Ledger
from aemd.block import Block, Event, Status
from sim34410 import Meter
from tests.drivers.agilent34410.bench import FAST, HandClock, Ramp, served

SLOW = agilent34410.Options(trigger_delay_s=0.0)
UTC_OFFSET_NS = 1_700_000_000_000_000_000


class Bench:
    """The simulated meter, the driver and the books on one clock; and what came out so far."""

    def __init__(self, instrument: Instrument, meter: Meter, clock: HandClock) -> None:
        self.instrument = instrument
        self.meter = meter
        self.clock = clock
        self.fit = DeviceClock(instrument.interval_s, instrument.sample_delay_s, instrument.epoch_readings)
        self.ledger = Ledger(self.fit, UTC_OFFSET_NS, instrument.epoch_readings, instrument.memory_readings)
        self.blocks: list[Block] = []
        self.events: list[Event] = []
        instrument.start()
        self.ledger.begin(clock(), clock())

    def look(self, most: int = 50_000) -> None:
        drain = self.instrument.drain(most)
        recount = self.instrument.drain(0) if self.ledger.needs_recount(drain) else None
        block, events = self.ledger.enter(drain, recount)
        self.blocks.append(block)
        self.events += events

    def run(self, seconds: float, poll_s: float = 0.01) -> None:
        for _ in range(round(seconds / poll_s)):
            self.clock.move(poll_s)
            self.look()

    @property
    def readings(self) -> Block:
        return np.concatenate(self.blocks)

    def of_kind(self, kind: str) -> list[Event]:
        return [event for event in self.events if event.kind == kind]

    def check(self, before: int | None = None) -> None:
        """Values are the meter's, instants true within two intervals; `before` readings came before the one gap."""
        readings, truth = self.readings, self.meter.truth
        if before is None:
            before = readings.size
        truth = np.concatenate((truth[:before], truth[truth.size - (readings.size - before) :]))
        middle_ns = truth["begin_ns"] + truth["aperture_ns"] // 2 + UTC_OFFSET_NS
        assert np.array_equal(readings["value_V"], truth["value_V"])
        assert np.abs(readings["t_ns"] - middle_ns).max() <= 2 * self.instrument.interval_s * 1e9

    def check_loss(self, before: int) -> tuple[int, int]:
        """There is one gap, after `before` readings, of the right length within what it says; return both."""
        (gap,) = self.of_kind("gap")
        stated, *within = map(int, re.findall(r"[0-9]+", gap.message))
        tolerance = within[0] if within else 0
        assert (gap.first_index, gap.last_index) == (before, before + stated - 1)
        assert stated == self.ledger.lost
        assert abs(stated - (self.meter.truth.size - self.readings.size)) <= tolerance
        assert np.flatnonzero(self.readings["status"] & Status.GAP).tolist() == [before]
        assert self.readings["index"][before] == gap.last_index + 1
        assert abs(gap.t_ns - self.readings["t_ns"][before - 1]) <= (tolerance + 2) * self.instrument.interval_s * 1e9
        return stated, tolerance


@contextmanager
def benched(options: agilent34410.Options = FAST, source: Ramp | None = None) -> Iterator[Bench]:
    clock = HandClock()
    with (
        served(clock, source, clock_error_ppm=60.0) as (resource, meter),
        closing(agilent34410.open_instrument(resource, options, clock)) as instrument,
    ):
        yield Bench(instrument, meter, clock)


def test_without_loss_indices_go_on_by_one_across_timing_epochs() -> None:
    with benched() as bench:
        bench.run(5.5, poll_s=0.05)

        assert np.array_equal(bench.readings["index"], np.arange(bench.readings.size))
        assert bench.readings.size > 50_000
        assert bench.ledger.lost == 0
        assert [event.t_ns for event in bench.of_kind("epoch")] == [int(bench.readings["t_ns"][50_000])]
        assert bench.of_kind("gap") == []
        bench.check()


def test_the_number_lost_at_15_hz_is_known_to_one_reading_once_the_clock_is_known() -> None:
    with benched(SLOW) as bench:
        bench.run(200.0, poll_s=1.618 * SLOW.interval_s)
        before = bench.readings.size
        bench.clock.move(3500.0)
        bench.look()
        bench.run(1.0)
        stated, tolerance = bench.check_loss(before)

        assert stated == pytest.approx(3500 / SLOW.interval_s - 50_000, abs=10)
        assert tolerance <= 2  # one for the new timing epoch in the gap, one for 3 ppm of 3500 s
        bench.check(before)


@pytest.mark.parametrize("taken", [50_000, 1000])
def test_the_number_lost_from_a_fast_stream_is_right_within_what_the_gap_says(taken: int) -> None:
    with benched() as bench:
        bench.run(1.0, poll_s=0.0101)
        before = bench.readings.size
        bench.clock.move(7.0)
        bench.look(taken)
        bench.run(0.1)
        _, tolerance = bench.check_loss(before)

        assert tolerance <= 16  # 200 ppm of 7 s is 14 readings; one for the new timing epoch
        bench.check(before)


def test_readings_that_vanished_without_a_word_are_missed_by_the_clock_and_are_a_gap() -> None:
    with benched() as bench:
        bench.run(2.0, poll_s=0.0101)
        before = bench.readings.size
        bench.clock.move(0.5)
        bench.instrument.drain(0)  # has the meter make them
        bench.meter.memory.take(400)  # another program, which leaves no trace but this
        bench.look()
        bench.run(0.1)
        stated, tolerance = bench.check_loss(before)

        assert abs(stated - 400) <= tolerance <= 2
        assert "did another program read or clear it?" in bench.of_kind("gap")[0].message
        bench.check(before)


def test_what_the_memory_loses_while_nothing_can_be_taken_is_one_gap() -> None:
    with benched() as bench:
        bench.run(0.5, poll_s=0.0101)
        before = bench.readings.size
        for _ in range(8):
            bench.clock.move(1.0)
            bench.look(most=0)
        bench.look()
        bench.run(0.1)

        bench.check_loss(before)
        bench.check(before)


def test_a_loss_that_is_drained_only_after_the_end_is_counted_up_to_the_end() -> None:
    with benched() as bench:
        bench.run(0.5, poll_s=0.0101)
        before = bench.readings.size
        bench.clock.move(6.0)
        bench.instrument.stop()
        bench.ledger.end(bench.clock(), bench.clock())
        bench.clock.move(3.0)
        bench.look()

        bench.check_loss(before)
        bench.check(before)


@pytest.mark.parametrize("vanished", [0, 2, 5, 100])
def test_readings_that_are_not_there_at_the_end_are_missed_by_the_clock_alone(vanished: int) -> None:
    with benched() as bench:
        bench.run(2.0, poll_s=0.0101)
        bench.clock.move(0.02)
        bench.instrument.stop()
        stopped_ns = bench.clock()
        bench.ledger.end(stopped_ns, stopped_ns)
        bench.meter.memory.take(vanished)
        bench.look()

        assert bench.ledger.is_short(stopped_ns, stopped_ns) == (vanished > 2)
        # However long the answer to the stop took: only what was due when it was asked for is certain.
        assert bench.ledger.is_short(stopped_ns, stopped_ns + 2_000_000_000) == (vanished > 2)


def test_a_memory_that_overflows_between_the_count_and_the_taking_has_its_gap_before_what_was_taken() -> None:
    # The simulated meter does both at one instant, so these looks are made by hand: 10,000 readings/s since 0.
    def look(t_ms: int, taken: int, waiting: int, *, overflowed: bool = False) -> Drain:
        t_ns = t_ms * 1_000_000
        return Drain(np.zeros(taken), np.zeros(taken, np.uint32), waiting, t_ns, t_ns, t_ns, overflowed)

    fit = DeviceClock(1e-4)
    ledger = Ledger(fit, UTC_OFFSET_NS, epoch_readings=0, memory_readings=50_000)
    ledger.begin(0, 0)
    for t_ms in range(10, 1010, 10):
        ledger.enter(look(t_ms, 100, 100))
    counted = look(5999, 49_990, 49_990)
    recounted = look(6003, 0, 10, overflowed=True)
    assert ledger.needs_recount(counted)
    block, events = ledger.enter(counted, recounted)

    # Finished at 6003 ms: 60,030; here: 10,000 + 49,990 + 10.
    assert [event.kind for event in events if event.kind == "gap"] == ["gap"]
    assert block["index"][0] == 10_000 + ledger.lost
    assert ledger.lost == pytest.approx(30, abs=11)  # 200 ppm of 5 s is 10 readings


def test_a_nearly_full_memory_that_lost_nothing_makes_no_gap() -> None:
    with benched() as bench:
        bench.run(0.5)
        bench.clock.move(4.97)
        bench.look()

        assert bench.of_kind("gap") == []
        assert np.array_equal(bench.readings["index"], np.arange(bench.readings.size))


def test_an_overload_is_told_of_at_its_begin_and_at_its_end() -> None:
    with benched(agilent34410.Options(), Ramp(high_s=(2.0, 3.0), low_s=(4.0, 5.0))) as bench:
        bench.run(6.0, poll_s=0.25)
        readings = bench.readings
        over = (readings["status"] & (Status.OVERLOAD_HIGH | Status.OVERLOAD_LOW)) != 0
        changes = np.flatnonzero(np.diff(over.astype(int), prepend=0))

        assert [event.t_ns for event in bench.of_kind("overload")] == readings["t_ns"][changes].tolist()
        assert len(changes) == 4


def test_an_interval_that_the_meter_does_not_keep_flags_its_block_and_is_told_of() -> None:
    with benched() as bench:
        bench.run(0.1)
        bench.meter.questionable.happened(1 << 2)
        bench.run(0.1)
        flagged = [bool((block["status"] & Status.TIMING).all()) for block in bench.blocks if block.size]

        assert flagged.count(True) == 1
        assert len(bench.of_kind("timing")) == 1


def test_the_meters_error_queue_becomes_events() -> None:
    with benched() as bench:
        bench.meter.report(-221)
        bench.run(2.0, poll_s=0.5)

        assert [event.message for event in bench.of_kind("instrument")] == ['-221,"Settings conflict"']


def test_the_clock_is_told_of_when_it_is_first_known_and_then_every_ten_minutes() -> None:
    with benched(agilent34410.Options()) as bench:
        bench.run(1500.0, poll_s=2.5)

        assert len(bench.of_kind("clock")) == 3
