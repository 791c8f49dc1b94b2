"""The meter: identify, configure, read back, stream, find again after a failure, give back.

The stream has no gaps because the meter paces and stores it by itself: its sample timer starts each reading, its
memory takes them (oldest overwritten when full, Questionable Data bit 14), and `R? n` takes out and erases the oldest
n while sampling goes on. One trigger gives SAMP:COUN readings, at most 50,000; TRIG:COUN INF starts the next at once,
and with it the timer anew (34410A manual, PRH 787, 795, 1791).
"""

import time
from collections.abc import Callable, Mapping
from math import inf, nan

import numpy as np
from numpy.typing import NDArray

from aemd.acquire.instrument import Clock, Drain, OtherInstrumentError, Recovery, RefusedError
from aemd.block import Status
from aemd.errors import InstrumentError
from agilent34410.busy import MEASURING_OR_WAITING, refuse_busy
from agilent34410.dialogue import Dialogue, is_no_error
from agilent34410.link import Link, open_link
from agilent34410.models import LACKING, MEMORY_READINGS
from agilent34410.options import Options

__all__ = ["Meter", "open_instrument"]

OVERLOAD_V = 9.9e37
"""What the meter sends, with the sign, of an input beyond 120 % of the range (PRH 651)."""

NOT_A_NUMBER_V = 9.91e37
"""What SCPI sends for what is not a number (SCPI-99, volume 1, 7.2.1.5)."""

AS_SENT = 1e-4  # both may have gone through single precision, which is 6e-8 off; they are 1e-3 apart

TIMING_VIOLATION = 1 << 2  # Questionable Data: a sample timer event came before the reading was done (PRH 1517)
MEMORY_OVERFLOW = 1 << 14  # Questionable Data: readings were overwritten; no error is queued (PRH 1791)

ERROR_QUEUE_ENTRIES = 20  # then the last becomes -350, so more questions than this find it empty
ERRORS_EVERY_NS = 1_000_000_000  # the queue is a second opinion: the stream's own faults are status bits


