"""The meter's commands: each header with what it sets and what it answers.

DC volts is the only function. What the manuals at hand do not say is decided here or in the module that does it, and
said there: `R?` on an empty memory answers an empty block, FETCh? and READ? answer definite-length blocks in REAL.
"""

from collections.abc import Callable
from typing import Any

from sim34410.forms import ONE, UP_TO_ONE, UP_TO_TWO, Command, ask, choice, do, limits, mask, number, switch
from sim34410.meter import Meter
from sim34410.noise import RANGES_V
from sim34410.readings import (
    configured,
    count_points,
    fetch,
    last,
    measure,
    nplc_for,
    range_for,
    read,
    remove,
    resolution_limits,
    take,
    wait,
)
from sim34410.reply import format_integer, format_number
from sim34410.schedule import on_grid_ns
from sim34410.scpi import NO_UNIT, SECONDS, VOLTS, Tree, parse_boolean, parse_choice, parse_number
from sim34410.status import EventRegister, ScpiError

__all__ = ["COMMANDS"]


def _setter(field: str, convert: Callable[[float], Any] = float, **also: Any) -> Callable[[Meter, float], None]:
    """Return what changes one setting of a meter, and others to fixed values."""
    return lambda meter, value: meter.change(**{field: convert(value)}, **also)


# -- measurement ---------------------------------------------------------------------------------------------------


def _configuration(meter: Meter) -> str:
    """Return the answer to CONFigure?, without quotation marks.

    The manuals of the 34401A and the 34450A print it with them; InstrumentKit's class for the 34410A, the one client of
    this very model that reads it, works without them only.
    """
    settings = meter.settings
    resolution_V = settings.resolution * settings.range_V
    return f"VOLT {format_number(settings.range_V)},{format_number(resolution_V)}"


def _choose_function(_: Meter, parameters: tuple[str, ...]) -> None:
    if parameters[0].strip("\"'").upper() not in ("VOLT", "VOLT:DC", "VOLTAGE", "VOLTAGE:DC"):
        raise ScpiError(-224)


def _set_zero(meter: Meter, parameters: tuple[str, ...]) -> None:
    meter.change(autozero=parameters[0].upper() != "ONCE" and parse_boolean(parameters[0]))
    meter.take_zero()


def _set_nplc(meter: Meter, value: float) -> None:
    meter.change(nplc=next(nplc for nplc in meter.member.nplc if value <= nplc), aperture_s=None)


def _set_timer(meter: Meter, value_s: float) -> None:
    meter.change(timer_ns=on_grid_ns(value_s, meter.member.timer_step_ns))


def _least_interval_s(meter: Meter) -> float:
    return meter.settings.least_interval_ns(meter.line_frequency_hz, meter.member.timer_step_ns) * 1e-9


def _set_resolution(meter: Meter, value_V: float) -> None:
    meter.change(nplc=nplc_for(value_V / meter.settings.range_V), aperture_s=None)


def _delay_s(meter: Meter) -> float:
    return meter.settings.delay_ns(meter.line_frequency_hz) * 1e-9


def _set_automatic_delay(meter: Meter, parameters: tuple[str, ...]) -> None:
    meter.change(trigger_delay_s=None if parse_boolean(parameters[0]) else _delay_s(meter))


