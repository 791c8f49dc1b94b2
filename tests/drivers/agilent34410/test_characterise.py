"""The open questions, asked of the simulated meter, whose answers are its own constants."""

import re

import pytest

from aemd.acquire.instrument import BusyError
from aemd.errors import InstrumentError
from agilent34410 import Options, characterise
from agilent34410.meter import open_instrument
from sim34410 import Meter, MeterProperties
from sim34410.bench import Bench, Link
from sim34410.clock import SteppedClock
from sim34410.schedule import GRID_NS, REARM_NS
from sim34410.simulated_link import SimulatedLink
from tests.storm.weather import Slope


def answers(link: Link) -> dict[str, str]:
    clock = SteppedClock()
    bench = Bench(Meter(Slope(), clock, MeterProperties(noise=False)), clock)
    found = characterise("SIM", Options(), clock, clock.sleep, lambda: SimulatedLink(bench, clock, link=link))
    return {one.question: one.answer for one in found}


@pytest.fixture(scope="module")
def by_socket() -> dict[str, str]:
    return answers("socket")


def test_the_step_of_the_timer_is_found(by_socket: dict[str, str]) -> None:
    assert by_socket["step of the sample timer"].startswith(f"steps of {GRID_NS * 1e-3:.3f} us")


def test_the_spacing_at_the_end_of_a_triggers_readings_is_bounded_from_both_sides(by_socket: dict[str, str]) -> None:
    said = by_socket["from the last reading of a trigger to the first of the next"]
    least_ms, largest_ms = map(float, re.findall(r"[+-][0-9.]+", said))
    # The next trigger comes REARM after the last reading is there: 0.006 PLC at 50 Hz after it began.
    true_ms = (0.006 / 50 * 1e9 + REARM_NS) * 1e-6 - 2.0

    assert least_ms <= true_ms <= largest_ms
    assert largest_ms - least_ms < 0.5


@pytest.mark.parametrize(("link", "state"), [("socket", "still sampling"), ("vxi11", "sampling no more")])
def test_what_a_lost_link_clears_is_found_out(link: Link, state: str, by_socket: dict[str, str]) -> None:
    found = by_socket if link == "socket" else answers(link)

    assert found["what a lost link clears"].endswith(state)


def test_no_question_stays_without_an_answer(by_socket: dict[str, str]) -> None:
    assert len(by_socket) == 9
    assert not [answer for answer in by_socket.values() if answer.startswith("no answer")]
    assert by_socket["R? on an empty memory"].startswith("a block of 0 bytes")
    before, after = map(int, re.findall(r"\d+", by_socket["whether ABOR keeps the memory"]))
    assert after >= before > 0


class Breaking(SimulatedLink):
    """A line that breaks at the first question after the largest SAMP:COUN."""

    broken = False

    def query(self, command: str) -> str:
        if "SAMP:COUN? MAX" in command and not Breaking.broken:
            Breaking.broken = True
            self.close()
        return super().query(command)


def test_a_line_that_breaks_at_one_question_is_opened_again_for_the_others() -> None:
    clock = SteppedClock()
    bench = Bench(Meter(Slope(), clock, MeterProperties(noise=False)), clock)
    found = characterise("SIM", Options(), clock, clock.sleep, lambda: Breaking(bench, clock))
    lacking = [one.question for one in found if one.answer.startswith("no answer")]

    assert lacking == ["largest SAMP:COUN"]


class Leaving(SimulatedLink):
    """A line that ends at the question for an empty memory's block."""

    def query_block(self, command: str, most: int) -> tuple[bytes, str]:
        if command == "R? 1":
            self.close()
        return super().query_block(command, most)


@pytest.mark.parametrize("refusals", [1, 2, 100])
def test_a_line_that_cannot_be_opened_again_costs_no_answer_that_was_given(refusals: int) -> None:
    clock = SteppedClock()
    bench = Bench(Meter(Slope(), clock, MeterProperties(noise=False)), clock)
    opened: list[Leaving] = []

    def open_line() -> Leaving:
        if opened and refusals_left.pop():
            raise InstrumentError("SIM: cannot open: connection refused")
        opened.append(Leaving(bench, clock))
        return opened[-1]

    refusals_left = [False] * 100 + [True] * refusals
    found = {one.question: one.answer for one in characterise("SIM", Options(), clock, clock.sleep, open_line)}
    lacking = [question for question, answer in found.items() if answer.startswith("no answer")]

    assert len(found) == 9
    assert found["step of the sample timer"].startswith("steps of")
    assert found["R? on an empty memory"].startswith("no block (")
    # One refusal is that of the question for the error queue; each further one costs a question more.
    assert len(lacking) == min(refusals - 1, 4)
    assert all("cannot open: connection refused" in found[question] for question in lacking)
    assert not opened[-1].is_open


@pytest.mark.parametrize(
    ("asked", "answer"),
    [("DATA:POIN?", "1e400"), ("SAMP:TIM?", "nan"), ("STAT:OPER:COND?", "-inf"), ("STAT:QUES:EVEN?", "9.9E999")],
)
def test_what_is_no_number_is_no_answer_and_no_error(asked: str, answer: str) -> None:
    clock = SteppedClock()
    bench = Bench(Meter(Slope(), clock, MeterProperties(noise=False)), clock)

    class Mad(SimulatedLink):
        def query(self, command: str) -> str:
            said = super().query(command)
            return answer if command.endswith(asked) and "STAT:QUES:ENAB" not in command else said

    found = characterise("SIM", Options(), clock, clock.sleep, lambda: Mad(bench, clock))
    lacking = [one.answer for one in found if one.answer.startswith("no answer")]

    assert len(found) == 9
    assert lacking
    assert set(lacking) == {f"no answer: the answer {answer!r} is not a number"}


def test_a_meter_that_another_program_reads_is_not_asked() -> None:
    clock = SteppedClock()
    bench = Bench(Meter(Slope(), clock, MeterProperties(noise=False)), clock)
    other = open_instrument("SIM", Options(), clock, lambda: SimulatedLink(bench, clock))
    other.start()

    def sleep(seconds: float) -> None:
        clock.sleep(seconds)
        other.drain(100)

    with pytest.raises(BusyError):
        characterise("SIM", Options(), clock, sleep, lambda: SimulatedLink(bench, clock))
    assert other.recover().sampling
