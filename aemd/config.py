"""One TOML file -> one frozen, validated Config; anything wrong is refused with file, key, value and rule.

There is no search path and no merging: what is not in the file has the default of the options class that it belongs to.
Options classes stand beside the code that they steer (a driver's in the driver, an estimator's in the estimator), as
frozen dataclasses whose bounds are written in their types; this module finds and fills them, and refuses unknown keys.
"""

import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from annotated_types import Ge, Gt, Le
from pydantic import ConfigDict, TypeAdapter, ValidationError

from aemd.acquire.instrument import find_driver, find_simulator
from aemd.errors import ConfigError, RecordingError, UsageError, not_among
from aemd.estimate.registry import ESTIMATORS
from aemd.live.options import LiveOptions
from aemd.record.description import Description, read_parameters, write_parameters
from aemd.shipped import read_shipped

__all__ = [
    "AcquisitionOptions",
    "Config",
    "EstimatorChoice",
    "RecordingOptions",
    "Scale",
    "choose_estimator",
    "load_config",
    "load_estimator",
    "load_simulator",
    "name_estimator",
    "parse_options",
    "recorded_estimator",
]

SIMULATED = "aemd/share/simulated.toml"
"""How messages and recordings name the config that comes with aemd."""

Options = TypeVar("Options")


@dataclass(frozen=True, slots=True)
class Scale:
    """From volts to the sensor's unit, for displays and other programs; the recording's values stay volts."""

    factor: float = 1.0
    """Sensor units per volt."""
    offset: float = 0.0
    """Sensor units at zero volts."""
    unit: str = "V"
    """Name of the sensor's unit."""

    def __post_init__(self) -> None:
        if not math.isfinite(self.factor) or self.factor == 0:
            raise ValueError(f"factor = {self.factor}: must be finite and not zero")
        if not math.isfinite(self.offset):
            raise ValueError(f"offset = {self.offset}: must be finite")


@dataclass(frozen=True, slots=True)
class AcquisitionOptions:
    """What becomes of an acquisition whose instrument is lost."""

    give_up_s: Annotated[float, Gt(0)] | None = None
    """How long to try to have a lost link back, s; absent for without end. A first connection is tried once."""


@dataclass(frozen=True, slots=True)
class RecordingOptions:
    """Where and how recordings are written."""

    directory: str = "."
    """Folder of the recordings; made when it is not there."""
    flush_interval_s: Annotated[float, Gt(0), Le(3600)] = 1.0
    """Time between two flushes to the disk, s; shorter makes larger files. A kill loses this much at most, and a
    quarter second that was on its way."""
    chunk_bytes: Annotated[int, Ge(4096)] = 1 << 20
    """A chunk is closed at this size even before the interval is over."""
    compression: Literal["zstd", "none"] = "zstd"
    """Of the chunks."""
    durability: Literal["power", "crash"] = "power"
    """`power` syncs every flush to the disk; `crash` leaves that to the operating system (spares SD cards)."""
    rotate_bytes: Annotated[int, Ge(0)] = 1 << 30
    """Another file is begun at this size; 0 for never."""
    rotate_s: Annotated[float, Ge(0)] = 86400.0
    """Another file is begun where UTC passes a multiple of this, s; 0 for never."""
    min_free_bytes: Annotated[int, Ge(0)] = 200_000_000
    """Room that is left to others: with less on the disk nothing is written until there is more; 0 for none."""

    def __post_init__(self) -> None:
        if 0 < self.rotate_bytes < 1 << 16:
            raise ValueError(f"rotate_bytes = {self.rotate_bytes}: must be 0, for never, or at least {1 << 16}")
        if 0 < self.rotate_s < 1:
            raise ValueError(f"rotate_s = {self.rotate_s}: must be 0, for never, or at least 1")
        if not self.directory or "\0" in self.directory:
            raise ValueError(f"directory = {self.directory!r}: must be the name of a folder")


@dataclass(frozen=True, slots=True)
class EstimatorChoice:
    """An estimator by name, with its options."""

    name: str
    options: Any
    """Of the class that ESTIMATORS names."""

    def as_table(self) -> dict[str, Any]:
        """Return the [estimator] table of a config that asks for this."""
        return {"estimator": {"name": self.name, **asdict(self.options)}}

    def as_text(self) -> dict[str, str]:
        """Return name and options as a recording keeps them, read back by `recorded_estimator` to the same bits."""
        return write_parameters(self.name, asdict(self.options))


