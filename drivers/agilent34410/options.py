"""What a config may set of the meter, with the bounds of its manual."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le
from pyvisa.constants import ControlFlow, Parity

__all__ = ["Options"]

RANGES_V = (0.1, 1.0, 10.0, 100.0, 1000.0)
POWER_LINE_CYCLES = (0.001, 0.002, 0.006, 0.02, 0.06, 0.2, 1.0, 2.0, 10.0, 100.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """Settings of a 34410A that measures a DC voltage at equal intervals.

    The default interval is 3356 steps of the meter's 20 us grid, 14.899 Hz, beside the 15 Hz of the paper (Shen et al.,
    Micromachines 10(5), 294, 2019). At 15.000 Hz the mains and their harmonics (50, 60, 100, 120 Hz...) fold onto 0 Hz
    and 5 Hz, where they are neither told from the slow signal nor from each other. At 14.899 Hz the first three of
    50 Hz fold onto 5.3, 4.3 and 1.0 Hz, those of 60 Hz onto 0.4, 0.8 and 1.2 Hz: each alone, so that the pattern names
    the grid. (A rate at which none comes near 0 Hz, such as 110/7 Hz, folds 50 and 60 Hz onto the same place.)

    Raises:
        ValueError: a value that the meter does not have.
    """

    range_V: float = 10.0
    """Full scale, V: 0.1, 1, 10, 100 or 1000. Fixed: ranging by itself would break the interval."""
    nplc: float = 1.0
    """Aperture in power-line cycles: 0.006, 0.02, 0.06, 0.2, 1, 2, 10 or 100 (34411A also 0.001 and 0.002)."""
    aperture_s: Annotated[float, Ge(20e-6), Le(1.0)] | None = None
    """Aperture, s, instead of `nplc`; the meter then rejects no mains hum (34410A: 100 us and more)."""
    autozero: Literal["on", "off", "once"] = "on"
    """Subtract a zero measured after each reading (doubles the time a reading takes), never, or one measured now."""
    input_impedance_auto: bool = True
    """More than 10 GOhm on the ranges up to 10 V; false for 10 MOhm on all."""
    trigger_delay_s: Annotated[float, Ge(0.0), Le(3600.0)] | None = None
    """From the trigger to the first reading, s; absent for the meter's own choice."""
    interval_s: Annotated[float, Gt(0.0), Le(3600.0)] = 0.06712
    """Time between readings, s; the meter rounds it to its grid and what it answers counts."""
    timeout_s: Annotated[float, Gt(0.0), Le(60.0)] = 2.0
    """Longest wait for an answer, s."""
    baud_rate: Annotated[int, Ge(300), Le(4_000_000)] = 9600
    """Of a serial line, such as a GPIB adapter's, bit/s."""
    parity: Literal["none", "even", "odd"] = "none"
    """Of a serial line; always 8 data bits, because readings come as 8-bit bytes."""
    flow_control: Literal["none", "rts_cts", "dtr_dsr"] = "none"
    """Of a serial line; never by characters, which a reading's bytes may be."""
    display: bool = True
    """Keep the meter's display on; off saves it some time at high rates."""

    @property
    def serial_line(self) -> dict[str, Any]:
        """What pyvisa is told of a serial line."""
        return {
            "baud_rate": self.baud_rate,
            "parity": Parity[self.parity],
            "flow_control": ControlFlow[self.flow_control],
        }

    def __post_init__(self) -> None:
        _refuse_unlisted("range_V", self.range_V, RANGES_V)
        _refuse_unlisted("nplc", self.nplc, POWER_LINE_CYCLES)


def _refuse_unlisted(name: str, value: float, allowed: tuple[float, ...]) -> None:
    if value not in allowed:
        raise ValueError(f"{name} = {value:g}: must be one of {', '.join(f'{one:g}' for one in allowed)}")
