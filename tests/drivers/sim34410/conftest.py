"""A simulated meter on a clock that the test moves."""

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from aemd.model import Level, Model, Term
from sim34410.meter import Meter, MeterProperties
from sim34410.session import Session


@dataclass
class Clock:
    """Host monotonic time, ns."""

    now_ns: int = 123_456_789_000

    def __call__(self) -> int:
        return self.now_ns

    def advance(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


@dataclass
class Bench:
    """One meter, one client, one clock."""

    clock: Clock
    meter: Meter
    session: Session = field(init=False)

    def __post_init__(self) -> None:
        self.session = Session(self.meter)

    def ask(self, message: str) -> str:
        """Send a line and return the line that comes back at once; empty when nothing comes."""
        return self.ask_bytes(message).decode().removesuffix("\n")

    def ask_bytes(self, message: str) -> bytes:
        return self.session.handle(message.encode() + b"\n")

    def tell(self, *messages: str) -> None:
        """Send lines that are neither answered nor refused."""
        for message in messages:
            assert self.ask(message) == ""
        assert self.ask("SYST:ERR?") == '+0,"No error"'

    def errors(self) -> list[int]:
        codes = []
        while (code := int(self.ask("SYST:ERR?").split(",")[0])) != 0:
            codes.append(code)
        return codes

    def stream(self, interval: str, *more: str) -> None:
        """Start sampling by the timer, without an end, without autozero and delay."""
        self.tell(
            "*RST;*CLS",
            "CONF:VOLT:DC 10",
            "VOLT:DC:ZERO:AUTO OFF",
            "TRIG:SOUR IMM;DEL 0;COUN INF",
            f"SAMP:COUN MAX;SOUR TIM;TIM {interval}",
            "FORM:DATA REAL,64",
            *more,
            "INIT",
        )


MakeBench = Callable[..., Bench]


@pytest.fixture
def make_bench() -> MakeBench:
    """Return a function that makes a bench: terms of the input, and properties of the meter."""

    def make(*terms: Term, **properties) -> Bench:
        clock = Clock()
        source = Model(terms or (Level(level_V=1.25),), seed=11).realise()
        return Bench(clock, Meter(source, clock, MeterProperties(**{"truth_readings": 1_000_000, **properties})))

    return make


@pytest.fixture
def bench(make_bench: MakeBench) -> Bench:
    """A meter without noise at 1.25 V."""
    return make_bench(noise=False)
