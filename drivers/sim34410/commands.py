"""The meter's commands: each header with what it sets and what it answers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import inf
from typing import Any, TypeAlias

from sim34410.meter import Meter
from sim34410.noise import NPLC, RANGES_V, RESOLUTION
from sim34410.reply import format_number, format_readings
from sim34410.schedule import on_grid_ns
from sim34410.scpi import NO_UNIT, SECONDS, VOLTS, Tree, parse_boolean, parse_choice, parse_number
from sim34410.settings import MAX_SAMPLES, Settings
from sim34410.status import EventRegister, ScpiError

__all__ = ["COMMANDS", "Command", "Result", "Wait"]


@dataclass(frozen=True, slots=True)
class Wait:
    """An answer that is not there yet."""

    until_ns: int | None
    """Host instant at which to ask again; None when only another client's command can end the wait."""
    resume: "Callable[[], Result]"
    """What to ask again."""


Result: TypeAlias = bytes | str | Wait | None
Action: TypeAlias = Callable[[Meter, tuple[str, ...]], Result]


@dataclass(frozen=True, slots=True)
class Command:
    """One header; without an action, that form of it is an undefined header."""

    set: Action | None = None
    get: Action | None = None
    parameters: range = range(1)
    """How many parameters the set form takes."""
    query_parameters: range = range(1)
    """How many parameters the query form takes."""


ONE, UP_TO_ONE, UP_TO_TWO = range(1, 2), range(2), range(3)


# -- forms that many commands share --------------------------------------------------------------------------------


def _do(action: Callable[[Meter], Result]) -> Command:
    return Command(set=lambda meter, _: action(meter))


def _ask(answer: Callable[[Meter], Result]) -> Command:
    return Command(get=lambda meter, _: answer(meter))


def _integer(value: float) -> str:
    return format_number(inf) if value == inf else f"{round(value):+d}"


def _limits(least: float, most: float, default: float) -> Mapping[str, float]:
    return {"MINimum": least, "MAXimum": most, "DEFault": default}


def _number(
    get: Callable[[Meter], float],
    set_: Callable[[Meter, float], None],
    limits: Callable[[Meter], Mapping[str, float]],
    units: Mapping[str, int] = NO_UNIT,
    show: Callable[[float], str] = format_number,
    extra: Mapping[str, float] | None = None,
    enforced_least: float | None = None,
) -> Command:
    """Return a numeric setting that takes and answers MIN, MAX and DEF; out of bounds is -222."""

    def write(meter: Meter, parameters: tuple[str, ...]) -> None:
        bounds = limits(meter)
        value = parse_number(parameters[0], units, {**bounds, **(extra or {})})
        least = bounds["MINimum"] if enforced_least is None else enforced_least
        if value not in (extra or {}).values() and not least <= value <= bounds["MAXimum"]:
            raise ScpiError(-222)
        set_(meter, value)

    def read(meter: Meter, parameters: tuple[str, ...]) -> str:
        return show(parse_number(parameters[0], {}, limits(meter)) if parameters else get(meter))

    return Command(set=write, get=read, parameters=ONE, query_parameters=UP_TO_ONE)


def _setting(field: str, **form: Any) -> Command:
    return _number(
        get=lambda meter: getattr(meter.settings, field),
        set_=lambda meter, value: _change(meter, **{field: value}),
        **form,
    )


def _switch(field: str, on: bool = True) -> Command:  # noqa: FBT001, FBT002 - it is the value
    """Return an ON/OFF setting; `on` is the field's value for ON."""

    def write(meter: Meter, parameters: tuple[str, ...]) -> None:
        value = on if parse_boolean(parameters[0]) else not on
        _change(meter, **{field: value})

    return Command(set=write, get=lambda meter, _: str(int(getattr(meter.settings, field) == on)), parameters=ONE)


def _choice(field: str, words: tuple[str, ...]) -> Command:
    def write(meter: Meter, parameters: tuple[str, ...]) -> None:
        _change(meter, **{field: parse_choice(parameters[0], words)})

    return Command(set=write, get=lambda meter, _: str(getattr(meter.settings, field)), parameters=ONE)


def _mask(owner: Callable[[Meter], Any], field: str, most: int) -> Command:
    """Return an enable register: an integer from 0."""
    return _number(
        get=lambda meter: getattr(owner(meter), field),
        set_=lambda meter, value: setattr(owner(meter), field, round(value)),
        limits=lambda _: {"MINimum": 0, "MAXimum": most},
        show=_integer,
    )


