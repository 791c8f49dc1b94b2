"""The simulated meter: trigger system, reading memory and status on a clock that is an argument.

Nothing runs: readings are made, all at once, when somebody asks what there is by now. So a meter that nobody asks costs
nothing, 10,000 readings a second cost a few array operations per question, and a test moves a day in one step.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from math import inf
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from aemd.model import GaussMarkov, Truth
from sim34410.memory import ReadingMemory
from sim34410.noise import RANGES_V, noise_sd
from sim34410.schedule import Schedule
from sim34410.settings import Settings
from sim34410.status import ErrorQueue, EventRegister, ScpiError, standard_event_bit

__all__ = ["OVERLOAD_V", "TRUTH", "Input", "Meter", "MeterProperties"]

OVERLOAD_V = 9.9e37
"""What the meter answers beyond its range, with the sign of the input."""

TRUTH = np.dtype(
    [("index", "<i8"), ("begin_ns", "<i8"), ("aperture_ns", "<i8")]
    + [(name, "<f8") for name in ("signal_V", "internal_V", "external_V", "noise_V", "value_V")]
)
"""What a reading was made of: its number since INITiate, the host's instant at which its aperture began and the
aperture's length, the input's means over it by role, and the value in the memory."""

_CHUNK = 65_536
"""Readings made at a time, which bounds the memory that a long absence costs."""

_VOLTAGE_OVERLOAD, _TIMING_VIOLATION, _MEMORY_OVERFLOW = 1 << 0, 1 << 2, 1 << 14
_MEASURING, _WAITING, _THRESHOLD = 1 << 4, 1 << 5, 1 << 9


class Input(Protocol):
    """What is connected to the terminals; a ModelRealisation is one."""

    def average(self, start_s: NDArray[np.float64], aperture_s: float) -> Truth:
        """Return the means over each aperture [start, start + aperture), asked forward in time only."""


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
        self._source = source
        self._clock = clock
        self._power_on_ns = clock()
        self._rate = 1 + self.properties.clock_error_ppm * 1e-6
        noise_seed, drift_seed = np.random.SeedSequence(self.properties.seed, spawn_key=(34410,)).spawn(2)
        self._noise_rng = np.random.default_rng(noise_seed)
        # The offset that autozero removes: 0.5 uV rms of slow wandering is the size of the 10 V range's specification
        # over a day, taken per hour and divided by the range; see _offset_V.
        self._drift = GaussMarkov.from_sd(sd_V=1e-6, tau_s=3600.0).realise(np.random.default_rng(drift_seed))
        self._zero: float | None = None
        self._schedule: Schedule | None = None
        self._made = 0
        self._index = 0
        self._triggers_left = 0.0
        self._announce_completion = False
        self._truth = np.empty(0, dtype=TRUTH)
        self._measure_nothing()

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
        """Array of TRUTH (n,): the last readings, as many as `truth_readings` says."""
        self.advance()
        return self._truth

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
            self._zero = None
        self.settings = settings

    def take_zero(self) -> None:
        """Measure the offset once, with the next reading, and subtract it from then on (autozero OFF or ONCE)."""
        self._zero = None

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
        truth = self._source.average(begin_s, aperture_s)
        value_V = self._measure(truth.total, begin_s, aperture_s)
        if self._late:
            self.questionable.happened(_TIMING_VIOLATION)
        if np.any(np.abs(value_V) == OVERLOAD_V):
            self.questionable.happened(_VOLTAGE_OVERLOAD)
        if self.memory.append(value_V):
            self.questionable.happened(_MEMORY_OVERFLOW)
        if self.properties.truth_readings:
            rows = np.empty(last - first, dtype=TRUTH)
            rows["index"] = self._index + np.arange(last - first)
            rows["begin_ns"] = self._power_on_ns + np.rint(begin_ns / self._rate).astype(np.int64)
            rows["aperture_ns"] = aperture_ns
            rows["value_V"] = value_V
            for part in fields(truth):
                rows[part.name] = getattr(truth, part.name)
            self._truth = np.concatenate((self._truth, rows))[-self.properties.truth_readings :]
        self._index += last - first

    def _measure(
        self, input_V: NDArray[np.float64], begin_s: NDArray[np.float64], aperture_s: float
    ) -> NDArray[np.float64]:
        """Return readings of the input's means: range, noise, offset, overload."""
        settings = self.settings
        if settings.autorange:
            ranges_V = np.asarray(RANGES_V)[np.searchsorted(_LIMITS_V[:-1], np.abs(input_V))]
            self.settings = replace(settings, range_V=float(ranges_V[-1]))
        else:
            ranges_V = np.full(input_V.size, settings.range_V)
        value_V = input_V.copy()
        if self.properties.noise:
            cycles = settings.cycles(self.line_frequency_hz)
            sd_V = noise_sd(ranges_V, cycles, autozero=settings.autozero)
            value_V += sd_V * self._noise_rng.standard_normal(value_V.size)
            value_V += self._offset(begin_s, aperture_s)
        limit_V = _LIMITS_V[np.searchsorted(RANGES_V, ranges_V)]
        return np.where(np.abs(value_V) > limit_V, np.copysign(OVERLOAD_V, value_V), value_V)

    def _offset(self, begin_s: NDArray[np.float64], aperture_s: float) -> NDArray[np.float64]:
        drift_V = self._drift.average(begin_s, aperture_s)
        if self.settings.autozero:
            return np.zeros(drift_V.size)
        if self._zero is None:
            self._zero = float(drift_V[0])
        return drift_V - self._zero

    # -- clock and status --------------------------------------------------------------------------------------------

    def _now_ns(self) -> int:
        elapsed_ns = self._clock() - self._power_on_ns
        return elapsed_ns + round(elapsed_ns * (self._rate - 1))

    def _host_ns(self, meter_ns: int) -> int:
        return self._power_on_ns + round(meter_ns / self._rate)

    def _measure_nothing(self) -> None:
        """Compile the input's kernels now, so that the first reading does not wait for it."""
        nothing = np.empty(0)
        self._source.average(nothing, 1.0)
        self._drift.average(nothing, 1.0)

    def _show_state(self) -> None:
        """Bring the Standard Operation condition and *OPC up to date."""
        measuring = self._schedule is not None
        waiting = not measuring and bool(self._triggers_left)
        full = len(self.memory) >= self.memory_threshold
        self.operation.become(_MEASURING * measuring | _WAITING * waiting | _THRESHOLD * full)
        if self._announce_completion and not measuring and not waiting:
            self._announce_completion = False
            self.standard_event |= 1


_LIMITS_V = np.array([0.12, 1.2, 12.0, 120.0, 1000.0])
"""Largest reading of each range: 120 % of it, and 1000 V on the last."""
