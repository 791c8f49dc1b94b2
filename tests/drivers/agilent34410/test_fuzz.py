"""Whatever a meter answers, only InstrumentError leaves the driver. `AEMD_FUZZ=5000` draws that many, for minutes."""

import os
from contextlib import suppress

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aemd.errors import InstrumentError
from agilent34410 import Options, characterise
from agilent34410.meter import open_instrument
from sim34410 import Meter, MeterProperties
from sim34410.bench import Bench
from sim34410.clock import SteppedClock
from sim34410.simulated_link import SimulatedLink
from tests.storm.weather import Slope

EXAMPLES = int(os.environ.get("AEMD_FUZZ", "40"))

pytestmark = pytest.mark.timeout(120 if EXAMPLES <= 40 else 0)  # s; who asks for more wants them all

NUMBERS = st.sampled_from(
    ["nan", "inf", "-inf", "1e400", "-1", "+0", "9.9E37", "", "+1;+2", "1e-400", "0x10", "½", "٣"]
)
LINES = st.one_of(NUMBERS, st.text(max_size=40), st.from_regex(r"[+-]?[0-9]{1,20}(\.[0-9]+)?(;[+-]?[0-9]+){0,4}"))


class Mad(SimulatedLink):
    """A line whose answers are replaced by drawn ones, each with the chance that is drawn, too."""

    draws: st.DataObject
    sane: int = 0

    def query(self, command: str) -> str:
        answer = super().query(command)
        if self.sane > 0:
            type(self).sane -= 1
            return answer
        how = self.draws.draw(st.sampled_from(["true", "true", "true", "mad", "prefix", "numbered"]))
        if how == "true":
            return answer
        line = self.draws.draw(LINES)
        if how == "prefix":
            return answer[: len(line)]
        return line if how == "mad" else f"{line};{answer.rpartition(';')[2]}"

    def query_block(self, command: str, most: int) -> tuple[bytes, str]:
        block, rest = super().query_block(command, most)
        how = self.draws.draw(st.sampled_from(["true", "mad", "short", "rest"]))
        if how == "mad":
            return self.draws.draw(st.binary(min_size=len(block), max_size=len(block))), rest
        if how == "short":
            return block[: self.draws.draw(st.integers(0, 20))], rest
        return block, (self.draws.draw(LINES) if how == "rest" else rest)


@given(draws=st.data(), sane=st.integers(0, 60))
@settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck))
def test_only_instrument_errors_leave_the_driver(draws: st.DataObject, sane: int) -> None:
    clock = SteppedClock()
    bench = Bench(Meter(Slope(), clock, MeterProperties(noise=False)), clock)
    Mad.draws, Mad.sane = draws, sane
    try:
        meter = open_instrument("SIM", Options(), clock, lambda: Mad(bench, clock))
    except InstrumentError:
        return
    for act in ("start", "drain", "drain", "recover", "drain", "recover", "drain", "stop", "recover"):
        clock.sleep(0.5)
        with suppress(InstrumentError):
            getattr(meter, act)(*([100] if act == "drain" else []))
    meter.close()


ASKED = ("*IDN?", "COND?", "SAMP:TIM?", "SYST:ERR?", "DATA:POIN?", "EVEN?", "MAX", "R?", "*OPC?")


class Spoilt(SimulatedLink):
    """A line of which one answer is another: that to the question with one end, by its number among those."""

    asked: str
    number: int
    answer: str
    cut: int

    def query(self, command: str) -> str:
        said = super().query(command)
        return self.answer if self._is_it(command) else said

    def query_block(self, command: str, most: int) -> tuple[bytes, str]:
        block, rest = super().query_block(command, most)
        return (block[: self.cut], self.answer) if self._is_it(command) else (block, rest)

    def _is_it(self, command: str) -> bool:
        if not (command.endswith(self.asked) or (self.asked == "R?" and ("R? " in command))):
            return False
        type(self).number -= 1
        return self.number == -1


@given(asked=st.sampled_from(ASKED), number=st.integers(0, 9), answer=LINES, cut=st.integers(0, 20))
@settings(max_examples=max(8, EXAMPLES // 5), deadline=None, suppress_health_check=list(HealthCheck))
def test_only_instrument_errors_leave_the_questions_to_a_meter(asked: str, number: int, answer: str, cut: int) -> None:
    clock = SteppedClock()
    bench = Bench(Meter(Slope(), clock, MeterProperties(noise=False)), clock)
    Spoilt.asked, Spoilt.number, Spoilt.answer, Spoilt.cut = asked, number, answer, cut
    try:
        found = characterise("SIM", Options(), clock, clock.sleep, lambda: Spoilt(bench, clock))
    except InstrumentError:
        assert asked == "*IDN?"  # any other answer costs that question at most
        return
    assert len(found) == 9
