"""Readings, estimates and descriptions that the tests of recordings write."""

import struct
from pathlib import Path

import numpy as np

from aemd.block import ESTIMATE, READING, WITNESS, Batch, Block, Estimates, Event, Status
from aemd.record.description import Description, write_parameters
from aemd.record.reader import Recording

T0_NS = 1_700_000_000_000_000_000
STEP_NS = 66_666_667
NO_ESTIMATES = np.empty(0, ESTIMATE)

DESCRIPTION = Description(
    interval_s=0.066666667,
    session={"start": "2023-11-14T22:13:20Z"},
    instrument={"model": "34410A"},
    calibration={"scale": "1.0"},
    estimator=write_parameters("aem", {"q": 0.1, "window": 15}),
    clock={"offset_ns": "12"},
    config_toml='[instrument]\ndriver = "agilent34410"\n',
)


def estimates_of(readings: Block, seed: int = 1) -> Estimates:
    """Return estimates of these readings, every field filled with something of its own."""
    rng = np.random.default_rng(seed)
    made = np.zeros(len(readings), ESTIMATE)
    for name in ("index", "t_ns", "status"):
        made[name] = readings[name]
    for name in ("value_V", "sigma_V", "u_V", "spread", "log_likelihood"):
        made[name] = rng.standard_normal(len(readings))
    made["window"], made["passes"] = rng.integers(0, 2**32, (2, len(readings)), np.uint32)
    return made


def readings_of(count: int, *, seed: int = 0, first_index: int = 0) -> Block:
    """Return equally spaced readings of noise."""
    rng = np.random.default_rng(seed)
    made = np.zeros(count, READING)
    made["index"] = first_index + np.arange(count)
    made["t_ns"] = T0_NS + made["index"] * STEP_NS
    made["value_V"] = rng.standard_normal(count)
    return made


def eventful_batch() -> tuple[Batch, Estimates]:
    """Return 40 readings with a gap of 5, an overload, a NaN, two events and a witness, and their estimates."""
    readings = readings_of(45)
    readings = np.delete(readings, slice(20, 25))
    readings["status"][20] = Status.GAP
    readings["status"][30], readings["value_V"][30] = Status.OVERLOAD_HIGH, np.nan
    lost = T0_NS + 20 * STEP_NS
    events = (Event(lost, "gap", "5 readings lost", 20, 24), Event(T0_NS + 35 * STEP_NS, "overload", "beyond +10 V"))
    witness = np.zeros(4, WITNESS)
    witness["t_ns"], witness["value"] = T0_NS + np.arange(4) * 10 * STEP_NS, 20.0 + np.arange(4)
    return Batch(readings, events, {"temperature": witness}), estimates_of(readings)


def records_of(octets: bytes) -> list[tuple[int, int, bytes]]:
    """Return opcode, offset and body of each top-level record, from the MCAP specification alone."""
    found, at = [], 8
    while at < len(octets) - 8:
        opcode, length = struct.unpack_from("<BQ", octets, at)
        found.append((opcode, at, octets[at + 9 : at + 9 + length]))
        at += 9 + length
    return found


def read_all(path: Path, batch_readings: int | None = None, **options: bool) -> tuple[list[Batch], Block, Estimates]:
    """Return the batches, all readings and all estimates of a recording."""
    with Recording(path, **options) as recording:
        pairs = list(recording.batches_with_estimates(batch_readings))
    batches = [batch for batch, _ in pairs]
    readings = np.concatenate([np.empty(0, READING), *(batch.readings for batch in batches)])
    return batches, readings, np.concatenate([NO_ESTIMATES, *(estimates for _, estimates in pairs)])