# -- measuring -----------------------------------------------------------------------------------------------------


def _initiate(meter: Meter) -> None:
    meter.initiate()


def _fetch(meter: Meter) -> Result:
    if meter.state != "idle":
        return Wait(meter.idle_at_ns, lambda: _fetch(meter))
    if not len(meter.memory):
        raise ScpiError(-230)
    return format_readings(meter.memory.peek(), meter.data_format, meter.byte_order, block=False)


def _read(meter: Meter) -> Result:
    if meter.settings.readings == inf:
        raise ScpiError(-221)
    if meter.settings.trigger_source == "BUS":
        raise ScpiError(-214)
    meter.initiate()
    return _fetch(meter)


def _wait(meter: Meter, answer: str | None) -> Result:
    return answer if meter.state == "idle" else Wait(meter.idle_at_ns, lambda: _wait(meter, answer))


def _change(meter: Meter, **fields: Any) -> None:
    meter.configure(replace(meter.settings, **fields))


def _configured(parameters: tuple[str, ...]) -> Settings:
    """Return the settings of CONFigure: those of *RST, but for the range and the resolution asked for."""
    settings = Settings()
    words = {**_limits(RANGES_V[0], RANGES_V[-1], 0.0), "AUTO": 0.0}
    range_V = parse_number(parameters[0], VOLTS, words) if parameters else 0.0
    if not 0 <= range_V <= RANGES_V[-1]:
        raise ScpiError(-222)
    if range_V:
        settings = replace(settings, range_V=_range_for(range_V), autorange=False)
    if len(parameters) > 1:
        full_scale_V = settings.range_V
        words = {**_limits(RESOLUTION[-1] * full_scale_V, RESOLUTION[0] * full_scale_V, RESOLUTION[4] * full_scale_V)}
        settings = replace(settings, nplc=_nplc_for(parse_number(parameters[1], VOLTS, words) / full_scale_V))
    return settings


def _range_for(value_V: float) -> float:
    return next(range_V for range_V in RANGES_V if value_V <= range_V)


def _nplc_for(resolution: float) -> float:
    """Return the shortest integration that resolves this fraction of the range."""
    for nplc, resolved in zip(NPLC, RESOLUTION, strict=True):
        if resolved <= resolution * (1 + 1e-9):
            return nplc
    raise ScpiError(-221)


def _measure(meter: Meter, parameters: tuple[str, ...]) -> Result:
    meter.configure(_configured(parameters))
    return _read(meter)


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
    once = parameters[0].upper() == "ONCE"
    autozero = not once and parse_boolean(parameters[0])
    meter.configure(replace(meter.settings, autozero=autozero))
    meter.take_zero()


# -- readings out of the memory ------------------------------------------------------------------------------------


def _count(parameters: tuple[str, ...]) -> int:
    value = parse_number(parameters[0], NO_UNIT, {})
    if not 1 <= value <= MAX_SAMPLES or value != round(value):
        raise ScpiError(-222)
    return round(value)


def _take(meter: Meter, parameters: tuple[str, ...]) -> bytes:
    most = _count(parameters) if parameters else MAX_SAMPLES
    if len(meter.memory) < most:
        meter.advance()
    return format_readings(meter.memory.take(most), meter.data_format, meter.byte_order, block=True)


def _remove(meter: Meter, parameters: tuple[str, ...]) -> bytes:
    count = _count(parameters)
    meter.advance()
    if count > len(meter.memory):
        raise ScpiError(-222)
    return format_readings(meter.memory.take(count), meter.data_format, meter.byte_order, block=False)


def _points(meter: Meter) -> str:
    meter.advance()
    return _integer(len(meter.memory))


def _last(meter: Meter) -> str:
    meter.advance()
    last_V = meter.memory.last_V
    return f"{format_number(9.91e37 if last_V is None else last_V)} VDC"


# -- format, display, status ---------------------------------------------------------------------------------------


def _set_format(meter: Meter, parameters: tuple[str, ...]) -> None:
    kind = parse_choice(parameters[0], ("ASCii", "REAL"))
    length = round(parse_number(parameters[1], NO_UNIT, {})) if len(parameters) > 1 else None
    if kind == "REAL" and length in (None, 64, 32):
        meter.data_format = f"REAL,{length or 64}"
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
    return _do(lambda meter: meter.display.text.update({window: ""}))


