"""Numbered answers and the journal, on the simulated meter behind a line that plays tricks."""

import pytest

from aemd.errors import InstrumentError
from agilent34410.dialogue import Dialogue
from sim34410 import Fault, Meter, MeterProperties
from sim34410.bench import Bench
from sim34410.clock import SteppedClock
from sim34410.simulated_link import SimulatedLink
from tests.storm.weather import Slope


class Tricky(SimulatedLink):
    """A line that, told to, answers with what it answered before."""

    repeats = False
    before = ""

    def query(self, command: str) -> str:
        answer = super().query(command)
        said = self.before if self.repeats else answer
        Tricky.before = answer
        return said

    def query_block(self, command: str, most: int) -> tuple[bytes, str]:
        Tricky.before = command
        return super().query_block(command, most)


@pytest.fixture
def clock() -> SteppedClock:
    return SteppedClock()


@pytest.fixture
def bench(clock: SteppedClock) -> Bench:
    return Bench(Meter(Slope(), clock, MeterProperties(noise=False)), clock)


@pytest.fixture
def dialogue(bench: Bench, clock: SteppedClock) -> Dialogue:
    Tricky.repeats = False
    link = Tricky(bench, clock)
    dialogue = Dialogue(lambda: Tricky(bench, clock), link, link.query("*IDN?"))
    dialogue.begin_journal()
    for command in ("FORM:DATA REAL,64", "TRIG:COUN INF", "SAMP:SOUR TIM", "SAMP:TIM 0.5", "SAMP:COUN MAX", "INIT"):
        dialogue.command(command)
    return dialogue


def test_an_answer_of_the_same_shape_to_an_earlier_question_is_refused(dialogue: Dialogue) -> None:
    dialogue.look()
    Tricky.repeats = True

    with pytest.raises(InstrumentError, match="is not to this question"):
        dialogue.look()


def test_after_a_failure_nothing_is_asked_until_it_is_restored(dialogue: Dialogue) -> None:
    Tricky.repeats = True
    with pytest.raises(InstrumentError):
        dialogue.look()
    Tricky.repeats = False
    with pytest.raises(InstrumentError, match="restore it"):
        dialogue.look()

    assert dialogue.restore() == "drained"
    assert dialogue.look().waiting >= 0


@pytest.mark.parametrize(("kind", "torn"), [("lost", 3), ("silent", 0)])
def test_the_journal_tells_whether_a_block_that_never_came_has_left_the_memory(
    kind: str, torn: int, dialogue: Dialogue, bench: Bench, clock: SteppedClock
) -> None:
    clock.sleep(5.0)
    before = dialogue.look().waiting
    bench.add([Fault(kind, (clock() - bench._on_ns) * 1e-9)])  # type: ignore[arg-type]
    with pytest.raises(InstrumentError):
        dialogue.take(3)
    dialogue.restore()

    assert dialogue.take_torn() == torn
    assert dialogue.take_torn() == 0
    assert dialogue.look().waiting >= before - torn


def test_a_block_that_came_whole_is_not_torn_by_a_failure_after_it(
    dialogue: Dialogue, bench: Bench, clock: SteppedClock
) -> None:
    clock.sleep(5.0)
    dialogue.take(3)
    bench.add([Fault("lost", (clock() - bench._on_ns) * 1e-9)])
    with pytest.raises(InstrumentError):
        dialogue.look()
    dialogue.restore()

    assert dialogue.take_torn() == 0


def test_a_block_that_is_obeyed_long_after_it_was_given_up_is_noticed_and_counted(
    dialogue: Dialogue, bench: Bench, clock: SteppedClock
) -> None:
    clock.sleep(5.0)
    bench.add([Fault("silent", (clock() - bench._on_ns) * 1e-9)])
    with pytest.raises(InstrumentError):
        dialogue.take(3)
    given_up = Tricky.before
    dialogue.restore()
    assert dialogue.take_torn() == 0
    dialogue.look()
    SimulatedLink(bench, clock).query_block(given_up, 24)  # it was on its way all the time

    with pytest.raises(InstrumentError, match="obeyed what was sent to it long ago"):
        dialogue.look()
    dialogue.restore()
    assert dialogue.take_torn() == 3
    dialogue.look()


def test_a_meter_that_was_switched_off_meanwhile_has_no_journal(
    dialogue: Dialogue, bench: Bench, clock: SteppedClock
) -> None:
    bench.add([Fault("power", (clock() - bench._on_ns) * 1e-9, lasts_s=1.0)])
    for _ in range(10):
        clock.sleep(1.0)
        try:
            dialogue.restore()
            break
        except InstrumentError:
            continue

    assert dialogue.is_restarted


@pytest.mark.parametrize(
    ("resource", "is_open_still"),
    [
        ("TCPIP0::192.0.2.1::inst0::INSTR", True),  # the last VXI-11 link's end would have the meter clear itself
        ("USB0::0x0957::0x0607::MY1::INSTR", False),
        ("ASRL/dev/ttyUSB0::INSTR", False),
    ],
)
def test_a_line_that_only_one_can_have_is_closed_before_it_is_opened_again_and_another_afterwards(
    resource: str, *, is_open_still: bool, dialogue: Dialogue, bench: Bench, clock: SteppedClock
) -> None:
    old, seen = dialogue._link, []
    old.resource = resource  # type: ignore[misc]

    def open_again() -> Tricky:
        seen.append(old.is_open)
        return Tricky(bench, clock)

    dialogue._open_link, dialogue._rung = open_again, 2

    assert dialogue.restore() == "opened again"
    assert seen == [is_open_still]
    assert not old.is_open


def test_where_the_line_that_was_opened_again_is_silent_neither_stays_open(
    dialogue: Dialogue, bench: Bench, clock: SteppedClock
) -> None:
    old, new = dialogue._link, Tricky(bench, clock)
    old.resource = "TCPIP0::192.0.2.1::5025::SOCKET"  # type: ignore[misc]
    bench.add([Fault("silent", (clock() - bench._on_ns) * 1e-9)])
    dialogue._open_link, dialogue._rung = lambda: new, 2
    with pytest.raises(InstrumentError, match="no whole answer"):
        dialogue.restore()

    assert not old.is_open
    assert not new.is_open


def test_another_meter_at_the_same_address_is_refused_by_name(dialogue: Dialogue, clock: SteppedClock) -> None:
    other = Bench(Meter(Slope(), clock, MeterProperties(identity="Agilent Technologies,34410A,OTHER,1")), clock)
    dialogue._open_link = lambda: Tricky(other, clock)
    dialogue._link.close()

    with pytest.raises(InstrumentError, match=r"this is 'Agilent Technologies,34410A,OTHER,1' now, not"):
        dialogue.restore()
    assert not dialogue._link.is_open