@dataclass(frozen=True, slots=True)
class Config:
    """Everything one acquisition is told."""

    driver: str
    resource: str
    """VISA resource; `sim` for the driver's simulated instrument."""
    instrument: Any
    """The driver's Options."""
    simulator: Any
    """The simulator's Options; None where the resource is not `sim`."""
    estimator: EstimatorChoice
    scale: Scale = field(default_factory=Scale)
    acquisition: AcquisitionOptions = field(default_factory=AcquisitionOptions)
    recording: RecordingOptions = field(default_factory=RecordingOptions)
    live: LiveOptions = field(default_factory=LiveOptions)
    text: str = ""
    """The file as read; stored in every recording."""

    def with_resource(self, resource: str) -> "Config":
        """Return this config with another resource, its simulator's options kept, or defaulted where needed."""
        simulator = self.simulator
        if resource == "sim" and simulator is None:
            simulator = find_simulator(self.driver).Options()
        return replace(self, resource=resource, simulator=simulator)

    def with_estimator(self, estimator: EstimatorChoice) -> "Config":
        """Return this config with another estimator."""
        return replace(self, estimator=estimator)

    def as_tables(self) -> dict[str, Any]:
        """Return every key with its value, defaults included, as tables of plain values."""
        tables = {
            "instrument": {"driver": self.driver, "resource": self.resource, **asdict(self.instrument)},
            **self.estimator.as_table(),
            "scale": asdict(self.scale),
            "acquisition": asdict(self.acquisition),
            "recording": asdict(self.recording),
            "live": asdict(self.live),
        }
        if self.simulator is not None:
            tables["simulator"] = asdict(self.simulator)
        return tables


def load_config(path: Path | None) -> Config:
    """Read and check a config; None is the one that comes with aemd, for the simulated meter.

    Raises:
        ConfigError: the file cannot be read, is not TOML, or says something that cannot be.
    """
    if path is None:
        text = read_shipped("simulated.toml")
        return _parse(_read_toml(text, SIMULATED), SIMULATED, text)
    text = _read_text(path)
    return _parse(_read_toml(text, str(path)), str(path), text)


def load_estimator(path: Path) -> EstimatorChoice:
    """Read the [estimator] table of a model file, such as `aemd tune` and `aemd diagnose -o` write, or of a config.

    Other tables are left be.

    Raises:
        ConfigError: the file cannot be read, is not TOML, has no such table, or says something that cannot be.
    """
    tables = _read_toml(_read_text(path), str(path))
    table = tables.get("estimator")
    if not isinstance(table, dict):
        raise ConfigError(f"{path}: [estimator]: missing; `aemd tune` and `aemd diagnose -o` write such a file")
    return choose_estimator(table, str(path))


def load_simulator(path: Path, config: Config) -> Config:
    """Return a config whose simulator has the options of a file instead, such as the faults of `[[faults]]` tables.

    Raises:
        ConfigError: the file cannot be read, is not TOML, has an unknown option, or says something that cannot be.
    """
    table = _read_toml(_read_text(path), str(path))
    options = parse_options(find_simulator(config.driver).Options, table, str(path), "simulator")
    return replace(config, simulator=replace(config.simulator, **{key: getattr(options, key) for key in table}))


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError(f"{path}: {(error.strerror or str(error)).lower()}; name a readable TOML file") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: byte {error.start}: not UTF-8 text; this must be a TOML file") from error