def open_instrument(
    resource: str,
    options: Options,
    clock: Clock,
    open_line: Callable[[], Link] | None = None,
    sleep: Callable[[float], None] = time.sleep,
) -> "Meter":
    """Open the link, make sure of the instrument, configure it and read everything back.

    Args:
        resource: the meter's VISA resource.
        options: its settings.
        clock: host monotonic time, ns.
        open_line: opens a line to it, now and after a failure; None for pyvisa's.
        sleep: waits so many seconds of `clock`, to see whether a meter that samples already is being read.

    Raises:
        InstrumentError: nobody answers, it is another instrument, another program is reading it, it refused a setting,
            or it cannot keep the interval.
    """

    def open_visa() -> Link:
        return open_link(resource, options.timeout_s, options.serial_line)

    opener = open_visa if open_line is None else open_line
    link = opener()
    try:
        if resource.upper().startswith("USB"):
            link.clear()  # a USB line keeps what a program that was killed had asked for, and gives it to the next
        answer = link.query("*IDN?")
        identity = _identify(answer, link.resource)
        refuse_busy(link, sleep)
        dialogue = Dialogue(opener, link, answer, salt=clock() // 1_000_000)
    except BaseException:
        link.close()  # and say nothing more to a stranger
        raise
    meter = Meter(dialogue, identity, MEMORY_READINGS[identity["model"]], options, clock, sleep)
    try:
        meter.configure()
    except BaseException:
        meter.close()
        raise
    return meter


class Meter:
    """A 34410A or one of its kin, as `aemd.acquire.instrument.Instrument`; made by `open_instrument`."""

    def __init__(
        self,
        dialogue: Dialogue,
        identity: Mapping[str, str],
        memory_readings: int,
        options: Options,
        clock: Clock,
        sleep: Callable[[float], None],
    ) -> None:
        self.identity = identity
        self.memory_readings = memory_readings
        self.settings: Mapping[str, str] = {}
        self.interval_s = 0.0
        self.sample_delay_s = 0.0
        self.epoch_readings = 0
        self._dialogue = dialogue
        self._options = options
        self._clock = clock
        self._sleep = sleep
        self._errors_asked_ns = 0
        self._settings_lost = False
        # What a look found and no Drain has told of yet: the question clears it in the meter, and the link may fail
        # before the readings of the same look are here.
        self._overflowed = False
        self._late = False
        self._messages: tuple[str, ...] = ()
        self._events_unseen = self._lost_events = False
        self._closed = False

    def configure(self) -> None:
        """Send every setting, read every one back, and refuse an interval that cannot be kept.

        Raises:
            InstrumentError: the meter refused a setting, or the interval is too short for its aperture.
        """
        options = self._options
        commands = _commands(options)
        # Of these *CLS would leave no trace, and one may be the meter's own complaint.
        self._messages += tuple(f"before it was set up: {message}" for message in self._take_errors())
        for command in commands:
            self._dialogue.command(command)
        answers = self._read_settings()
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
            InstrumentError: the meter refused, the link failed, or its settings were lost and do not come back.
        """
        if self._settings_lost:
            before = self.interval_s, self.epoch_readings
            self.configure()
            if before != (self.interval_s, self.epoch_readings):
                self.interval_s, self.epoch_readings = before
                raise InstrumentError(f"{self._dialogue.resource}: the meter does not take its settings again")
            self._settings_lost = False
        self._dialogue.ask("STAT:QUES:EVEN?")
        self._overflowed = self._late = self._events_unseen = self._lost_events = False
        self._dialogue.begin_journal()
        self._dialogue.command("ABOR")  # idle already, unless an earlier INIT was obeyed and its answer lost
        self._dialogue.command("INIT")

    def drain(self, most: int) -> Drain:
        """Take up to `most` readings out of the memory, oldest first.

        Raises:
            InstrumentError: the link failed, or the meter's answers contradict each other.
        """
        asked_ns = self._clock()
        if asked_ns - self._errors_asked_ns >= ERRORS_EVERY_NS:
            self._errors_asked_ns = asked_ns
            self._messages += self._take_errors()  # before the readings: these must not be lost with them
            asked_ns = self._clock()
        waiting = self._look()
        answered_ns = self._clock()
        count = min(most, waiting)
        values_V, status = _decode(self._dialogue.take(count) if count > 0 else b"")
        drain = Drain(
            values_V=values_V,
            status=status,
            waiting=waiting,
            asked_ns=asked_ns,
            answered_ns=answered_ns,
            received_ns=self._clock(),
            overflowed=self._overflowed,
            late=self._late,
            messages=self._messages,
        )
        self._overflowed = self._late = False
        self._messages = ()
        return drain

    def stop(self) -> None:
        """End sampling; the memory stays readable.

        Raises:
            InstrumentError: the link failed, or the meter is not ours to stop: another program took it over.
        """
        self._look()
        self._dialogue.command("ABOR")

    def recover(self, *, afresh: bool = False) -> Recovery:
        """Try the next rung of the ladder (`Dialogue.restore`), and look at what state the meter is in.

        Only questions are sent, which change nothing: above all no INIT, which would clear the memory. A meter that
        another program took over meanwhile is left to it for as long as it reads; then it must be set up again.

        Args:
            afresh: count the settings as lost.

        Raises:
            InstrumentError: not yet (`BusyError`: another program is reading it).
        """
        self._lost_events |= self._events_unseen
        self._events_unseen = False
        how = self._dialogue.restore()
        is_anothers = self._dialogue.is_anothers
        if is_anothers:
            self._dialogue.refuse_busy(self._sleep)
        condition = self._number({"COND": self._dialogue.ask("STAT:OPER:COND?")}, "COND", least=0.0)
        found, known = self._read_settings(), self.settings
        # The shortest interval depends on what the meter is doing; it is asked for once, to judge ours.
        kept = all(found[question] == known[question] for question in found if question != "SAMP:TIM? MIN")
        self._settings_lost |= afresh or is_anothers or self._dialogue.is_restarted or not kept
        return Recovery(
            sampling=bool(int(condition) & MEASURING_OR_WAITING) and not self._settings_lost,
            settings_kept=not self._settings_lost,
            torn=self._dialogue.take_torn(),
            how=how,
        )

    def close(self) -> None:
        """Stop, light the display, unlock the front panel, close the link; a dead link is no reason to complain.

        A meter that another program took over meanwhile is left as it is.
        """
        if self._closed:
            return
        self._closed = True
        self._dialogue.farewell("SYST:LOC")

    def _look(self) -> int:
        """Return how many readings wait, and keep in mind what else the look found."""
        self._events_unseen = True
        look = self._dialogue.look()
        # A memory that was full when an answer was lost is full still, and that answer may have told why.
        full = look.waiting >= self.memory_readings
        self._overflowed |= bool(look.questionable & MEMORY_OVERFLOW) or (full and self._lost_events)
        self._late |= bool(look.questionable & TIMING_VIOLATION)
        self._events_unseen = self._lost_events = False
        return look.waiting

    def _read_settings(self) -> dict[str, str]:
        return {question: self._dialogue.ask(question) for question in _questions(self._options)}

    def _take_errors(self) -> tuple[str, ...]:
        messages: list[str] = []
        for _ in range(ERROR_QUEUE_ENTRIES + 1):
            message = self._dialogue.ask("SYST:ERR?")
            if is_no_error(message):
                break
            messages.append(message)
        return tuple(messages)

    def _refuse_short_interval(self, aperture_s: float, source: str, autozero: bool, shortest_s: float) -> None:  # noqa: FBT001
        factor = 2 if autozero else 1
        needed_s = max(factor * aperture_s, shortest_s)
        if self.interval_s >= needed_s:
            return
        zero = " and its zero" if autozero else ""
        raise RefusedError(
            f"{self._dialogue.resource}: interval_s = {self.interval_s:g}: a reading{zero} takes {factor} x"
            f" {aperture_s * 1e3:g} ms ({source}), and the meter's least interval is {shortest_s * 1e3:g} ms;"
            f" ask for {needed_s:g} s or more, a shorter aperture{', or autozero off' if autozero else ''}"
        )

    def _number(self, answers: Mapping[str, str], question: str, least: float = 1e-9) -> float:
        try:
            number = float(answers[question])
        except ValueError:
            number = nan
        if not least <= number < inf:
            raise InstrumentError(
                f"{self._dialogue.resource}: {question}: the answer {answers[question]!r} is not a number above 0;"
                " switch the meter off and on"
            )
        return number


def _identify(answer: str, resource: str) -> dict[str, str]:
    fields = [field.strip() for field in answer.split(",")]
    model = fields[1] if len(fields) == 4 else ""
    if model in LACKING:
        raise OtherInstrumentError(
            f"{resource}: this is {answer!r}: {LACKING[model]}, so equal intervals without a gap cannot be had of it;"
            f" use one of {', '.join(MEMORY_READINGS)}",
            answer,
        )
    if model not in MEMORY_READINGS:
        raise OtherInstrumentError(
            f"{resource}: this is {answer!r}, not one of {', '.join(MEMORY_READINGS)}; check the address", answer
        )
    return {**dict(zip(("manufacturer", "model", "serial", "firmware"), fields, strict=True)), "resource": resource}


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


def _decode(block: bytes) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """Return values and status of big-endian REAL,64 readings, each shape (n,)."""
    values_V = np.frombuffer(block, dtype=">f8").astype(np.float64)
    status = np.zeros(values_V.size, dtype=np.uint32)
    status[values_V >= OVERLOAD_V * (1 - AS_SENT)] = Status.OVERLOAD_HIGH
    status[np.abs(values_V - NOT_A_NUMBER_V) <= NOT_A_NUMBER_V * AS_SENT] = Status.INVALID
    status[values_V <= -OVERLOAD_V * (1 - AS_SENT)] = Status.OVERLOAD_LOW
    status[~np.isfinite(values_V)] = Status.INVALID
    values_V[status != 0] = np.nan
    return values_V, status
