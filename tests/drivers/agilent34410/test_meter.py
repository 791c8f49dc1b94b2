import re
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

import agilent34410
import sim34410
from aemd.acquire.instrument import Driver, Instrument, find_driver
from aemd.block import Status
from aemd.errors import InstrumentError
from agilent34410 import Options
from agilent34410.meter import _decode as decode
from tests.drivers.agilent34410.bench import FAST, HandClock, Ramp, served, stranger, unused_resource

PATIENT = Options(timeout_s=60.0)


@contextmanager
def started(
    options: Options, source: Ramp | None = None, **properties: Any
) -> Iterator[tuple[Instrument, sim34410.Meter, HandClock]]:
    """Open the driver on a simulated meter, both on one clock that stands still, and begin sampling."""
    clock = HandClock()
    with (
        served(clock, source, **properties) as (resource, meter),
        # However slow the machine, an answer is waited for.
        closing(agilent34410.open_instrument(resource, replace(options, timeout_s=60.0), clock)) as instrument,
    ):
        instrument.start()
        yield instrument, meter, clock


def test_the_driver_is_found_by_its_entry_point() -> None:
    driver: Driver = cast("Driver", agilent34410)

    assert find_driver("agilent34410") is driver


def test_the_identity_and_every_setting_are_read_back_from_the_meter() -> None:
    options = Options(range_V=1, nplc=0.2, autozero="once", input_impedance_auto=False, trigger_delay_s=0.25)
    with started(replace(options, interval_s=0.02001), line_frequency_hz=60.0) as (instrument, _, _):
        assert dict(instrument.identity) | {"resource": ""} == {
            "manufacturer": "Agilent Technologies",
            "model": "34410A",
            "serial": "MY47006594",
            "firmware": "2.35-2.35-0.09-46-09",
            "resource": "",
        }
        answers = dict(instrument.settings)
        assert "SAMP:TIM 0.02001" in answers.pop("commands").split("; ")
        numbers = {question: float(answers.pop(question)) for question in list(answers) if answers[question][0] in "+-"}
        assert numbers.pop("SAMP:TIM? MIN") <= 0.02
        assert numbers == pytest.approx(
            {
                "VOLT:DC:RANG?": 1.0,
                "VOLT:DC:NPLC?": 0.2,
                "TRIG:DEL?": 0.25,
                "TRIG:COUN?": 9.9e37,
                "SAMP:TIM?": 0.02002,  # on the meter's grid of 20 us
                "SAMP:COUN?": 50_000,
                "SYST:LFR?": 60.0,
            }
        )
        assert answers == {
            "FUNC?": '"VOLT"',
            "VOLT:DC:ZERO:AUTO?": "0",
            "VOLT:DC:IMP:AUTO?": "0",
            "TRIG:SOUR?": "IMM",
            "SAMP:SOUR?": "TIM",
            "FORM:DATA?": "REAL,64",
            "FORM:BORD?": "NORM",
        }
        assert instrument.interval_s == pytest.approx(0.02002)
        assert instrument.epoch_readings == 50_000
        assert instrument.memory_readings == 50_000


@pytest.mark.parametrize(
    ("options", "aperture_s", "delay_s"),
    [
        (Options(nplc=1, autozero="on"), 0.02, 0.03),  # half the aperture, and a zero as long as the aperture
        (Options(nplc=1, autozero="off"), 0.02, 0.01),
        (Options(aperture_s=0.004, autozero="off"), 0.004, 0.002),
    ],
)
def test_a_reading_is_in_the_memory_its_stated_delay_after_the_middle_of_its_aperture(
    options: Options, aperture_s: float, delay_s: float
) -> None:
    with started(options) as (instrument, meter, clock):
        clock.move(1.0)
        next_index = meter.truth.size
        middle_ns = meter.truth["begin_ns"][0] + round((aperture_s / 2 + next_index * instrument.interval_s) * 1e9)
        clock.now_ns = int(middle_ns) + round(instrument.sample_delay_s * 1e9)

        clock.move(-2e-6)
        assert instrument.drain(0).waiting == next_index
        clock.move(4e-6)
        assert instrument.drain(0).waiting == next_index + 1
        assert instrument.sample_delay_s == pytest.approx(delay_s)


