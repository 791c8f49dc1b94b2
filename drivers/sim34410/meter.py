"""The simulated meter: trigger system, reading memory and status on a clock that is an argument.

Nothing runs: readings are made, all at once, when somebody asks what there is by now. So a meter that nobody asks costs
nothing, 10,000 readings a second cost a few array operations per question, and a test moves a day in one step.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sim34410.converter import OVERLOAD_V, Converter, Input
from sim34410.memory import ReadingMemory
from sim34410.schedule import Schedule
from sim34410.settings import Settings
from sim34410.status import ErrorQueue, EventRegister, ScpiError, standard_event_bit
from sim34410.truth import TruthLog

__all__ = ["Display", "Meter", "MeterProperties"]

_CHUNK = 65_536
"""Readings made at a time, which bounds the memory that a long absence costs."""

_VOLTAGE_OVERLOAD, _TIMING_VIOLATION, _MEMORY_OVERFLOW = 1 << 0, 1 << 2, 1 << 14
_MEASURING, _WAITING, _THRESHOLD = 1 << 4, 1 << 5, 1 << 9


@dataclass(frozen=True, slots=True)
class MeterProperties:
    """What belongs to one meter and its bench, and no command changes."""

    identity: str = "Agilent Technologies,34410A,MY47006594,2.35-2.35-0.09-46-09"
    line_frequency_hz: float = 50.0
    seed: int = 1
    clock_error_ppm: float = 0.0
    """How much the meter's clock runs fast."""
    noise: bool = True
    """Whether the meter adds its own noise and offset drift."""
    truth_readings: int = 0
    """How many of the last readings' truth is kept."""


@dataclass(slots=True)
class Display:
    """The front panel."""

    on: bool = True
    text: dict[str, str] = field(default_factory=lambda: {"1": "", "2": ""})
    """Of each window; empty while it shows readings."""