def _read_toml(text: str, place: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{place}: not TOML: {str(error)[0].lower()}{str(error)[1:]}") from error


def _parse(tables: Mapping[str, Any], place: str, text: str) -> Config:
    known = ("instrument", "simulator", "estimator", "scale", "acquisition", "recording", "live")
    for key, value in tables.items():
        if key not in known:
            raise ConfigError(f"{place}: {_unknown(key, known)}")
        if not isinstance(value, dict):
            raise ConfigError(f"{place}: {key} = {_show(value)}: must be a table, written [{key}]")
    instrument = dict(tables.get("instrument", {}))
    driver = _take_word(instrument, "driver", "agilent34410", f"{place}: [instrument]")
    resource = _take_word(instrument, "resource", None, f"{place}: [instrument]")
    try:
        driver_options = find_driver(driver).Options
        simulator_options = find_simulator(driver).Options if resource == "sim" else None
    except ConfigError as error:
        raise ConfigError(f"{place}: [instrument] driver = {driver!r}: {error}") from error
    simulator = None
    if simulator_options is not None:
        simulator = parse_options(simulator_options, tables.get("simulator", {}), place, "simulator")
    elif "simulator" in tables:
        raise ConfigError(
            f'{place}: [simulator]: only with [instrument] resource = "sim", not {resource!r}; remove one of them'
        )
    return Config(
        driver=driver,
        resource=resource,
        instrument=parse_options(driver_options, instrument, place, "instrument"),
        simulator=simulator,
        estimator=choose_estimator(dict(tables.get("estimator", {})), place),
        scale=parse_options(Scale, tables.get("scale", {}), place, "scale"),
        acquisition=parse_options(AcquisitionOptions, tables.get("acquisition", {}), place, "acquisition"),
        recording=parse_options(RecordingOptions, tables.get("recording", {}), place, "recording"),
        live=parse_options(LiveOptions, tables.get("live", {}), place, "live"),
        text=text,
    )


def choose_estimator(table: Mapping[str, Any], place: str) -> EstimatorChoice:
    """Return the estimator that a table `name = ..., option = ...` asks for; without a name, AEM.

    Raises:
        ConfigError: no such estimator, no such option, or a value out of bounds; `place` begins the message.
    """
    options = dict(table)
    name = _take_word(options, "name", "aem", f"{place}: [estimator]")
    if name not in ESTIMATORS:
        raise ConfigError(f"{place}: [estimator] name = {name!r}: {not_among(name, ESTIMATORS)}")
    return EstimatorChoice(name, parse_options(ESTIMATORS[name][0], options, place, "estimator"))


def name_estimator(name: str, known: EstimatorChoice | None = None) -> EstimatorChoice:
    """Return the estimator that a command line asks for: with the known one's options if it is that, else defaults.

    Raises:
        UsageError: no such estimator.
    """
    if known is not None and name == known.name:
        return known
    if name not in ESTIMATORS:
        raise UsageError(f"--estimator {name}: no such estimator; {not_among(name, ESTIMATORS)}")
    return EstimatorChoice(name, ESTIMATORS[name][0]())


def recorded_estimator(description: Description, place: str) -> EstimatorChoice | None:
    """Return the estimator that a recording says it was made with; None where it holds no estimates.

    Raises:
        RecordingError: it is damaged, or this version has no such estimator or option; `place` begins the message.
    """
    if not description.estimator:
        return None
    try:
        name, options = read_parameters(description.estimator)
        return choose_estimator({"name": name, **options}, place)
    except ValueError as error:
        raise RecordingError(f"{place}: metadata aemd.estimator: {error}; the recording is damaged") from error
    except ConfigError as error:
        raise RecordingError(f"{error}; name another by --estimator") from error


def parse_options(kind: type[Options], table: Mapping[str, Any], place: str, section: str) -> Options:
    """Fill a frozen dataclass from a TOML table, strictly: no key that it lacks, no text for a number.

    Raises:
        ConfigError: one line `place: [section] key = value: rule`, of the first fault, and how many more there are.
    """
    # Through JSON, because pydantic's strict mode takes a list for a tuple only there; in a tuple, because only a
    # container can be told to forbid extra keys of a plain dataclass and of those nested in it.
    adapter: TypeAdapter[tuple[Options]] = TypeAdapter(tuple[kind], config=ConfigDict(extra="forbid"))  # type: ignore[valid-type, arg-type]  # kind is a class at run time
    try:
        return adapter.validate_json(json.dumps([table], default=str), strict=True)[0]
    except ValidationError as error:
        faults = error.errors(include_url=False)
        more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
        raise ConfigError(f"{place}: {_explain(faults[0], kind, section)}{more}") from error


def _explain(fault: Any, kind: type[Any], section: str) -> str:
    """Say one of pydantic's faults as `[section] key = value: rule`."""
    path = [str(part) for part in fault["loc"][1:]]
    key = ".".join(path)
    if fault["type"] == "unexpected_keyword_argument":
        return f"[{section}] {_unknown(key, [item.name for item in fields(kind)] if len(path) == 1 else ())}"
    if fault["type"] == "value_error":
        return f"[{section}] {key + ': ' if key else ''}{fault['ctx']['error']}"
    if fault["type"] == "missing":
        return f"[{section}] {key}: missing; it has no default"
    rule = fault["msg"].replace("Input should be", "must be")
    for bound in fault.get("ctx", {}).values():
        if isinstance(bound, float):  # pydantic writes 1e-30 with all its zeros
            rule = f"{rule.rpartition(' ')[0]} {bound:g}"
    return f"[{section}] {key} = {_show(fault['input'])}: {rule[0].lower()}{rule[1:]}"


def _take_word(table: dict[str, Any], key: str, default: str | None, place: str) -> str:
    value = table.pop(key, default)
    if value is None:
        raise ConfigError(f'{place} {key}: missing; a VISA resource, or "sim" for the simulated instrument')
    if not isinstance(value, str) or not value:
        raise ConfigError(f"{place} {key} = {_show(value)}: must be text")
    return value


def _unknown(key: str, known: Any) -> str:
    return f"{key}: unknown key" + (f"; {not_among(key, known)}" if known else "; remove it")


def _show(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."