def test_drained_readings_are_the_meters_own_bit_for_bit_oldest_first() -> None:
    with started(FAST) as (instrument, meter, clock):
        clock.move(0.5)
        first = instrument.drain(3000)
        clock.move(0.1)
        second = instrument.drain(10_000)
        truth_V = meter.truth["value_V"]

        assert first.waiting == pytest.approx(5000, abs=20)
        assert first.values_V.size == 3000
        assert second.waiting == second.values_V.size == truth_V.size - 3000
        assert np.concatenate((first.values_V, second.values_V)).tobytes() == truth_V.tobytes()
        assert not first.overflowed
        assert not first.late


def test_an_empty_memory_is_an_empty_drain() -> None:
    with started(Options()) as (instrument, _, _):
        drain = instrument.drain(100)

        assert drain.values_V.size == drain.status.size == drain.waiting == 0


def test_an_overload_is_nan_with_its_sign_in_the_status() -> None:
    with started(Options(), Ramp(high_s=(2.0, 3.0), low_s=(4.0, 5.0))) as (instrument, meter, clock):
        clock.move(6.0)
        drain = instrument.drain(1000)
        truth_V = meter.truth["value_V"]

        assert np.array_equal(drain.status == Status.OVERLOAD_HIGH, truth_V == 9.9e37)
        assert np.array_equal(drain.status == Status.OVERLOAD_LOW, truth_V == -9.9e37)
        assert np.array_equal(np.isnan(drain.values_V), drain.status != 0)
        assert set(drain.status.tolist()) == {0, Status.OVERLOAD_HIGH, Status.OVERLOAD_LOW}


def test_a_memory_that_overflowed_is_told_of_once() -> None:
    with started(FAST) as (instrument, _, clock):
        clock.move(6.0)
        first = instrument.drain(50_000)
        clock.move(0.1)
        second = instrument.drain(50_000)

        assert first.overflowed
        assert first.waiting == 50_000
        assert not second.overflowed


def test_what_an_earlier_stream_lost_is_not_told_of_the_next() -> None:
    with started(FAST) as (instrument, _, clock):
        clock.move(6.0)
        instrument.stop()
        instrument.start()

        assert not instrument.drain(1).overflowed


def test_an_interval_that_was_not_kept_is_told_of_once() -> None:
    with started(FAST) as (instrument, meter, _):
        meter.questionable.happened(1 << 2)

        assert [instrument.drain(1).late for _ in range(2)] == [True, False]


def test_errors_in_the_meters_queue_are_brought_along_once_a_second() -> None:
    with started(Options()) as (instrument, meter, clock):
        instrument.drain(1)
        meter.report(-113)
        clock.move(0.5)
        soon = instrument.drain(1)
        clock.move(0.6)
        later = instrument.drain(1)

        assert soon.messages == ()
        assert later.messages == ('-113,"Undefined header"',)


def test_errors_that_an_earlier_program_left_are_told_of_though_the_set_up_clears_them() -> None:
    clock = HandClock()
    with served(clock) as (resource, meter):
        meter.report(-113)
        with closing(agilent34410.open_instrument(resource, PATIENT, clock)) as instrument:
            instrument.start()

            assert instrument.drain(1).messages == ('before it was set up: -113,"Undefined header"',)
            assert instrument.drain(1).messages == ()


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        (9.9e37, Status.OVERLOAD_HIGH),
        (-9.9e37, Status.OVERLOAD_LOW),
        (9.91e37, Status.INVALID),
        (float("inf"), Status.INVALID),
        (float("nan"), Status.INVALID),
    ],
)
@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_what_is_no_value_is_known_though_it_went_through_single_precision(
    sent: float, status: Status, precision: type[np.floating[Any]]
) -> None:
    values_V, found = decode(np.array([1.0, precision(sent)], dtype=">f8").tobytes())

    assert found.tolist() == [0, status]
    assert values_V[0] == 1.0
    assert np.isnan(values_V[1])


