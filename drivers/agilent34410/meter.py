"""The dialogue with the meter: identify, configure, read back, stream, give back.

The stream has no gaps because the meter paces and stores it by itself: its sample timer starts each reading, its
memory takes them (oldest overwritten when full, Questionable Data bit 14), and `R? n` takes out and erases the oldest
n while sampling goes on. One trigger gives SAMP:COUN readings, at most 50,000; TRIG:COUN INF starts the next at once,
and with it the timer anew (34410A manual, PRH 787, 795, 1791).
"""

from collections.abc import Mapping
from contextlib import suppress
from math import inf, nan

import numpy as np
from numpy.typing import NDArray

from aemd.acquire.instrument import Clock, Drain
from aemd.block import Status
from aemd.errors import InstrumentError
from agilent34410.link import Link, open_link
from agilent34410.options import Options

__all__ = ["Meter", "open_instrument"]

MEMORY_READINGS = {"34410A": 50_000, "34411A": 1_000_000, "L4411A": 1_000_000, "34461A": 10_000, "34465A": 50_000}
"""Models that know every command used here, and the readings that their memory holds."""

OVERLOAD_V = 9.9e37
"""What the meter sends, with the sign, of an input beyond 120 % of the range (PRH 651)."""

TIMING_VIOLATION = 1 << 2  # Questionable Data: a sample timer event came before the reading was done (PRH 1517)
MEMORY_OVERFLOW = 1 << 14  # Questionable Data: readings were overwritten; no error is queued (PRH 1791)

ERROR_QUEUE_ENTRIES = 20  # then the last becomes -350, so more questions than this find it empty
ERRORS_EVERY_NS = 1_000_000_000  # the queue is a second opinion: the stream's own faults are status bits

LOOK = "DATA:POIN?;:STAT:QUES:EVEN?"
"""How many readings wait and what went wrong, in one exchange; asking for the event register clears it."""


def open_instrument(resource: str, options: Options, clock: Clock) -> "Meter":
    """Open the link, make sure of the instrument, configure it and read everything back.

    Raises:
        InstrumentError: nobody answers, it is another instrument, it refused a setting, or it cannot keep the interval.
    """
    link = open_link(resource, options.timeout_s)
    try:
        identity = _identify(link)
        memory_readings = MEMORY_READINGS[identity["model"]]
    except BaseException:
        link.close()  # and say nothing more to a stranger
        raise
    meter = Meter(link, identity, memory_readings, options, clock)
    try:
        meter.configure()
    except BaseException:
        meter.close()
        raise
    return meter


