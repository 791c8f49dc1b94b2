"""What tells the members of the family apart; the figures are those of their manuals (see `sim34410.family`)."""

import pytest

from aemd.errors import InstrumentError
from sim34410 import Options, make_meter
from sim34410.session import Session

IDENTITIES = {
    "34410A": "Agilent Technologies,34410A,MY47006594,2.35-2.35-0.09-46-09",
    "34411A": "Agilent Technologies,34411A,MY53001937,2.40-2.40-0.09-46-09",
    "34461A": "Keysight Technologies,34461A,MY53220567,A.02.14-02.40-02.14-00.49-03-01",
    "34465A": "Keysight Technologies,34465A,MY57501234,A.02.14-02.40-02.14-00.49-03-01",
}


def ask(model: str, *messages: str) -> str:
    session = Session(make_meter(Options(identity=IDENTITIES[model], noise=False)))
    return "".join(session.handle(message.encode() + b"\n").decode() for message in messages).removesuffix("\n")


@pytest.mark.parametrize(
    ("model", "memory", "samples", "least_nplc"),
    [
        ("34410A", 50_000, 50_000, 0.006),
        ("34411A", 1_000_000, 1_000_000, 0.001),
        ("34461A", 10_000, 1_000_000, 0.02),
        ("34465A", 50_000, 1_000_000_000, 0.02),
    ],
)
def test_memory_samples_and_apertures_are_the_model_s(model, memory, samples, least_nplc):
    answers = ask(model, "DATA:POIN:EVEN:THR? MAX;:SAMP:COUN? MAX;:VOLT:NPLC? MIN").split(";")

    assert [float(answer) for answer in answers] == [memory, samples, least_nplc]


@pytest.mark.parametrize("model", IDENTITIES)
def test_it_says_who_it_is(model):
    assert ask(model, "*IDN?") == IDENTITIES[model]


@pytest.mark.parametrize(("model", "error"), [("34410A", 0), ("34411A", 0), ("34461A", -113), ("34465A", 0)])
@pytest.mark.parametrize("command", ["SAMP:SOUR TIM", "SAMPLE:TIMER 0.1", "SENS:VOLT:DC:APER 0.01"])
def test_a_34461a_has_neither_timer_nor_aperture(model, error, command):
    assert int(ask(model, command, "SYST:ERR?").split(",")[0]) == error


@pytest.mark.parametrize(("model", "interval_s"), [("34410A", 0.06668), ("34465A", 0.066667)])
def test_the_timer_has_the_model_s_steps(model, interval_s):
    assert float(ask(model, "SAMP:TIM 66.6667 ms", "SAMP:TIM?")) == pytest.approx(interval_s, abs=1e-9)


@pytest.mark.parametrize("identity", ["", "Acme,1234,0,1", "34410A"])
def test_a_model_that_is_none_of_them_is_refused_by_name(identity):
    with pytest.raises(InstrumentError, match=r"identity = .*there are: 34401A, 34410A"):
        make_meter(Options(identity=identity))
