"""Is this meter fit to be recorded, and if not, what is to be done: each thing that can stand in the way, checked.

Everything is asked through the driver, so any driver's instrument can be examined. What only its maker could tell, a
driver may answer by a function `characterise` (see `agilent34410.characterise`).
"""

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aemd.acquire.acquisition import Acquisition
from aemd.acquire.devices import list_devices
from aemd.acquire.instrument import find_driver
from aemd.block import READING, Block, Event, Status
from aemd.config import Config
from aemd.errors import InstrumentError, RecordingError, UsageError
from aemd.session import opened, simulated

__all__ = ["Check", "Examination", "characterise", "examine"]

LEAST_READINGS = 30
MEASURED_S = 3.0
LONGEST_S = 60.0
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
    try:
        with opened(config) as instrument:
            checks.append(Check("link", ok=True, found=config.resource))
            said = instrument.identity
            name = " ".join(said.get(key, "") for key in ("manufacturer", "model", "serial", "firmware")).strip()
            checks.append(Check("identity", ok=True, found=name))
            checks += _line_frequency(instrument.settings)
            wanted = max(LEAST_READINGS, round(MEASURED_S / instrument.interval_s))
            wanted = max(1, min(wanted, round(LONGEST_S / instrument.interval_s)))
            begun_s = time.monotonic()
            with Acquisition(instrument, most_readings=wanted, give_up_s=5.0) as acquisition:
                batches = list(acquisition.batches())
            took_s = time.monotonic() - begun_s
            block = np.concatenate([np.empty(0, READING), *(batch.readings for batch in batches)])
            events = [event for batch in batches for event in batch.events]
            checks += _queue(events)
            checks += _timing(instrument.interval_s, config, acquisition.clock_facts(), block, took_s)
            checks += _losses(acquisition, block)
    except InstrumentError as error:
        checks.append(Check("link", ok=False, found=str(error), advice=_way_to(config.resource)))
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
    answers = {
        found.question: found.answer for found in ask(config.resource, config.instrument, time.monotonic_ns, time.sleep)
    }
    text = f"# {config.resource}\n\n" + "".join(f"- {question}: {answer}\n" for question, answer in answers.items())
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"{out}: cannot be written: {(error.strerror or str(error)).lower()}") from error
    return answers


def _permissions(resource: str) -> list[Check]:
    if resource.upper().startswith("ASRL"):
        path = resource[4:].partition("::")[0]
        ok = os.access(path, os.R_OK | os.W_OK)
        return [Check("permission", ok=ok, found=path, advice="" if ok else "join the group that owns it (dialout)")]
    if not resource.upper().startswith("USB"):
        return []
    blocked = [device for device in list_devices(0.0, search=False) if device.link == "USB" and device.hint]
    return [Check("permission", ok=False, found=device.found, advice=device.hint) for device in blocked] or [
        Check("permission", ok=True, found="every USB-TMC device that is there may be opened")
    ]


def _way_to(resource: str) -> str:
    if resource.upper().startswith("TCPIP"):
        return "check power, cable and address; `aemd devices --host ADDRESS` asks whether somebody answers there"
    return "check power and cable; `aemd devices` lists what is there"


def _line_frequency(settings: Mapping[str, str]) -> list[Check]:
    if "SYST:LFR?" not in settings:
        return []
    found_hz = float(settings["SYST:LFR?"])
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
