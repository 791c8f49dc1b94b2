"""Each fault does what it says, on every link, at its time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aemd.errors import InstrumentError
from sim34410 import Bench, Fault, SimulatedLink, SteppedClock, draw_faults
from sim34410.converter import OVERLOAD_V
from sim34410.faults import NOT_A_NUMBER_V, READINGS, Message, Spoiler
from sim34410.memory import Fate
from tests.drivers.sim34410.links import counting_bench

IDENTITY = "Agilent Technologies,34410A,MY47006594,2.35-2.35-0.09-46-09"
LINKS = ["socket", "vxi11", "usb", "serial"]
STREAM = "CONF:VOLT:DC 10;:VOLT:ZERO:AUTO OFF;:TRIG:DEL 0;COUN INF;:SAMP:COUN MAX;SOUR TIM;TIM 0.1;:FORM REAL,64;:INIT"
MOST = 8 * 50_000


def bench_with(*faults, **properties) -> tuple[Bench, SteppedClock]:
    clock = SteppedClock()
    return counting_bench(clock, faults, **properties), clock


def opened(bench, link="socket", timeout_s=2.0) -> SimulatedLink:
    return SimulatedLink(bench, bench.clock, timeout_s, link)


def restored(line: SimulatedLink) -> SimulatedLink:
    line.clear()
    return line


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("kind", ["silent", "lost", "half", "late"])
def test_an_answer_that_does_not_come_is_a_timeout_and_the_next_one_comes(link, kind):
    bench, clock = bench_with(Fault(kind, at_s=0.0, delay_s=2.05))
    line = opened(bench, link)
    begun_ns = clock()
    with pytest.raises(InstrumentError, match=r"\*IDN\?: no whole answer within 2 s"):
        line.query("*IDN?")

    assert 2.0 <= (clock() - begun_ns) * 1e-9 < 2.1
    with pytest.raises(InstrumentError, match="has failed; drain it"):
        line.query("*IDN?")
    assert restored(line).query("*IDN?") == IDENTITY


@pytest.mark.parametrize("kind", ["silent", "lost"])
def test_a_silent_meter_does_not_obey_and_a_lost_answer_was_obeyed(kind):
    bench, clock = bench_with(Fault(kind, at_s=10.0, lasts_s=1.0))
    line = opened(bench)
    line.write(STREAM)
    clock.sleep(10.0)
    with pytest.raises(InstrumentError):
        line.query_block("R? 50", MOST)
    fates = bench.truth["fate"]

    assert np.count_nonzero(fates == Fate.TAKEN) == {"silent": 0, "lost": 50}[kind]


def test_a_fault_of_replies_lasts_as_long_as_it_says_and_strikes_once_at_least():
    bench, clock = bench_with(Fault("lost", at_s=1.0, lasts_s=3.0), Fault("lost", at_s=100.0))
    line = opened(bench)
    clock.sleep(0.5)
    outcomes = []
    for _ in range(4):
        try:
            outcomes.append(line.query("SYST:VERS?"))
        except InstrumentError:
            outcomes.append(None)
            line.drain()
        clock.sleep(0.6)
    clock.sleep(1000.0)
    with pytest.raises(InstrumentError):
        line.query("SYST:VERS?")
    line.drain()

    assert outcomes == ["1994.0", None, None, "1994.0"]  # at 0.5, 1.1, 3.8 and 6.5 s
    assert line.query("SYST:VERS?") == "1994.0"


def test_garbage_comes_before_the_answer():
    bench, _ = bench_with(Fault("garbage", at_s=0.0, seed=7))
    answer = opened(bench).query("SYST:VERS?")

    assert answer.endswith("1994.0")
    assert answer != "1994.0"


@given(seed=st.integers(0, 2**31), reply=st.sampled_from([b"+215;+0\n", b"#18abcdefgh\n", b"1\n"]))
def test_garbage_makes_no_other_answer(seed, reply):
    spoiler = Spoiler()
    spoiler.arm(Fault("garbage", at_s=0.0, seed=seed), end_ns=0)
    arrived = bytes(spoiler.spoil(reply, 0).content)
    noise = arrived.removesuffix(reply)

    assert 1 <= len(noise) <= 16
    assert not set(noise) & set(b"0123456789+-.eE#")


@pytest.mark.parametrize("more", [1, -1, 40])
def test_a_block_that_announces_another_length_keeps_its_content(more):
    bench, clock = bench_with(Fault("length", at_s=0.0, count=more))
    line = opened(bench)
    assert line.query(f"{STREAM};:SYST:ERR?") == '+0,"No error"'  # it waits for a block
    clock.sleep(2.05)
    if more > 0:
        with pytest.raises(InstrumentError, match="no whole answer"):
            line.query_block("R? 20", MOST)
    else:
        content, rest = line.query_block("R? 20", MOST)
        assert len(content) == 8 * 19
        assert rest != ""


def test_half_a_block_is_all_that_comes():
    spoiler = Spoiler()
    spoiler.arm(Fault("half", at_s=0.0), end_ns=0)

    assert spoiler.spoil(b"#18abcdefgh\n", 5) == Message(5, bytearray(b"#18abc"), whole=False)
    assert spoiler.spoil(b"1\n", 6) == Message(6, bytearray(b"1\n"))


@pytest.mark.parametrize("link", ["vxi11", "usb"])
def test_a_refused_link_cannot_be_opened(link):
    bench, clock = bench_with(Fault("refuse", at_s=1.0, lasts_s=1.0))
    before = opened(bench, link)
    clock.sleep(1.5)
    with pytest.raises(InstrumentError, match=r"connection refused|no device found"):
        opened(bench, link)

    assert before.query("*IDN?") == IDENTITY  # those that are open stay
    clock.sleep(1.0)
    assert opened(bench, link).query("*IDN?") == IDENTITY


def test_a_refused_socket_opens_and_its_first_exchange_fails():
    bench, _ = bench_with(Fault("refuse", at_s=0.0, lasts_s=1.0))
    line = opened(bench)
    with pytest.raises(InstrumentError, match="connection refused"):
        line.query("*IDN?")

    assert not line.is_open


@pytest.mark.parametrize("kind", ["close", "unplug"])
def test_a_socket_that_ends_is_a_timeout_and_cannot_be_used_again(kind):
    bench, clock = bench_with(Fault(kind, at_s=1.0, lasts_s=0.1))
    line = opened(bench)
    line.write(STREAM)
    clock.sleep(20.0)
    with pytest.raises(InstrumentError, match="the other end has closed"):
        line.query("*IDN?")

    assert not line.is_open
    assert int(opened(bench).query("DATA:POIN?")) > 200  # it goes on sampling meanwhile


@pytest.mark.parametrize(("kind", "sampling"), [("close", False), ("unplug", True)])
def test_the_meter_clears_itself_when_it_notices_that_the_last_vxi_11_link_has_ended(kind, sampling):
    bench, clock = bench_with(Fault(kind, at_s=10.0, lasts_s=0.1))
    opened(bench, "vxi11").write(STREAM)
    clock.sleep(13.0)
    bench.advance()

    assert (bench.meter.state == "measuring") is sampling
    line = opened(bench)
    assert (int(line.query("DATA:POIN?")) > 0) is sampling
    if not sampling:
        cleared = bench.truth
        assert set(cleared["fate"]) == {Fate.CLEARED}
        assert cleared.size in (119, 120)  # 10 s until the link ended, and 2 s


def test_a_power_cycle_loses_settings_and_readings_and_takes_its_time():
    bench, clock = bench_with(Fault("power", at_s=10.0, lasts_s=15.0))
    opened(bench).write(STREAM)
    clock.sleep(20.0)
    with pytest.raises(InstrumentError, match="connection refused"):
        opened(bench).query("*IDN?")
    clock.sleep(5.1)
    line = opened(bench)

    assert line.query("DATA:POIN?;:SAMP:SOUR?;:FORM?;:TRIG:COUN?;*ESR?") == "+0;IMM;ASC,8;+1;+128"
    truth = bench.truth
    assert set(truth["fate"]) == {Fate.CLEARED}
    assert truth["begin_ns"].max() < bench._on_ns + 10e9


def test_a_storm_of_errors_overflows_the_queue():
    bench, clock = bench_with(Fault("errors", at_s=1.0, lasts_s=10.0, count=30))
    line = opened(bench)
    clock.sleep(5.5)
    assert (
        sum(line.query("SYST:ERR?")[:2] != "+0" for _ in range(20)) == 14
    )  # the first at 1 s, one each third of a second
    clock.sleep(100.0)
    line.query("*CLS;*OPC?")
    bench.add([Fault("errors", at_s=0.0, count=30)])
    queue = [line.query("SYST:ERR?") for _ in range(21)]

    assert queue[19:] == ['-350,"Queue overflow"', '+0,"No error"']


@pytest.mark.parametrize(
    ("fault", "value_V", "bit"),
    [
        (Fault("nan", at_s=10.0, lasts_s=2.0), NOT_A_NUMBER_V, 0),
        (Fault("overload", at_s=10.0, lasts_s=2.0, seed=1), OVERLOAD_V, 1),
        (Fault("overload", at_s=10.0, lasts_s=2.0, seed=2), -OVERLOAD_V, 1),
    ],
)
def test_readings_begun_in_the_window_and_no_others_have_no_value(fault, value_V, bit):
    bench, clock = bench_with(fault)
    line = opened(bench)
    line.write(STREAM)
    clock.sleep(20.05)
    content, _ = line.query_block("R?", MOST)
    read_V, truth = np.frombuffer(content, ">f8"), bench.truth[: len(content) // 8]
    begun_s = (truth["begin_ns"] - bench._on_ns) * 1e-9

    assert np.array_equal(read_V == value_V, (begun_s >= 10.0) & (begun_s < 12.0))
    assert np.count_nonzero(read_V == value_V) == 20
    assert int(line.query("STAT:QUES:EVEN?")) == bit


def test_a_small_memory_overflows_soon_and_the_truth_says_what_was_overwritten():
    bench, clock = bench_with(memory_readings=100)
    line = opened(bench)
    line.write(STREAM)
    clock.sleep(20.05)
    content, _ = line.query_block("R?", MOST)
    fates = bench.truth["fate"]

    assert len(content) == 800
    assert fates.tolist() == [Fate.OVERWRITTEN] * 101 + [Fate.TAKEN] * 100  # (20.05 - 0.02) / 0.1 + 1
    assert int(line.query("STAT:QUES:EVEN?")) == 1 << 14


def test_every_reading_has_one_fate_through_a_storm():
    faults = draw_faults(seed=4, count=300, length_s=3000.0, longest_s=10.0)
    bench, clock = bench_with(*faults, memory_readings=50)
    taken_V, line = [], opened(bench)
    while clock() - bench._on_ns < 3100e9:
        try:
            if not line.is_open:
                line = opened(bench)
            line.query(f"{STREAM};:SYST:ERR?")
            for _ in range(30):
                clock.sleep(1.0)
                content, _ = line.query_block("R?", MOST)
                taken_V.extend(np.frombuffer(content, ">f8"))
        except InstrumentError:
            line.close()
            clock.sleep(0.5)
    truth = bench.truth
    by_fate = {fate: truth["value_V"][truth["fate"] == fate] for fate in Fate}
    arrived = [value_V for value_V in taken_V if abs(value_V) < 12]

    assert {*arrived} <= {*by_fate[Fate.TAKEN]}  # what arrived was taken out, each once, and in order
    assert arrived == sorted({*arrived})
    assert all(by_fate[fate].size for fate in (Fate.TAKEN, Fate.OVERWRITTEN, Fate.CLEARED))
    assert np.array_equal(np.lexsort((truth["index"], truth["run"])), np.arange(truth.size))
    assert np.all(np.diff(truth["begin_ns"]) > 0)


def test_the_same_seed_makes_the_same_storm_and_it_has_every_kind():
    storm = draw_faults(seed=1, count=1000, length_s=86_400.0)

    assert storm == draw_faults(seed=1, count=1000, length_s=86_400.0)
    assert storm != draw_faults(seed=2, count=1000, length_s=86_400.0)
    assert len({fault.kind for fault in storm}) == 14
    assert [fault.at_s for fault in storm] == sorted(fault.at_s for fault in storm)


@pytest.mark.parametrize(
    "fields",
    [
        *({"kind": kind, "lasts_s": 0.0} for kind in READINGS),
        {"kind": "errors", "count": 0},
        {"kind": "length", "count": 0},
    ],
)
def test_a_fault_that_would_do_nothing_is_refused(fields):
    with pytest.raises(ValueError, match="fault"):
        Fault(at_s=1.0, **fields)
