from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyvisa.util import from_ascii_block, from_ieee_block

from aemd.model import Level, Model
from sim34410.commands import COMMANDS
from sim34410.meter import Meter
from sim34410.session import INPUT_BYTES, Session


def measured(bench, n=5):
    bench.tell("CONF:VOLT:DC 10", f"SAMP:COUN {n}", "INIT")
    bench.clock.advance(60)


@pytest.mark.parametrize(("size", "datatype"), [(64, "d"), (32, "f")])
@pytest.mark.parametrize(("order", "big_endian"), [("NORM", True), ("SWAP", False)])
@pytest.mark.parametrize("query", ["R?", "R? 5", "DATA:REM? 5", "FETC?"])
def test_an_independent_decoder_reads_the_blocks(make_bench, size, datatype, order, big_endian, query):
    bench = make_bench(Level(level_V=-1.25))
    measured(bench)
    bench.tell(f"FORM:DATA REAL,{size}", f"FORM:BORD {order}")
    block = bench.ask_bytes(query)
    decoded = from_ieee_block(block, datatype, big_endian, np.array)

    assert block[:3] == b"#2" + str(5 * size // 8)[:1].encode()
    assert block.endswith(b"\n")
    assert len(block) == 4 + 5 * size // 8 + 1
    assert decoded == pytest.approx(bench.meter.truth["value_V"], rel=1e-15 if size == 64 else 1e-7)


def test_ascii_readings_are_a_list_and_r_puts_it_into_a_block(make_bench):
    bench = make_bench(Level(level_V=-1.25), noise=False)
    measured(bench, 3)
    text = "-1.25000000E+00,-1.25000000E+00,-1.25000000E+00"

    assert bench.ask("FETC?") == text
    assert from_ascii_block(bench.ask("FETC?"), "f") == [-1.25] * 3
    assert bench.ask("R?") == f"#247{text}"
    assert bench.ask("DATA:POIN?") == "+0"


def test_r_takes_the_oldest_first_and_an_empty_memory_is_an_empty_block(make_bench):
    bench = make_bench()
    measured(bench)
    bench.tell("FORM REAL,64")
    values_V = bench.meter.truth["value_V"]

    assert from_ieee_block(bench.ask_bytes("R? 2"), "d", True) == pytest.approx(values_V[:2], rel=1e-15)
    assert from_ieee_block(bench.ask_bytes("R? 9"), "d", True) == pytest.approx(values_V[2:], rel=1e-15)
    assert bench.ask("R?") == "#10"
    assert bench.ask("R? 1") == "#10"
    assert bench.errors() == []


def test_removing_more_than_there_is_is_an_error_without_an_answer(bench):
    measured(bench, 2)

    assert bench.ask("DATA:REM? 3") == ""
    assert bench.errors() == [-222]
    assert bench.ask("DATA:REM? 2") == "+1.25000000E+00,+1.25000000E+00"


def test_the_last_reading_carries_its_unit(bench):
    assert bench.ask("DATA:LAST?") == "+9.91000000E+37 VDC"
    measured(bench)
    assert bench.ask("DATA:LAST?") == "+1.25000000E+00 VDC"


@pytest.mark.parametrize(
    ("message", "answer"),
    [
        ("*IDN?", "Agilent Technologies,34410A,MY47006594,2.35-2.35-0.09-46-09"),
        ("SYST:VERS?", "1994.0"),
        ("SYST:LFR?", "+50"),
        ("FUNC?", '"VOLT"'),
        ("CONF:VOLT:DC 1,1e-6;:CONF?", "VOLT +1.00000000E+00,+7.00000000E-07"),
        ("CONF:VOLT 0.5;:VOLT:RANG?;RANG:AUTO?", "+1.00000000E+00;0"),
        ("VOLT:RANG 15;RANG?;RANG:AUTO?", "+1.00000000E+02;0"),
        ("VOLT:RANG:AUTO ON;:VOLT:RANG:AUTO?", "1"),
        ("VOLT:NPLC 0.5;NPLC?", "+1.00000000E+00"),
        ("VOLT:NPLC? MIN;NPLC? MAX;NPLC? DEF", "+6.00000000E-03;+1.00000000E+02;+1.00000000E+00"),
        ("VOLT:APER 5 ms;APER?;APER:ENAB?", "+5.00000000E-03;1"),
        ("VOLT:APER 5 ms;NPLC 2;APER:ENAB?;:VOLT:APER?", "0;+4.00000000E-02"),
        ("VOLT:RANG 10;RES 3e-6;NPLC?", "+1.00000000E+00"),
        ("VOLT:IMP:AUTO ON;:VOLT:IMP:AUTO?", "1"),
        ("VOLT:ZERO:AUTO ONCE;:VOLT:ZERO:AUTO?", "0"),
        ("TRIG:COUN INF;COUN?", "+9.90000000E+37"),
        ("TRIG:DEL?;DEL 2ms;DEL?;DEL:AUTO?", "+1.60000000E-04;+2.00000000E-03;0"),
        ("VOLT:NPLC 0.2;:TRIG:DEL?", "+1.30000000E-04"),
        ("VOLT:NPLC 0.02;:TRIG:DEL?", "+1.00000000E-04"),
        ("SAMP:COUN MAX;COUN?;TIM? MAX", "+50000;+3.60000000E+03"),
        ("FORM REAL;:FORM?;:FORM REAL,32;:FORM:DATA?", "REAL,64;REAL,32"),
        ("FORM:BORD SWAPPED;:FORM:BORD?", "SWAP"),
        ("DISP OFF;:DISP?", "0"),
        ("DISP:WIND1:TEXT 'a;b';TEXT?;:DISP:WIND2:TEXT?", '"a;b";""'),
        ("*ESE 36;*ESE?;*SRE 4;*SRE?", "+36;+4"),
        ("*OPC?", "1"),
        ("*OPC;*ESR?", "+129"),  # power on, operation complete
        ("SYST:BEEP;:SYST:REM;:SYST:LOC;*TST?", "+0"),
    ],
)
def test_settings_are_answered_as_the_meter_has_them(bench, message, answer):
    assert bench.ask(message) == answer
    assert bench.errors() == []


@pytest.mark.parametrize(
    ("message", "code"),
    [
        ("VOLT:NPCL 1", -113),
        ("CURR:DC:NPLC 1", -113),
        ("*IDN", -113),
        ("INIT?", -113),
        ("VOLT:NPLC", -109),
        ("VOLT:NPLC 1,2", -108),
        ("*CLS 1", -108),
        ("VOLT:NPLC x", -104),
        ("VOLT:NPLC 1 V", -131),
        ("VOLT:NPLC 101", -222),
        ("VOLT:NPLC 0.001", -222),
        ("VOLT:APER 2", -222),
        ("VOLT:RANG 1001", -222),
        ("SAMP:COUN 50001", -222),
        ("SAMP:TIM 3601", -222),
        ("TRIG:SOUR LAN", -224),
        ("FORM REAL,16", -224),
        ("FUNC 'CURR'", -224),
        ("CONF:VOLT:DC 10,1e-9", -221),
        ("TRIG:COUN INF;:READ?", -221),
        ("TRIG:SOUR BUS;:READ?", -214),
        ("FETC?", -230),
        ("R? 0", -222),
        ("DISP:TEXT hello", -104),
    ],
)
def test_what_cannot_be_obeyed_is_queued_and_not_answered(bench, message, code):
    assert bench.ask(message) == ""
    assert bench.errors() == [code]


def test_the_rest_of_a_message_is_dropped_after_a_command_error_but_not_after_another(bench):
    assert bench.ask("*IDN?;VOLT:NPCL 1;*OPC?") == "Agilent Technologies,34410A,MY47006594,2.35-2.35-0.09-46-09"
    assert bench.ask("VOLT:NPLC 999;*OPC?") == "1"
    assert bench.errors() == [-113, -222]


def test_errors_set_standard_event_and_status_byte(bench):
    bench.ask("*ESR?")
    bench.ask("VOLT:NPCL 1")
    bench.ask("VOLT:NPLC 999")
    bench.ask("*ESE 48;*SRE 32")

    assert bench.ask("*STB?") == "+100"  # error queue 4, standard event 32, request 64
    assert bench.ask("*ESR?") == "+48"
    assert bench.ask("*STB?") == "+4"
    bench.ask("*CLS")
    assert bench.ask("*STB?") == "+0"


def test_questionable_is_summarised_in_the_status_byte(bench):
    bench.stream("30 ms", "VOLT:ZERO:AUTO ON", "STAT:QUES:ENAB 4")
    bench.clock.advance(1)

    assert bench.ask("*STB?") == "+8"
    assert bench.ask("STAT:QUES?") == "+4"


def test_read_answers_when_the_reading_is_there_and_what_follows_waits(bench):
    bench.tell("CONF:VOLT:DC 10", "TRIG:DEL 0", "SAMP:COUN 2;SOUR TIM;TIM 1")
    assert bench.ask_bytes("READ?;*OPC?") == b""
    assert bench.ask_bytes("*IDN?") == b""
    assert bench.session.waiting
    assert bench.session.wake_ns == pytest.approx(bench.clock.now_ns + 1_040_000_000, abs=2)

    bench.clock.advance(1.03)
    assert bench.session.handle(b"") == b""
    bench.clock.advance(0.02)
    lines = bench.session.handle(b"").split(b"\n")

    assert lines[0] == b"+1.25000000E+00,+1.25000000E+00;1"
    assert lines[1].startswith(b"Agilent")
    assert not bench.session.waiting


def test_another_client_ends_a_wait_that_has_no_end(bench):
    bench.stream("100 ms")
    other = Session(bench.meter)
    assert other.handle(b"*OPC?\n") == b""
    assert other.wake_ns is None

    bench.tell("ABOR")
    assert other.handle(b"") == b"1\n"


def test_operation_complete_is_set_when_the_readings_are_there(bench):
    bench.ask("*ESR?")
    bench.tell("CONF:VOLT:DC 10", "INIT;*OPC")
    assert bench.ask("*ESR?") == "+0"
    bench.clock.advance(1)
    assert bench.ask("*ESR?") == "+1"


@settings(deadline=None)
@given(cuts=st.lists(st.integers(0, 200), max_size=10))
def test_a_message_may_come_in_any_pieces(cuts):
    message = b'*RST;:VOLT:NPLC 10;*IDN?\r\nSAMP:TIM? MIN;:DISP:TEXT "a;b";TEXT?\nSYST:ERR?\n*OPC?\n'
    sessions = [Session(Meter(Model((Level(level_V=0.0),)).realise(), lambda: 0)) for _ in range(2)]
    whole = sessions[0].handle(message)
    edges = [0, *sorted(min(cut, len(message)) for cut in cuts), len(message)]
    pieces = [sessions[1].handle(message[a:b]) for a, b in pairwise(edges)]

    assert b"".join(pieces) == whole
    assert whole.count(b"\n") == 4


def test_a_line_without_an_end_is_thrown_away(bench):
    assert bench.session.handle(b"x" * (INPUT_BYTES + 1)) == b""
    assert bench.ask("*OPC?") == "1"
    assert bench.errors() == [-363]


words = sorted({word for path in COMMANDS._entries for word in path})
tokens = st.sampled_from(
    [
        *words,
        *" ;:?,\n\"'#*",
        "MIN",
        "MAX",
        "DEF",
        "INF",
        "ON",
        "1",
        "0",
        "-1",
        "1e400",
        "nan",
        "50000",
        "10 ms",
        "REAL,64",
    ]
)


@settings(deadline=None, max_examples=300)
@given(
    st.lists(
        st.tuples(
            st.binary(max_size=40) | st.lists(tokens, max_size=25).map(lambda t: "".join(t).encode()),
            st.integers(0, 10**10),
        ),
        max_size=20,
    )
)
def test_no_bytes_make_the_meter_fail(messages):
    now_ns = [0]
    session = Session(Meter(Model((Level(level_V=0.0),)).realise(), lambda: now_ns[0]))
    for message, pause_ns in messages:
        session.handle(message + b"\n")
        now_ns[0] += pause_ns

    fresh = Session(session._meter)
    assert fresh.handle(b"\nABOR;*CLS;*OPC?\n") == b"1\n"
