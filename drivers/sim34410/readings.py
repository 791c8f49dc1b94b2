"""What commands do to get readings: configure and measure, wait, and take them out of the memory."""

from dataclasses import replace
from math import inf

from sim34410.forms import Result, Wait, limits
from sim34410.meter import Meter
from sim34410.noise import NPLC, RANGES_V, RESOLUTION
from sim34410.reply import format_integer, format_number, format_readings
from sim34410.scpi import NO_UNIT, VOLTS, parse_number
from sim34410.settings import Settings
from sim34410.status import ScpiError

__all__ = [
    "configured",
    "count_points",
    "fetch",
    "last",
    "measure",
    "nplc_for",
    "range_for",
    "read",
    "remove",
    "resolution_limits",
    "take",
    "wait",
]


def configured(parameters: tuple[str, ...]) -> Settings:
    """Return the settings of CONFigure: those of *RST, but for the range and the resolution asked for."""
    settings = Settings()
    if parameters:
        automatic = {**limits(RANGES_V[0], RANGES_V[-1], inf), "AUTO": inf}
        range_V = parse_number(parameters[0], VOLTS, automatic)
        if range_V != inf:
            settings = replace(settings, range_V=range_for(range_V), autorange=False)
    if len(parameters) > 1:
        resolution_V = parse_number(parameters[1], VOLTS, resolution_limits(settings.range_V))
        settings = replace(settings, nplc=nplc_for(resolution_V / settings.range_V))
    return settings


def range_for(value_V: float) -> float:
    """Return the smallest range that is not below a value, V."""
    for range_V in RANGES_V:
        if 0 <= value_V <= range_V:
            return range_V
    raise ScpiError(-222)


def nplc_for(resolution: float) -> float:
    """Return the shortest integration that resolves this fraction of the range, power line cycles."""
    for nplc, resolved in zip(NPLC, RESOLUTION, strict=True):
        if resolved <= resolution * (1 + 1e-9):
            return nplc
    raise ScpiError(-221)


def resolution_limits(range_V: float) -> dict[str, float]:
    """Return the finest and the coarsest resolution of a range and that of 1 PLC, V."""
    finest, coarsest, default = (RESOLUTION[row] * range_V for row in (-1, 0, NPLC.index(1.0)))
    return {**limits(finest, coarsest, default)}


def measure(meter: Meter, parameters: tuple[str, ...]) -> Result:
    """Configure, then read (MEASure?)."""
    meter.configure(configured(parameters))
    return read(meter)


def read(meter: Meter) -> Result:
    """Initiate, then fetch (READ?)."""
    if meter.settings.trigger_count == inf:
        raise ScpiError(-221)
    if meter.settings.trigger_source == "BUS":
        raise ScpiError(-214)
    meter.initiate()
    return fetch(meter)


def fetch(meter: Meter) -> Result:
    """Return all readings, which stay in the memory, once they are all there (FETCh?)."""
    if meter.state != "idle":
        return Wait(meter.idle_at_ns, lambda: fetch(meter))
    if not len(meter.memory):
        raise ScpiError(-230)
    return format_readings(meter.memory.peek(), meter.data_format, meter.byte_order, block=False)


def wait(meter: Meter, answer: str | None) -> Result:
    """Return the answer when the meter is idle (*OPC?, *WAI)."""
    return answer if meter.state == "idle" else Wait(meter.idle_at_ns, lambda: wait(meter, answer))


def take(meter: Meter, parameters: tuple[str, ...]) -> bytes:
    """Remove and return the oldest readings, all of them or as many as are asked for and there (R?)."""
    most = _count(meter, parameters[0]) if parameters else meter.memory.size
    if len(meter.memory) < most:
        meter.advance()
    return format_readings(meter.memory.take(most), meter.data_format, meter.byte_order, block=True)


def remove(meter: Meter, parameters: tuple[str, ...]) -> bytes:
    """Remove and return exactly as many of the oldest readings as are asked for (DATA:REMove?)."""
    count = _count(meter, parameters[0])
    meter.advance()
    if count > len(meter.memory):
        raise ScpiError(-222)
    return format_readings(meter.memory.take(count), meter.data_format, meter.byte_order, block=False)


def count_points(meter: Meter) -> str:
    """Return how many readings are in the memory (DATA:POINts?)."""
    meter.advance()
    return format_integer(len(meter.memory))


def last(meter: Meter) -> str:
    """Return the last reading taken, or 9.91E+37, with its unit (DATA:LAST?)."""
    meter.advance()
    last_V = meter.memory.last_V
    return f"{format_number(9.91e37 if last_V is None else last_V)} VDC"


def _count(meter: Meter, text: str) -> int:
    most = meter.memory.size
    value = parse_number(text, NO_UNIT, limits(1, most, most))
    if not 1 <= value <= most or value != round(value):
        raise ScpiError(-222)
    return round(value)