def test_stopping_keeps_the_rest_in_the_memory_to_be_drained() -> None:
    with started(Options()) as (instrument, _, clock):
        clock.move(1.0)
        instrument.stop()
        clock.move(1.0)

        assert instrument.drain(1000).values_V.size == pytest.approx(1 / 0.06712, abs=1)


def test_closing_stops_the_meter_and_lights_its_display() -> None:
    with served() as (resource, meter):
        instrument = agilent34410.open_instrument(resource, replace(FAST, timeout_s=60.0), HandClock())
        instrument.start()
        assert not meter.display.on
        instrument.close()
        instrument.close()

        assert meter.display.on
        assert meter.state == "idle"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            Options(nplc=2, interval_s=1 / 15),
            "interval_s = 0.06668: a reading and its zero takes 2 x 40 ms (2 PLC at 50 Hz), and the meter's least"
            " interval is 80 ms; ask for 0.08 s or more, a shorter aperture, or autozero off",
        ),
        (
            Options(aperture_s=0.1, autozero="off", display=False),
            "interval_s = 0.06712: a reading takes 1 x 100 ms (aperture), and the meter's least interval is 100 ms;"
            " ask for 0.1 s or more, a shorter aperture",
        ),
    ],
)
def test_an_interval_that_cannot_be_kept_is_refused_with_the_arithmetic(options: Options, message: str) -> None:
    with served() as (resource, meter), pytest.raises(InstrumentError) as caught:
        agilent34410.open_instrument(resource, replace(options, timeout_s=60.0), HandClock())

    assert str(caught.value) == f"{resource}: {message}"
    assert meter.display.on


def test_a_setting_that_the_meter_refuses_is_named_with_the_meters_words() -> None:
    # The bound of the option is the 34411A's; a 34410A has no aperture below 100 us.
    with (
        served() as (resource, _),
        pytest.raises(InstrumentError, match=r"VOLT:DC:APER 2e-05: the meter refused: -222"),
    ):
        agilent34410.open_instrument(resource, replace(PATIENT, aperture_s=20e-6), HandClock())


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        ("HEWLETT-PACKARD,34401A,0,11-5-2", "it has no sample timer (SAMP:TIM) and cannot give out readings while"),
        ("Keysight Technologies,DSOX1102G,CN1,1", "not one of 34410A, 34411A, L4411A, 34465A"),
        ("hello", "not one of"),
    ],
)
def test_another_instrument_is_refused_by_name_and_told_nothing_more(answer: str, why: str) -> None:
    heard: list[bytes] = []

    def reply(line: bytes) -> bytes:
        heard.append(line)
        return answer.encode() + b"\n"

    with (
        stranger(reply) as resource,
        pytest.raises(InstrumentError, match=re.escape(f"this is '{answer}'") + ".*" + re.escape(why)),
    ):
        agilent34410.open_instrument(resource, PATIENT, HandClock())
    assert heard == [b"*IDN?"]


def test_nobody_and_silence_are_refused_within_the_timeout() -> None:
    options = Options(timeout_s=0.2)
    with pytest.raises(InstrumentError, match="refused"):
        agilent34410.open_instrument(unused_resource(), options, HandClock())
    with stranger(lambda line: b"") as resource, pytest.raises(InstrumentError, match=r"no whole answer within 0\.2 s"):
        agilent34410.open_instrument(resource, options, HandClock())


def test_readings_that_another_program_took_are_an_error_not_a_wrong_index() -> None:
    with started(Options()) as (instrument, meter, clock):
        clock.move(1.0)
        take, meter.memory.take = meter.memory.take, lambda most: take(most - 1)

        with pytest.raises(InstrumentError, match="R\\? 15: 112 bytes came instead of 120; is another program"):
            instrument.drain(15)