class Meter:
    """A 34410A or one of its kin, as `aemd.acquire.instrument.Instrument`; made by `open_instrument`."""

    def __init__(
        self, link: Link, identity: Mapping[str, str], memory_readings: int, options: Options, clock: Clock
    ) -> None:
        self.identity = identity
        self.memory_readings = memory_readings
        self.settings: Mapping[str, str] = {}
        self.interval_s = 0.0
        self.sample_delay_s = 0.0
        self.epoch_readings = 0
        self._link = link
        self._options = options
        self._clock = clock
        self._errors_asked_ns = 0
        self._closed = False

    def configure(self) -> None:
        """Send every setting, read every one back, and refuse an interval that cannot be kept.

        Raises:
            InstrumentError: the meter refused a setting, or the interval is too short for its aperture.
        """
        link, options = self._link, self._options
        commands = _commands(options)
        for command in commands:
            self._command(command)
        answers = {question: link.query(question) for question in _questions(options)}
        self.settings = {"commands": "; ".join(commands), **answers}
        self.interval_s = self._number(answers, "SAMP:TIM?")
        self.epoch_readings = int(self._number(answers, "SAMP:COUN?"))
        if options.aperture_s is None:
            cycles, line_Hz = self._number(answers, "VOLT:DC:NPLC?"), self._number(answers, "SYST:LFR?")
            aperture_s, source = cycles / line_Hz, f"{cycles:g} PLC at {line_Hz:g} Hz"
        else:
            aperture_s, source = self._number(answers, "VOLT:DC:APER?"), "aperture"
        autozero = options.autozero == "on"
        self._refuse_short_interval(aperture_s, source, autozero, self._number(answers, "SAMP:TIM? MIN"))
        # With autozero the zero is measured after the input and subtracted before the reading is stored.
        self.sample_delay_s = aperture_s * (1.5 if autozero else 0.5)

    def start(self) -> None:
        """Begin sampling; INIT clears the memory, the question before it the events of an earlier stream.

        Raises:
            InstrumentError: the meter refused, or the link failed.
        """
        self._link.query("STAT:QUES:EVEN?")
        self._command("INIT")

    def drain(self, most: int) -> Drain:
        """Take up to `most` readings out of the memory, oldest first.

        Raises:
            InstrumentError: the link failed, or the meter's answers contradict each other.
        """
        asked_ns = self._clock()
        answer = self._link.query(LOOK)
        answered_ns = self._clock()
        waiting, questionable = self._integers(answer)
        count = min(most, waiting)
        values_V, status = self._take(count) if count > 0 else _decode(b"")
        received_ns = self._clock()
        return Drain(
            values_V=values_V,
            status=status,
            waiting=waiting,
            asked_ns=asked_ns,
            answered_ns=answered_ns,
            received_ns=received_ns,
            overflowed=bool(questionable & MEMORY_OVERFLOW),
            late=bool(questionable & TIMING_VIOLATION),
            messages=self._errors_if_due(received_ns),
        )

    def stop(self) -> None:
        """End sampling; the memory stays readable.

        Raises:
            InstrumentError: the link failed.
        """
        self._command("ABOR")

    def close(self) -> None:
        """Stop, light the display, unlock the front panel, close the link; a dead link is no reason to complain."""
        if self._closed:
            return
        self._closed = True
        with suppress(InstrumentError):
            self._link.query("ABOR;:DISP ON;*OPC?")  # the answer tells that it was heard before the link goes
            self._link.write("SYST:LOC")
        self._link.close()

    def _command(self, command: str) -> None:
        refusal = self._link.query(f"{command};:SYST:ERR?")
        if not _is_no_error(refusal):
            raise InstrumentError(f"{self._link.resource}: {command}: the meter refused: {refusal}; see its manual")

    def _take(self, count: int) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
        block = self._link.query_block(f"R? {count}")
        if len(block) != 8 * count:
            raise InstrumentError(
                f"{self._link.resource}: R? {count}: {len(block)} bytes came instead of {8 * count};"
                " is another program reading the meter's memory? close it and start again"
            )
        return _decode(block)

    def _errors_if_due(self, now_ns: int) -> tuple[str, ...]:
        if now_ns - self._errors_asked_ns < ERRORS_EVERY_NS:
            return ()
        self._errors_asked_ns = now_ns
        messages: list[str] = []
        for _ in range(ERROR_QUEUE_ENTRIES + 1):
            message = self._link.query("SYST:ERR?")
            if _is_no_error(message):
                break
            messages.append(message)
        return tuple(messages)

    def _refuse_short_interval(self, aperture_s: float, source: str, autozero: bool, shortest_s: float) -> None:  # noqa: FBT001
        factor = 2 if autozero else 1
        needed_s = max(factor * aperture_s, shortest_s)
        if self.interval_s >= needed_s:
            return
        zero = " and its zero" if autozero else ""
        raise InstrumentError(
            f"{self._link.resource}: interval_s = {self.interval_s:g}: a reading{zero} takes {factor} x"
            f" {aperture_s * 1e3:g} ms ({source}), and the meter's least interval is {shortest_s * 1e3:g} ms;"
            f" ask for {needed_s:g} s or more, a shorter aperture{', or autozero off' if autozero else ''}"
        )

    def _number(self, answers: Mapping[str, str], question: str) -> float:
        try:
            number = float(answers[question])
        except ValueError:
            number = nan
        if not 0 < number < inf:
            raise InstrumentError(
                f"{self._link.resource}: {question}: the answer {answers[question]!r} is not a number above 0;"
                " switch the meter off and on"
            )
        return number

    def _integers(self, answer: str) -> tuple[int, int]:
        try:
            waiting, questionable = (int(float(field)) for field in answer.split(";"))
            if waiting < 0 or questionable < 0:
                raise ValueError(answer)  # noqa: TRY301 - one message for every kind of nonsense
        except (ValueError, OverflowError) as error:
            raise InstrumentError(
                f"{self._link.resource}: {LOOK}: the answer {answer!r} is not two numbers; start again"
            ) from error
        return waiting, questionable