def _status_group(name: str, group: Callable[[Meter], EventRegister]) -> dict[str, Command]:
    def fresh(meter: Meter) -> EventRegister:
        meter.advance()
        return group(meter)

    return {
        f"STATus:{name}[:EVENt]": _ask(lambda meter: _integer(fresh(meter).take())),
        f"STATus:{name}:CONDition": _ask(lambda meter: _integer(fresh(meter).condition)),
        f"STATus:{name}:ENABle": _mask(group, "enable", 32767),
    }


def _preset_status(meter: Meter) -> None:
    meter.questionable.enable = meter.operation.enable = 0


def _standard_event(meter: Meter) -> str:
    meter.advance()
    event, meter.standard_event = meter.standard_event, 0
    return _integer(event)


def _nothing(_: Meter) -> None:
    """Obey without effect: front panel, beeper, remote state."""


COMMANDS: Tree[Command] = Tree(
    {
        "*IDN": _ask(lambda meter: meter.properties.identity),
        "*RST": _do(Meter.reset),
        "*CLS": _do(Meter.clear_status),
        "*OPC": Command(set=lambda meter, _: meter.announce_completion(), get=lambda meter, _: _wait(meter, "1")),
        "*WAI": _do(lambda meter: _wait(meter, None)),
        "*TRG": _do(Meter.trigger),
        "*TST": _ask(lambda _: "+0"),
        "*STB": _ask(lambda meter: _integer(meter.status_byte)),
        "*SRE": _mask(lambda meter: meter, "service_request_enable", 255),
        "*ESR": _ask(_standard_event),
        "*ESE": _mask(lambda meter: meter, "standard_event_enable", 255),
        "*PSC": _mask(lambda meter: meter, "power_on_clear", 1),
        "SYSTem:ERRor[:NEXT]": _ask(lambda meter: meter.errors.pop()),
        "SYSTem:VERSion": _ask(lambda _: "1994.0"),
        "SYSTem:LFRequency": _ask(lambda meter: _integer(meter.line_frequency_hz)),
        "SYSTem:LOCal": _do(_nothing),
        "SYSTem:REMote": _do(_nothing),
        "SYSTem:RWLock": _do(_nothing),
        "SYSTem:BEEPer[:IMMediate]": _do(_nothing),
        "SYSTem:PRESet": _do(Meter.reset),
        "[SENSe:]FUNCtion[:ON]": Command(set=_choose_function, get=lambda *_: '"VOLT"', parameters=ONE),
        "CONFigure": _ask(_configuration),
        "CONFigure[:VOLTage][:DC]": Command(
            set=lambda meter, parameters: meter.configure(_configured(parameters)),
            get=lambda meter, _: _configuration(meter),
            parameters=UP_TO_TWO,
        ),
        "MEASure[:VOLTage][:DC]": Command(get=_measure, query_parameters=UP_TO_TWO),
        "[SENSe:]VOLTage[:DC]:NPLCycles": _number(
            get=lambda meter: meter.settings.nplc,
            set_=lambda meter, value: meter.configure(
                replace(meter.settings, nplc=next(nplc for nplc in NPLC if value <= nplc), aperture_s=None)
            ),
            limits=lambda _: _limits(NPLC[0], NPLC[-1], 1.0),
        ),
        "[SENSe:]VOLTage[:DC]:APERture": _number(
            get=lambda meter: meter.settings.aperture_ns(meter.line_frequency_hz) * 1e-9,
            set_=lambda meter, value: meter.configure(replace(meter.settings, aperture_s=value)),
            limits=lambda _: _limits(100e-6, 1.0, 0.1),
            units=SECONDS,
        ),
        "[SENSe:]VOLTage[:DC]:APERture:ENABled": _ask(lambda meter: str(int(meter.settings.aperture_s is not None))),
        "[SENSe:]VOLTage[:DC]:RANGe[:UPPer]": _number(
            get=lambda meter: meter.settings.range_V,
            set_=lambda meter, value: meter.configure(
                replace(meter.settings, range_V=_range_for(value), autorange=False)
            ),
            limits=lambda _: _limits(RANGES_V[0], RANGES_V[-1], 10.0),
            units=VOLTS,
            enforced_least=0.0,
        ),
        "[SENSe:]VOLTage[:DC]:RANGe:AUTO": _switch("autorange"),
        "[SENSe:]VOLTage[:DC]:RESolution": _number(
            get=lambda meter: meter.settings.resolution * meter.settings.range_V,
            set_=lambda meter, value: meter.configure(
                replace(meter.settings, nplc=_nplc_for(value / meter.settings.range_V), aperture_s=None)
            ),
            limits=lambda meter: _limits(
                *(RESOLUTION[row] * meter.settings.range_V for row in (-1, 0, 4)),
            ),
            units=VOLTS,
        ),
        "[SENSe:]VOLTage[:DC]:ZERO:AUTO": Command(
            set=_set_zero, get=lambda meter, _: str(int(meter.settings.autozero)), parameters=ONE
        ),
        "[SENSe:]VOLTage[:DC]:IMPedance:AUTO": _switch("impedance_auto"),
        "INITiate[:IMMediate]": _do(_initiate),
        "ABORt": _do(Meter.abort),
        "READ": _ask(_read),
        "FETCh": _ask(_fetch),
        "R": Command(get=_take, query_parameters=UP_TO_ONE),
        "DATA:POINts": _ask(_points),
        "DATA:POINts:EVENt:THReshold": _number(
            get=lambda meter: meter.memory_threshold,
            set_=lambda meter, value: setattr(meter, "memory_threshold", round(value)),
            limits=lambda _: _limits(1, MAX_SAMPLES, 1),
            show=_integer,
        ),
        "DATA:LAST": _ask(_last),
        "DATA:REMove": Command(get=_remove, query_parameters=ONE),
        "TRIGger:SOURce": _choice("trigger_source", ("IMMediate", "BUS", "EXTernal")),
        "TRIGger:COUNt": _setting(
            "trigger_count", limits=lambda _: _limits(1, MAX_SAMPLES, 1), show=_integer, extra={"INFinity": inf}
        ),
        "TRIGger:DELay": _number(
            get=lambda meter: meter.settings.delay_ns(meter.line_frequency_hz) * 1e-9,
            set_=lambda meter, value: meter.configure(replace(meter.settings, trigger_delay_s=value)),
            limits=lambda _: _limits(0.0, 3600.0, 0.0),
            units=SECONDS,
        ),
        "TRIGger:DELay:AUTO": Command(
            set=lambda meter, parameters: meter.configure(
                replace(
                    meter.settings,
                    trigger_delay_s=None
                    if parse_boolean(parameters[0])
                    else meter.settings.delay_ns(meter.line_frequency_hz) * 1e-9,
                )
            ),
            get=lambda meter, _: str(int(meter.settings.trigger_delay_s is None)),
            parameters=ONE,
        ),
        "SAMPle:COUNt": _number(
            get=lambda meter: meter.settings.sample_count,
            set_=lambda meter, value: meter.configure(replace(meter.settings, sample_count=round(value))),
            limits=lambda _: _limits(1, MAX_SAMPLES, 1),
            show=_integer,
        ),
        "SAMPle:SOURce": _choice("sample_source", ("IMMediate", "TIMer")),
        "SAMPle:TIMer": _number(
            get=lambda meter: meter.settings.timer_ns * 1e-9,
            set_=lambda meter, value: meter.configure(replace(meter.settings, timer_ns=on_grid_ns(value))),
            limits=lambda meter: _limits(meter.settings.least_interval_ns(meter.line_frequency_hz) * 1e-9, 3600.0, 1.0),
            units=SECONDS,
            enforced_least=20e-6,
        ),
        "FORMat[:DATA]": Command(set=_set_format, get=lambda meter, _: meter.data_format, parameters=range(1, 3)),
        "FORMat:BORDer": Command(set=_set_order, get=lambda meter, _: meter.byte_order, parameters=ONE),
        "DISPlay[:WINDow][:STATe]": Command(
            set=_set_display, get=lambda meter, _: str(int(meter.display.on)), parameters=ONE
        ),
        "DISPlay[:WINDow]:TEXT[:DATA]": _text("1"),
        "DISPlay[:WINDow]:TEXT:CLEar": _clear_text("1"),
        "DISPlay:WINDow2:TEXT[:DATA]": _text("2"),
        "DISPlay:WINDow2:TEXT:CLEar": _clear_text("2"),
        "STATus:PRESet": _do(_preset_status),
        **_status_group("QUEStionable", lambda meter: meter.questionable),
        **_status_group("OPERation", lambda meter: meter.operation),
    }
)
