"""The records that every stage speaks: arrays of readings, arrays of estimates, and the batch that carries them.

A stage never sees one reading: it gets a block, a structured array of any length, and an estimator's output does not
depend on how the stream was cut. Quantities are SI and carry their unit in the name; time is integer nanoseconds since
1970 (UTC). A value is finite unless its status says otherwise.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntFlag
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "ESTIMATE",
    "NOT_A_VALUE",
    "READING",
    "WITNESS",
    "Batch",
    "Block",
    "Estimates",
    "Event",
    "Status",
    "make_block",
]


class Status(IntFlag):
    """What is known of one reading or estimate beyond its value; 0 is an ordinary one."""

    OVERLOAD_HIGH = 1
    """The meter was beyond the positive end of its range; the value is NaN."""
    OVERLOAD_LOW = 2
    """The meter was beyond the negative end of its range; the value is NaN."""
    INVALID = 4
    """The meter sent something that is not a number; the value is NaN."""
    GAP = 8
    """Readings are missing directly before this one; how many, the index says."""
    TIMING = 16
    """The meter said that it could not keep the interval somewhere in this block."""
    START_UP = 256
    """Of an estimate: too few readings yet for a window, so the Kalman filter's value stands in."""
    COASTED = 512
    """Of an estimate: predicted without this reading, because it or its window holds no usable value."""
    RESTARTED = 1024
    """Of an estimate: the estimator forgot what was before, because the gap was too long."""


NOT_A_VALUE = int(Status.OVERLOAD_HIGH | Status.OVERLOAD_LOW | Status.INVALID)
"""A reading with any of these bits has no usable value."""

READING = np.dtype([("index", "<i8"), ("t_ns", "<i8"), ("value_V", "<f8"), ("status", "<u4")])
"""One reading: its number since the start of the acquisition (lost ones are counted, so a jump is a gap), the instant
of the middle of its aperture, the meter's value, and Status bits."""

ESTIMATE = np.dtype(
    [
        ("index", "<i8"),
        ("t_ns", "<i8"),
        ("value_V", "<f8"),
        ("sigma_V", "<f8"),
        ("u_V", "<f8"),
        ("window", "<u4"),
        ("passes", "<u4"),
        ("spread", "<f8"),
        ("log_likelihood", "<f8"),
        ("status", "<u4"),
    ]
)
"""One estimate, of the reading with the same index and t_ns:

value_V         the true input s_k; never NaN
sigma_V         its standard deviation
u_V             the disturbance, external plus internal
window          readings in the estimator's window; 0 where it has none
passes          expectation-maximisation passes used; 0 where there are none
spread          spread of slopes that chose the window, in the estimator's slope unit; 0 where there is none
log_likelihood  of this reading given those before it (one step ahead), natural logarithm of a density in 1/V;
                0 for a reading without a value
status          the reading's bits, and the estimator's own
"""

WITNESS = np.dtype([("t_ns", "<i8"), ("value", "<f8")])
"""One value of a further quantity beside the readings, such as a temperature."""

Block: TypeAlias = NDArray[np.void]
"""Array of READING, shape (n,)."""

Estimates: TypeAlias = NDArray[np.void]
"""Array of ESTIMATE, shape (n,)."""


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened to the stream: a gap, a reset, a reconnection."""

    t_ns: int
    """When, UTC. Of a gap: the instant of its first missing reading."""
    kind: str
    """One word: gap, overload, timing, epoch, clock, instrument."""
    message: str
    """One line for a person."""
    first_index: int = -1
    """Of a gap: the first missing reading; otherwise -1."""
    last_index: int = -1
    """Of a gap: the last missing reading, inclusive; otherwise -1."""


@dataclass(frozen=True, slots=True)
class Batch:
    """What one step of the pipeline carries: a block of readings and what happened meanwhile."""

    readings: Block
    events: tuple[Event, ...] = ()
    witnesses: Mapping[str, NDArray[np.void]] = field(default_factory=dict)
    """Arrays of WITNESS by name."""
    received_ns: int = 0
    """Host monotonic instant at which the block came from the link; 0 offline."""


def make_block(
    value_V: ArrayLike, *, first_index: int = 0, t0_ns: int = 0, interval_ns: float = 0.0, status: ArrayLike = 0
) -> Block:
    """Return a block of consecutive readings, equally spaced in time.

    Args:
        value_V: readings, shape (n,), V.
        first_index: index of the first.
        t0_ns: instant of the first, ns.
        interval_ns: spacing, ns.
        status: Status bits, one for all or shape (n,).

    >>> make_block([1.0, 2.0], first_index=7, interval_ns=10.0)["t_ns"].tolist()
    [0, 10]
    """
    values = np.atleast_1d(np.asarray(value_V, dtype=np.float64))
    block = np.empty(values.size, dtype=READING)
    offset = np.arange(values.size)
    block["index"] = first_index + offset
    block["t_ns"] = t0_ns + np.rint(offset * interval_ns).astype(np.int64)
    block["value_V"] = values
    block["status"] = status
    return block