_MEASUREMENT = {
    "[SENSe:]FUNCtion[:ON]": Command(set=_choose_function, get=lambda *_: '"VOLT"', parameters=ONE),
    "CONFigure": ask(_configuration),
    "CONFigure[:VOLTage][:DC]": Command(
        set=lambda meter, parameters: meter.configure(configured(parameters)),
        get=lambda meter, _: _configuration(meter),
        parameters=UP_TO_TWO,
    ),
    "MEASure[:VOLTage][:DC]": Command(get=measure, query_parameters=UP_TO_TWO),
    "[SENSe:]VOLTage[:DC]:NPLCycles": number(
        get=lambda meter: meter.settings.nplc,
        set=_set_nplc,
        limits=lambda meter: limits(meter.member.nplc[0], meter.member.nplc[-1], 1.0),
    ),
    "[SENSe:]VOLTage[:DC]:APERture": number(
        get=lambda meter: meter.settings.aperture_ns(meter.line_frequency_hz) * 1e-9,
        set=_setter("aperture_s"),
        limits=lambda _: limits(100e-6, 1.0, 0.1),
        units=SECONDS,
    ),
    "[SENSe:]VOLTage[:DC]:APERture:ENABled": ask(lambda meter: str(int(meter.settings.aperture_s is not None))),
    "[SENSe:]VOLTage[:DC]:RANGe[:UPPer]": number(
        get=lambda meter: meter.settings.range_V,
        set=_setter("range_V", range_for, autorange=False),
        limits=lambda _: limits(RANGES_V[0], RANGES_V[-1], 10.0),
        units=VOLTS,
        least=0.0,
    ),
    "[SENSe:]VOLTage[:DC]:RANGe:AUTO": switch("autorange"),
    "[SENSe:]VOLTage[:DC]:RESolution": number(
        get=lambda meter: meter.settings.resolution * meter.settings.range_V,
        set=_set_resolution,
        limits=lambda meter: resolution_limits(meter.settings.range_V),
        units=VOLTS,
    ),
    "[SENSe:]VOLTage[:DC]:ZERO:AUTO": Command(
        set=_set_zero, get=lambda meter, _: str(int(meter.settings.autozero)), parameters=ONE
    ),
    "[SENSe:]VOLTage[:DC]:IMPedance:AUTO": switch("impedance_auto"),
}

_TRIGGER = {
    "INITiate[:IMMediate]": do(Meter.initiate),
    "ABORt": do(Meter.abort),
    "TRIGger:SOURce": choice("trigger_source", ("IMMediate", "BUS", "EXTernal")),
    "TRIGger:COUNt": number(
        get=lambda meter: meter.settings.trigger_count,
        set=_setter("trigger_count"),
        limits=lambda meter: limits(1, meter.member.most_samples, 1),
        show=format_integer,
        infinity=True,
    ),
    "TRIGger:DELay": number(
        get=_delay_s, set=_setter("trigger_delay_s"), limits=lambda _: limits(0.0, 3600.0, 0.0), units=SECONDS
    ),
    "TRIGger:DELay:AUTO": Command(
        set=_set_automatic_delay,
        get=lambda meter, _: str(int(meter.settings.trigger_delay_s is None)),
        parameters=ONE,
    ),
    "SAMPle:COUNt": number(
        get=lambda meter: meter.settings.sample_count,
        set=_setter("sample_count", round),
        limits=lambda meter: limits(1, meter.member.most_samples, 1),
        show=format_integer,
    ),
    "SAMPle:SOURce": choice("sample_source", ("IMMediate", "TIMer")),
    "SAMPle:TIMer": number(
        get=lambda meter: meter.settings.timer_ns * 1e-9,
        set=_set_timer,
        limits=lambda meter: limits(_least_interval_s(meter), 3600.0, 1.0),
        units=SECONDS,
        least=20e-6,  # MIN is told, not enforced (PRH page 797)
    ),
}

_READINGS = {
    "READ": ask(read),
    "FETCh": ask(fetch),
    "R": Command(get=take, query_parameters=UP_TO_ONE),
    "DATA:POINts": ask(count_points),
    "DATA:POINts:EVENt:THReshold": number(
        get=lambda meter: meter.memory_threshold,
        set=lambda meter, value: setattr(meter, "memory_threshold", round(value)),
        limits=lambda meter: limits(1, meter.memory.size, 1),
        show=format_integer,
    ),
    "DATA:LAST": ask(last),
    "DATA:REMove": Command(get=remove, query_parameters=ONE),
}


# -- format, display -----------------------------------------------------------------------------------------------


def _set_format(meter: Meter, parameters: tuple[str, ...]) -> None:
    kind = parse_choice(parameters[0], ("ASCii", "REAL"))
    length = parse_number(parameters[1], NO_UNIT, {}) if len(parameters) > 1 else None
    if kind == "REAL" and length in (None, 64, 32):
        meter.data_format = f"REAL,{round(length or 64)}"
    elif kind == "ASC" and length in (None, 0, 8):
        meter.data_format = "ASC,8"
    else:
        raise ScpiError(-224)