class Meter:
    """One 34410A measuring DC volts. Not thread-safe: one thread speaks to it."""

    def __init__(self, source: Input, clock: Callable[[], int], properties: MeterProperties | None = None) -> None:
        self.properties = properties or MeterProperties()
        self.settings = Settings()
        self.errors = ErrorQueue()
        self.memory = ReadingMemory()
        self.questionable = EventRegister()
        self.operation = EventRegister()
        self.standard_event = 128  # power on
        self.standard_event_enable = 0
        self.service_request_enable = 0
        self.power_on_clear = 1
        self.memory_threshold = 1
        self.data_format = "ASC,8"
        self.byte_order = "NORM"
        self.display = Display()
        self._clock = clock
        self._power_on_ns = clock()
        self._rate = 1 + self.properties.clock_error_ppm * 1e-6
        self._converter = Converter(source, self.properties.seed, noise=self.properties.noise)
        self._schedule: Schedule | None = None
        self._made = 0
        self._index = 0
        self._late = False
        self._triggers_left = 0.0
        self._announce_completion = False
        self._truth = TruthLog(self.properties.truth_readings)

    # -- state -------------------------------------------------------------------------------------------------------

    @property
    def state(self) -> Literal["idle", "waiting", "measuring"]:
        """Of the trigger system, now."""
        self.advance()
        if self._schedule is not None:
            return "measuring"
        return "waiting" if self._triggers_left else "idle"

    @property
    def truth(self) -> NDArray[np.void]:
        """Array of TRUTH (n,): of the last `truth_readings` readings. Not to be asked while the meter is served."""
        self.advance()
        return self._truth.rows

    @property
    def idle_at_ns(self) -> int | None:
        """Host instant at which the readings under way are finished; None where there are none or they have no end."""
        if self._schedule is None or self._schedule.end_ns is None:
            return None
        return self._host_ns(self._schedule.end_ns) + 1

    @property
    def status_byte(self) -> int:
        """The answer to *STB?."""
        self.advance()
        byte = 4 * bool(len(self.errors)) | 8 * self.questionable.summary | 128 * self.operation.summary
        byte |= 32 * bool(self.standard_event & self.standard_event_enable)
        return byte | 64 * bool(byte & self.service_request_enable)

    @property
    def line_frequency_hz(self) -> float:
        """Hz."""
        return self.properties.line_frequency_hz

    # -- commands ----------------------------------------------------------------------------------------------------

    def report(self, code: int) -> None:
        """Put an error into the queue and set its bit in the Standard Event register."""
        self.errors.push(code)
        self.standard_event |= standard_event_bit(code)

    def configure(self, settings: Settings) -> None:
        """Replace the settings, and abort what is under way.

        A change of the measurement itself, rather than of the trigger system, also clears the memory and has a new zero
        taken.
        """
        self.abort()
        if not settings.measures_alike(self.settings):
            self.memory.clear()
            self._converter.take_zero()
        self.settings = settings

    def change(self, **fields: Any) -> None:
        """Replace these fields of the settings."""
        self.advance()  # autorange may move the range until now
        self.configure(replace(self.settings, **fields))

    def take_zero(self) -> None:
        """Measure the offset once, with the next reading, and subtract it from then on (autozero OFF or ONCE)."""
        self._converter.take_zero()

    def initiate(self) -> None:
        """Leave idle: clear the memory, and measure as soon as the trigger comes.

        Raises:
            ScpiError: -213 when not idle.
        """
        if self.state != "idle":
            raise ScpiError(-213)
        self.memory.clear()
        self.questionable.become(0)
        self._index = 0
        self._triggers_left = self.settings.trigger_count
        if self.settings.trigger_source == "IMM":
            self._start(None if self._triggers_left == inf else int(self._triggers_left))
        self._show_state()

    def trigger(self) -> None:
        """Take the trigger of *TRG.

        Raises:
            ScpiError: -211 when no such trigger is awaited.
        """
        if self.state != "waiting" or self.settings.trigger_source != "BUS":
            raise ScpiError(-211)
        self._start(1)
        self._show_state()

    def abort(self) -> None:
        """Go idle; what is in the memory stays."""
        self.advance()
        self._schedule = None
        self._triggers_left = 0
        self._show_state()

    def announce_completion(self) -> None:
        """Set bit 0 of the Standard Event register when idle (*OPC)."""
        self._announce_completion = True
        self._show_state()

    def reset(self) -> None:
        """Do what *RST does: abort, default settings, empty memory."""
        self._announce_completion = False
        self.configure(Settings())
        self.memory.clear()
        self.data_format, self.byte_order = "ASC,8", "NORM"
        self.display = Display()

    def clear_status(self) -> None:
        """Do what *CLS does: empty the error queue and the event registers."""
        self.advance()
        self._announce_completion = False
        self.errors.clear()
        self.questionable.take()
        self.operation.take()
        self.standard_event = 0

    def take_standard_event(self) -> int:
        """Return the Standard Event register and clear it (*ESR?)."""
        self.advance()
        event, self.standard_event = self.standard_event, 0
        return event

    # -- readings ----------------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Make the readings that are finished by now."""
        while self._schedule is not None:
            schedule = self._schedule
            finished = schedule.finished(self._now_ns())
            last = min(finished, self._made + _CHUNK)
            if last > self._made:
                self._make(schedule, self._made, last)
                self._made = last
            if last == schedule.total:
                self._schedule = None
            if last == finished:
                break
        self._show_state()

    def _start(self, triggers: int | None) -> None:
        settings, line_hz = self.settings, self.line_frequency_hz
        reading_ns, delay_ns = settings.reading_ns(line_hz), settings.delay_ns(line_hz)
        asked_ns = settings.timer_ns if settings.sample_source == "TIM" else reading_ns + delay_ns
        self._late = asked_ns < reading_ns and settings.sample_count > 1
        self._schedule = Schedule(
            first_ns=self._now_ns(),
            delay_ns=delay_ns,
            interval_ns=max(asked_ns, reading_ns),
            reading_ns=reading_ns,
            samples=settings.sample_count,
            triggers=triggers,
        )
        self._made = 0
        self._triggers_left = 0 if triggers is None else self._triggers_left - triggers

    def _make(self, schedule: Schedule, first: int, last: int) -> None:
        begin_ns = schedule.begin_ns(first, last)
        aperture_ns = self.settings.aperture_ns(self.line_frequency_hz)
        second = 1e-9 / self._rate
        begin_s, aperture_s = np.asarray(begin_ns * second, dtype=np.float64), aperture_ns * second
        made = self._converter.convert(begin_s, aperture_s, self.settings.cycles(self.line_frequency_hz), self.settings)
        if made.range_V != self.settings.range_V:
            self.settings = replace(self.settings, range_V=made.range_V)
        if self._late:
            self.questionable.happened(_TIMING_VIOLATION)
        if np.any(np.abs(made.value_V) == OVERLOAD_V):
            self.questionable.happened(_VOLTAGE_OVERLOAD)
        if self.memory.append(made.value_V):
            self.questionable.happened(_MEMORY_OVERFLOW)
        begin_host_ns = self._power_on_ns + np.rint(begin_ns / self._rate).astype(np.int64)
        self._truth.append(self._index, begin_host_ns, aperture_ns, made.truth, made.value_V)
        self._index += last - first

    # -- clock and status --------------------------------------------------------------------------------------------

    def _now_ns(self) -> int:
        elapsed_ns = self._clock() - self._power_on_ns
        return elapsed_ns + round(elapsed_ns * (self._rate - 1))

    def _host_ns(self, meter_ns: int) -> int:
        return self._power_on_ns + round(meter_ns / self._rate)

    def _show_state(self) -> None:
        """Bring the Standard Operation condition and *OPC up to date."""
        measuring = self._schedule is not None
        waiting = not measuring and bool(self._triggers_left)
        full = len(self.memory) >= self.memory_threshold
        self.operation.become(_MEASURING * measuring | _WAITING * waiting | _THRESHOLD * full)
        if self._announce_completion and not measuring and not waiting:
            self._announce_completion = False
            self.standard_event |= 1
