"""Is this meter fit to be recorded, and if not, what is to be done: each thing that can stand in the way, checked.

Everything is asked through the driver, so any driver's instrument can be examined. What only its maker could tell, a
driver may answer by a function `characterise` (see `agilent34410.characterise`).
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, nan
from pathlib import Path
from threading import Timer

import numpy as np

from aemd.acquire.acquisition import Acquisition
from aemd.acquire.devices import SYSFS
from aemd.acquire.instrument import BusyError, Instrument, OtherInstrumentError, RefusedError, find_driver, host_ns
from aemd.acquire.reach import name_obstacle, way_to
from aemd.block import READING, Block, Event, Status
from aemd.config import Config
from aemd.errors import InstrumentError, RecordingError, UsageError
from aemd.session import opened, simulated

__all__ = ["Check", "Examination", "characterise", "examine"]

TIMEOUT_S = 2.0  # where a driver's options name none
COMMAS = 3  # at least, in an answer to *IDN? (IEEE 488.2, 10.14)
LEAST_READINGS = 30
MEASURED_S = 3.0
LONGEST_S = 60.0  # of measuring, whatever the interval
MOST_RATE = 300e-6  # two crystals within 100 ppm each, and what three seconds leave in doubt


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that was looked at."""

    name: str
    ok: bool
    found: str
    advice: str = ""
    """What to do, where it is not as it should be."""


@dataclass(frozen=True, slots=True)
class Examination:
    """All of it."""

    resource: str
    ok: bool
    checks: tuple[Check, ...]


def examine(config: Config) -> Examination:
    """Check permissions, link, identity, line frequency, error queue and timing by a short measurement."""
    checks = _permissions(config.resource)
    link = Check("link", ok=True, found=config.resource)
    try:
        with opened(config) as instrument:
            checks.append(link)
            said = instrument.identity
            name = " ".join(said.get(key, "") for key in ("manufacturer", "model", "serial", "firmware")).strip()
            checks.append(Check("identity", ok=True, found=name))
            checks += _line_frequency(instrument.settings)
            checks += _measure(instrument, config)
    except OtherInstrumentError as error:
        checks += [
            link,
            Check("identity", ok=False, found=str(error), advice=_way_to_ours(config.resource, error.said)),
        ]
    except BusyError as error:
        advice = "stop the other program (`aemd status` shows a service of ours); two cannot share a meter's memory"
        checks += [link, Check("in use", ok=False, found=str(error), advice=advice)]
    except RefusedError as error:
        advice = "change what the config's [instrument] asks for as it says; the link is good"
        checks += [link, Check("settings", ok=False, found=str(error), advice=advice)]
    except InstrumentError as error:
        if link in checks:
            advice = "close other programs that use the meter, check its cable, then switch it off and on"
            checks.append(Check("stream", ok=False, found=str(error), advice=advice))
        else:
            # Of an obstacle the check of permissions has told.
            timeout_s = getattr(config.instrument, "timeout_s", TIMEOUT_S)
            advice = way_to(config.resource, timeout_s) if all(check.ok for check in checks) else ""
            checks.append(Check("link", ok=False, found=str(error), advice=advice))
    return Examination(config.resource, all(check.ok for check in checks), tuple(checks))


def characterise(config: Config, out: Path) -> Mapping[str, str]:
    """Ask the meter what no manual says, and write its answers.

    Raises:
        UsageError: the driver has no such questions.
        InstrumentError: nobody answers, or it is another instrument.
        RecordingError: the report cannot be written.
    """
    ask = getattr(find_driver(config.driver), "characterise", None)
    if ask is None:
        raise UsageError(f"--characterise: the driver {config.driver!r} has no questions to ask")
    if config.resource == "sim":
        with simulated(config) as resource:
            return characterise(config.with_resource(resource), out)
    is_new = not out.exists()
    _write(out, "")  # that it can be written is known before a minute is spent
    try:
        found = ask(config.resource, config.instrument, host_ns, time.sleep)
    except BaseException:
        if is_new:
            out.unlink(missing_ok=True)
        raise
    answers = {one.question: one.answer for one in found}
    text = f"# {config.resource}\n\n" + "".join(f"- {question}: {answer}\n" for question, answer in answers.items())
    _write(out, text, anew=True)
    return answers