def _set_order(meter: Meter, parameters: tuple[str, ...]) -> None:
    meter.byte_order = parse_choice(parameters[0], ("NORMal", "SWAPped"))


def _set_display(meter: Meter, parameters: tuple[str, ...]) -> None:
    meter.display.on = parse_boolean(parameters[0])


def _text(window: str) -> Command:
    def write(meter: Meter, parameters: tuple[str, ...]) -> None:
        if parameters[0][:1] not in ("'", '"'):
            raise ScpiError(-104)
        meter.display.text[window] = parameters[0][1:-1]

    return Command(set=write, get=lambda meter, _: f'"{meter.display.text[window]}"', parameters=ONE)


def _clear_text(window: str) -> Command:
    return do(lambda meter: meter.display.text.update({window: ""}))


_OUTPUT = {
    "FORMat[:DATA]": Command(set=_set_format, get=lambda meter, _: meter.data_format, parameters=range(1, 3)),
    "FORMat:BORDer": Command(set=_set_order, get=lambda meter, _: meter.byte_order, parameters=ONE),
    "DISPlay[:WINDow][:STATe]": Command(
        set=_set_display, get=lambda meter, _: str(int(meter.display.on)), parameters=ONE
    ),
    "DISPlay[:WINDow]:TEXT[:DATA]": _text("1"),
    "DISPlay[:WINDow]:TEXT:CLEar": _clear_text("1"),
    "DISPlay:WINDow2:TEXT[:DATA]": _text("2"),
    "DISPlay:WINDow2:TEXT:CLEar": _clear_text("2"),
}


# -- status, system ------------------------------------------------------------------------------------------------


def _group(name: str, register: Callable[[Meter], EventRegister]) -> dict[str, Command]:
    """Return the commands of one status group."""

    def fresh(meter: Meter) -> EventRegister:
        meter.advance()
        return register(meter)

    return {
        f"STATus:{name}[:EVENt]": ask(lambda meter: format_integer(fresh(meter).take())),
        f"STATus:{name}:CONDition": ask(lambda meter: format_integer(fresh(meter).condition)),
        f"STATus:{name}:ENABle": mask(register, "enable", 32767),
    }


def _preset_status(meter: Meter) -> None:
    meter.questionable.enable = meter.operation.enable = 0


def _nothing(_: Meter) -> None:
    """Obey without effect: beeper, remote state."""


_STATUS = {
    "*CLS": do(Meter.clear_status),
    "*ESE": mask(lambda meter: meter, "standard_event_enable", 255),
    "*ESR": ask(lambda meter: format_integer(meter.take_standard_event())),
    "*OPC": Command(set=lambda meter, _: meter.announce_completion(), get=lambda meter, _: wait(meter, "1")),
    "*PSC": mask(lambda meter: meter, "power_on_clear", 1),
    "*SRE": mask(lambda meter: meter, "service_request_enable", 255),
    "*STB": ask(lambda meter: format_integer(meter.status_byte)),
    "*WAI": do(lambda meter: wait(meter, None)),
    "STATus:PRESet": do(_preset_status),
    **_group("QUEStionable", lambda meter: meter.questionable),
    **_group("OPERation", lambda meter: meter.operation),
}

_SYSTEM = {
    "*IDN": ask(lambda meter: meter.properties.identity),
    "*RST": do(Meter.reset),
    "*TRG": do(Meter.trigger),
    "*TST": ask(lambda _: "+0"),
    "SYSTem:BEEPer[:IMMediate]": do(_nothing),
    "SYSTem:ERRor[:NEXT]": ask(lambda meter: meter.errors.pop()),
    "SYSTem:LFRequency": ask(lambda meter: format_integer(meter.line_frequency_hz)),
    "SYSTem:LOCal": do(_nothing),
    "SYSTem:PRESet": do(Meter.reset),
    "SYSTem:REMote": do(_nothing),
    "SYSTem:RWLock": do(_nothing),
    "SYSTem:VERSion": ask(lambda _: "1994.0"),
}

COMMANDS: Tree[Command] = Tree({**_MEASUREMENT, **_TRIGGER, **_READINGS, **_OUTPUT, **_STATUS, **_SYSTEM})