def _identify(link: Link) -> dict[str, str]:
    answer = link.query("*IDN?")
    fields = [field.strip() for field in answer.split(",")]
    if len(fields) != 4 or fields[1] not in MEMORY_READINGS:
        raise InstrumentError(
            f"{link.resource}: this is {answer!r}, not one of {', '.join(MEMORY_READINGS)}; check the address"
        )
    return {
        **dict(zip(("manufacturer", "model", "serial", "firmware"), fields, strict=True)),
        "resource": link.resource,
    }


def _commands(options: Options) -> list[str]:
    """Return the set-up in the order in which it must come: CONF resets the trigger settings, so it is first."""
    return [
        "*CLS",
        "ABOR",
        "*RST",
        f"CONF:VOLT:DC {options.range_V:g}",
        "VOLT:DC:RANG:AUTO OFF",
        f"VOLT:DC:NPLC {options.nplc:g}" if options.aperture_s is None else f"VOLT:DC:APER {options.aperture_s:.9g}",
        f"VOLT:DC:ZERO:AUTO {options.autozero.upper()}",
        f"VOLT:DC:IMP:AUTO {'ON' if options.input_impedance_auto else 'OFF'}",
        "TRIG:SOUR IMM",
        "TRIG:DEL:AUTO ON" if options.trigger_delay_s is None else f"TRIG:DEL {options.trigger_delay_s:.9g}",
        "TRIG:COUN INF",
        "SAMP:SOUR TIM",
        f"SAMP:TIM {options.interval_s:.9g}",
        "SAMP:COUN MAX",
        "FORM:DATA REAL,64",
        "FORM:BORD NORM",
        f"DISP {'ON' if options.display else 'OFF'}",
    ]


def _questions(options: Options) -> list[str]:
    """Return what is read back. Only documented questions: an unknown one can silence a meter for good."""
    return [
        "FUNC?",
        "VOLT:DC:RANG?",
        "VOLT:DC:NPLC?" if options.aperture_s is None else "VOLT:DC:APER?",
        "VOLT:DC:ZERO:AUTO?",
        "VOLT:DC:IMP:AUTO?",
        "TRIG:SOUR?",
        "TRIG:DEL?",
        "TRIG:COUN?",
        "SAMP:SOUR?",
        "SAMP:TIM?",
        "SAMP:TIM? MIN",
        "SAMP:COUN?",
        "FORM:DATA?",
        "FORM:BORD?",
        "SYST:LFR?",
    ]


def _is_no_error(answer: str) -> bool:
    return answer.lstrip("+").startswith("0,")


def _decode(block: bytes) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """Return values and status of big-endian REAL,64 readings, each shape (n,)."""
    values_V = np.frombuffer(block, dtype=">f8").astype(np.float64)
    status = np.zeros(values_V.size, dtype=np.uint32)
    status[values_V >= OVERLOAD_V] = Status.OVERLOAD_HIGH
    status[values_V <= -OVERLOAD_V] = Status.OVERLOAD_LOW
    status[~np.isfinite(values_V)] = Status.INVALID
    values_V[status != 0] = np.nan
    return values_V, status