def _write(out: Path, text: str, *, anew: bool = False) -> None:
    try:
        with out.open("w" if anew else "a", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise RecordingError(f"{out}: cannot be written: {(error.strerror or str(error)).lower()}") from error


def _permissions(resource: str) -> list[Check]:
    kind = resource.upper()
    if not kind.startswith(("ASRL", "USB")) or (kind.startswith("USB") and not SYSFS.is_dir()):
        return []  # there is nothing to ask, or nobody
    if obstacle := name_obstacle(resource):
        return [Check("permission", ok=False, found=resource, advice=obstacle)]
    return [Check("permission", ok=True, found="it is there and may be opened")]


def _way_to_ours(resource: str, said: str) -> str:
    if said.count(",") >= COMMAS:
        return (
            "another instrument is there: check the address (`aemd devices` lists what can be reached), or name its"
            " driver as `driver` in the config's [instrument]"
        )
    if resource.upper().startswith("ASRL"):
        return "what came is no name: set baud_rate, parity and flow_control to those of the meter's menu, 8 data bits"
    return "what answers there is no instrument: check address and port; the raw socket of a meter is at port 5025"


def _measure(instrument: Instrument, config: Config) -> list[Check]:
    wanted = max(LEAST_READINGS, round(MEASURED_S / instrument.interval_s))
    wanted = max(1, min(wanted, round(LONGEST_S / instrument.interval_s)))
    begun_s = time.monotonic()
    with Acquisition(instrument, most_readings=wanted, give_up_s=5.0) as acquisition:
        # A meter that takes none is only known to after some intervals, each of which may be an hour.
        bound = Timer(LONGEST_S, acquisition.stop)
        bound.daemon = True
        bound.start()
        try:
            batches = list(acquisition.batches())
        finally:
            bound.cancel()
    took_s = time.monotonic() - begun_s
    block = np.concatenate([np.empty(0, READING), *(batch.readings for batch in batches)])
    events = [event for batch in batches for event in batch.events]
    if not block.size:
        advice = "look at its display: it may wait for a trigger; an interval_s below a minute is known sooner"
        return [
            *_queue(events),
            Check("readings", ok=False, found=f"none within {took_s:.2f} s", advice=advice),
        ]
    return [
        *_queue(events),
        *_timing(instrument.interval_s, config, acquisition.clock_facts(), block, took_s),
        *_losses(acquisition, block),
    ]


def _line_frequency(settings: Mapping[str, str]) -> list[Check]:
    if "SYST:LFR?" not in settings:
        return []
    answer = settings["SYST:LFR?"]
    try:
        found_hz = float(answer)
    except ValueError:
        found_hz = nan
    if not 0 < found_hz < inf:
        advice = "switch the meter off and on, which has it measure the line frequency anew"
        return [
            Check("line frequency", ok=False, found=f"the answer {answer!r} is not a number above 0", advice=advice)
        ]
    return [Check("line frequency", ok=True, found=f"{found_hz:g} Hz, as the meter found it when it was switched on")]


def _queue(events: list[Event]) -> list[Check]:
    errors = [event.message for event in events if event.kind == "instrument"]
    advice = "look each up in the meter's manual; an earlier program may have left them" if errors else ""
    return [Check("error queue", ok=not errors, found="; ".join(errors) or "empty", advice=advice)]


def _timing(interval_s: float, config: Config, clock: Mapping[str, str], block: Block, took_s: float) -> list[Check]:
    asked_s = getattr(config.instrument, "interval_s", interval_s)
    checks = [Check("interval", ok=True, found=f"asked {asked_s:.9g} s, the meter takes {interval_s:.9g} s")]
    rate, within = float(clock["rate"]), float(clock["rate_uncertainty"])
    late = bool((block["status"] & Status.TIMING).any())
    ok = not late and abs(rate) - within <= MOST_RATE
    found = f"{block.size} readings in {took_s:.2f} s: {rate * 1e6:+.0f} ppm off, within {within * 1e6:.0f} ppm"
    if late:
        found += "; the meter says that it could not keep the interval"
    advice = "" if ok else "ask for a longer interval_s, a shorter aperture, or autozero off"
    return [*checks, Check("timing kept", ok=ok, found=found, advice=advice)]


def _losses(acquisition: Acquisition, block: Block) -> list[Check]:
    lost, outages = acquisition.counts.lost, acquisition.outages
    unusable = int(np.count_nonzero(np.isnan(block["value_V"])))
    ok = not (lost or outages)
    advice = (
        "" if ok else "use a wired link, close other programs that use the meter, and see the events of a recording"
    )
    checks = [Check("losses", ok=ok, found=f"{lost} readings lost, {outages} outages", advice=advice)]
    if unusable:
        hint = "choose a larger range_V, or check what is connected"
        checks.append(
            Check("input", ok=False, found=f"{unusable} of {block.size} readings without a value", advice=hint)
        )
    return checks
