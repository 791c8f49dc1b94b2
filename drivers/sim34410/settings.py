"""What the meter is told, with the values after *RST, and what follows from it."""

from dataclasses import dataclass, fields

from sim34410.noise import NPLC, RESOLUTION

__all__ = ["Settings"]

_TRIGGER_SYSTEM = {
    "trigger_source",
    "trigger_count",
    "trigger_delay_s",
    "sample_count",
    "sample_source",
    "timer_ns",
}


@dataclass(frozen=True, slots=True)
class Settings:
    """Of the DC volts function and the trigger system; the defaults are those of *RST."""

    range_V: float = 10.0
    autorange: bool = True
    nplc: float = 1.0
    aperture_s: float | None = None
    """Set by VOLTage:APERture; None while NPLC rules."""
    autozero: bool = True
    impedance_auto: bool = False
    trigger_source: str = "IMM"
    trigger_count: float = 1.0
    """inf for TRIGger:COUNt INFinity."""
    trigger_delay_s: float | None = None
    """None for the automatic delay."""
    sample_count: int = 1
    sample_source: str = "IMM"
    timer_ns: int = 1_000_000_000

    def aperture_ns(self, line_frequency_hz: float) -> int:
        """Return how long the input is averaged for one reading, ns."""
        seconds = self.nplc / line_frequency_hz if self.aperture_s is None else self.aperture_s
        return round(seconds * 1e9)

    def reading_ns(self, line_frequency_hz: float) -> int:
        """Return how long a reading takes: its aperture, and as much again for the zero where autozero is on, ns."""
        return self.aperture_ns(line_frequency_hz) * (2 if self.autozero else 1)

    def least_interval_ns(self, line_frequency_hz: float, step_ns: int) -> int:
        """Return the answer to SAMPle:TIMer? MIN, the reading's duration on the timer's grid, ns."""
        return -(-self.reading_ns(line_frequency_hz) // step_ns) * step_ns

    def delay_ns(self, line_frequency_hz: float) -> int:
        """Return the delay after a trigger, ns; the automatic one is that of the user's guide, page 73."""
        if self.trigger_delay_s is not None:
            return round(self.trigger_delay_s * 1e9)
        cycles = self.cycles(line_frequency_hz)
        return 160_000 if cycles >= 1 else 130_000 if cycles >= 0.06 else 100_000

    def cycles(self, line_frequency_hz: float) -> float:
        """Return the aperture in power line cycles."""
        return self.nplc if self.aperture_s is None else self.aperture_s * line_frequency_hz

    def measures_alike(self, other: "Settings") -> bool:
        """Return whether the two differ in the trigger system only, so that readings in the memory stay meaningful."""
        return all(
            getattr(self, f.name) == getattr(other, f.name) for f in fields(self) if f.name not in _TRIGGER_SYSTEM
        )

    @property
    def resolution(self) -> float:
        """Resolution of the present NPLC as a fraction of the range; of an aperture, that of the default NPLC."""
        return RESOLUTION[NPLC.index(self.nplc)]
