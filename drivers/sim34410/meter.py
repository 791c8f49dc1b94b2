"""The simulated meter: trigger system, reading memory and status on a clock that is an argument.

Nothing runs: readings are made, all at once, when somebody asks what there is by now. So a meter that nobody asks costs
nothing, 10,000 readings a second cost a few array operations per question, and a test moves a day in one step.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sim34410.clock import DeviceClock
from sim34410.converter import OVERLOAD_V, Converter, Input
from sim34410.family import member
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
    """How much the meter's clock runs fast; this and the next three are those of `DeviceClock`."""
    clock_drift_ppm_per_day: float = 0.0
    clock_wander_ppm: float = 0.0
    clock_wander_period_s: float = 86_400.0
    memory_readings: int | None = None
    """Size of the reading memory, where it is not the model's."""
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
        self.member = member(self.properties.identity)
        self.memory = ReadingMemory(self.properties.memory_readings or self.member.memory_readings)
        self.disturb: Callable[[NDArray[np.int64], NDArray[np.float64]], NDArray[np.float64]] = lambda _, value_V: (
            value_V
        )
        """What happens to readings, V, whose apertures begin at these host instants, ns, before they are stored."""
        self.errors = ErrorQueue()
        self.questionable = EventRegister()
        self.operation = EventRegister()
        self._clock = clock
        self._held_ns: int | None = None
        self._first_on_ns = clock()
        self._device_clock = DeviceClock(
            self.properties.clock_error_ppm,
            self.properties.clock_drift_ppm_per_day,
            self.properties.clock_wander_ppm,
            self.properties.clock_wander_period_s,
        )
        self._converter = Converter(source, self.properties.seed, noise=self.properties.noise)
        self._schedule: Schedule | None = None
        self._triggers_left = 0.0
        self._made = 0
        self._run = 0
        self._index = 0
        self._late = False
        self._truth = TruthLog(self.properties.truth_readings)
        self._power_on()

    def _power_on(self) -> None:
        self.settings: Settings = Settings()
        self.errors.clear()
        self.questionable.reset()
        self.operation.reset()
        self.standard_event = 128  # power on
        self.standard_event_enable = 0
        self.service_request_enable = 0
        self.power_on_clear = 1
        self.memory_threshold = 1
        self.data_format = "ASC,8"
        self.byte_order = "NORM"
        self.display = Display()
        self._announce_completion = False

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
        """Array of TRUTH (n,): of the last `truth_readings` readings. Of a meter that is served, ask its `Bench`."""
        self.advance()
        return self._truth.rows(self.memory.fates)

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

    def clear_device(self) -> None:
        """Do what the bus message Device Clear does: go idle, without the end that *OPC waits for.

        Status registers, error queue and settings stay (Truevolt guide, page 104; 34420A user's guide, page 203, which
        adds Ctrl-C for RS-232); the buffers that it empties belong to the session.
        """
        self._announce_completion = False
        self.abort()

    def switch_off_and_on(self) -> None:
        """Lose power: settings, registers, error queue and readings are gone."""
        self.clear_device()
        self.memory.clear()
        self._power_on()
        self._converter.take_zero()
        self._show_state()

    @contextmanager
    def at(self, instant_ns: int) -> Iterator[None]:
        """While inside, it is this host instant for the meter: for what happened while nobody looked."""
        self._held_ns, before_ns = instant_ns, self._held_ns
        try:
            yield
        finally:
            self._held_ns = before_ns

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
        self._run += 1
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
        begin_host_ns = self._device_clock.host_ns(begin_ns)
        begin_s = np.asarray(begin_host_ns * 1e-9, dtype=np.float64)
        aperture_s = aperture_ns * 1e-9 / (1 + 1e-6 * self.properties.clock_error_ppm)
        made = self._converter.convert(begin_s, aperture_s, self.settings.cycles(self.line_frequency_hz), self.settings)
        if made.range_V != self.settings.range_V:
            self.settings = replace(self.settings, range_V=made.range_V)
        if self._late:
            self.questionable.happened(_TIMING_VIOLATION)
        begin_host_ns += self._first_on_ns
        value_V = self.disturb(begin_host_ns, made.value_V)
        if np.any(np.abs(value_V) == OVERLOAD_V):
            self.questionable.happened(_VOLTAGE_OVERLOAD)
        if self.memory.append(value_V):
            self.questionable.happened(_MEMORY_OVERFLOW)
        self._truth.append(self._run, self._index, begin_host_ns, aperture_ns, made.truth, value_V)
        self._index += last - first

    # -- clock and status --------------------------------------------------------------------------------------------

    def _now_ns(self) -> int:
        host_ns = self._clock() if self._held_ns is None else self._held_ns
        return self._device_clock.meter_ns(host_ns - self._first_on_ns)

    def _host_ns(self, meter_ns: int) -> int:
        return self._first_on_ns + int(self._device_clock.host_ns(np.asarray([meter_ns]))[0])

    def _show_state(self) -> None:
        """Bring the Standard Operation condition and *OPC up to date."""
        measuring = self._schedule is not None
        waiting = not measuring and bool(self._triggers_left)
        full = len(self.memory) >= self.memory_threshold
        self.operation.become(_MEASURING * measuring | _WAITING * waiting | _THRESHOLD * full)
        if self._announce_completion and not measuring and not waiting:
            self._announce_completion = False
            self.standard_event |= 1
