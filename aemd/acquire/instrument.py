"""The contract between aemd and a driver, and how a driver is found.

A driver is a module (or any object) registered in the entry-point group `aemd.drivers`; the simulator of its instrument
is registered under the same name in `aemd.simulators`. aemd imports neither. `resource = "sim"` starts the simulator on
loopback and hands the driver its address, so the simulated instrument is reached through the real link.
"""

import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from aemd.errors import ConfigError, InstrumentError, not_among

__all__ = [
    "BusyError",
    "Clock",
    "Drain",
    "Driver",
    "Instrument",
    "OtherInstrumentError",
    "Recoverable",
    "Recovery",
    "RefusedError",
    "Simulator",
    "find_driver",
    "find_simulator",
    "host_ns",
]

Clock = Callable[[], int]
"""Host monotonic time, ns (`host_ns`); an argument everywhere, so that a test can move it."""

_SINCE_BOOT = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)


def host_ns() -> int:
    """Return the host's monotonic time, ns, that during which it was suspended included.

    Not `time.monotonic_ns`, which on Linux stands still while a laptop sleeps: the meter goes on meanwhile, so that
    whatever came afterwards would be stamped as early as the sleep was long.
    """
    return time.clock_gettime_ns(_SINCE_BOOT)


class OtherInstrumentError(InstrumentError):
    """Something answers there, and it is no instrument of this driver: nothing is wrong with the link.

    Args:
        message: as of every InstrumentError.
        said: what it answered when it was asked who it is.
    """

    def __init__(self, message: str, said: str) -> None:
        super().__init__(message)
        self.said = said


class BusyError(InstrumentError):
    """The instrument answers, and another program is taking readings out of it, which must not be disturbed."""


class RefusedError(InstrumentError):
    """The instrument answers, and cannot do what the config asks: nothing is wrong with the link."""


@dataclass(frozen=True, slots=True)
class Drain:
    """What one look into the instrument's memory brought, oldest reading first."""

    values_V: NDArray[np.float64]
    """Readings, shape (n,), n >= 0; NaN where the status says that there is no value."""
    status: NDArray[np.uint32]
    """Status bits of each reading, shape (n,)."""
    waiting: int
    """Readings that were in the memory when the instrument answered, these n included."""
    asked_ns: int
    """Host monotonic instant before the count of `waiting` was asked for."""
    answered_ns: int
    """Host monotonic instant after the answer came: every waiting reading was finished by then."""
    received_ns: int
    """Host monotonic instant at which the values were here."""
    overflowed: bool = False
    """The instrument overwrote readings that were never drained; how many, it does not know."""
    late: bool = False
    """The instrument could not keep its interval somewhere since the last look."""
    messages: tuple[str, ...] = ()
    """What the instrument's error queue held, one line each."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """What an instrument was found to be like once its link was there again. Its readings are as they were."""

    sampling: bool
    """It says that it is sampling still."""
    settings_kept: bool
    """It has every setting it was given; if not, its memory holds nothing of ours, and `start` restores them."""
    torn: int
    """Readings that left its memory by an exchange whose answer never came whole: lost, exactly so many."""
    how: str
    """What brought the link back, in a few words."""


class Instrument(Protocol):
    """One opened and configured instrument. Not thread-safe: one thread speaks to it."""

    @property
    def identity(self) -> Mapping[str, str]:
        """Manufacturer, model, serial, firmware, resource, as the instrument said."""

    @property
    def settings(self) -> Mapping[str, str]:
        """Every setting as read back, by the name of the command or quantity, and the command list as sent."""

    @property
    def interval_s(self) -> float:
        """Time between readings as read back, s."""

    @property
    def sample_delay_s(self) -> float:
        """From the middle of a reading's aperture to the moment it is in the memory, s."""

    @property
    def epoch_readings(self) -> int:
        """Readings after which the instrument starts its timer anew (a new timing epoch); 0 for never."""

    @property
    def memory_readings(self) -> int:
        """Readings that the instrument's memory holds."""

    def start(self) -> None:
        """Begin sampling; what the memory held is gone.

        Raises:
            InstrumentError: the instrument refused or the link failed.
        """

    def drain(self, most: int) -> Drain:
        """Take up to `most` readings out of the memory, oldest first; returns at once when there are none.

        Raises:
            InstrumentError: the link failed; readings may still be in the memory.
        """

    def stop(self) -> None:
        """End sampling; what is in the memory can still be drained."""

    def close(self) -> None:
        """Give the instrument back to the person before it (display, local) and close the link. Twice is fine."""


@runtime_checkable
class Recoverable(Protocol):
    """A way back after an InstrumentError, which an instrument may have; without it that ends the acquisition."""

    def recover(self, *, afresh: bool = False) -> Recovery:
        """Try once, within a few timeouts, to have the link in step again; neither starts, stops nor drains anything.

        The next attempt may try something stronger. Afterwards `drain` goes on where it failed, or, where the
        instrument no longer samples, takes what is left until `start` begins anew.

        Args:
            afresh: count the settings as lost, for an instrument that answers but does nothing.

        Raises:
            InstrumentError: not yet.
        """


class Driver(Protocol):
    """What an entry point of group `aemd.drivers` loads; a module with these two names will do."""

    @property
    def Options(self) -> type[Any]:  # noqa: N802 - it is a class
        """Frozen dataclass of what the config's [instrument] may hold besides `driver` and `resource`."""

    def open_instrument(self, resource: str, options: Any, clock: Clock) -> Instrument:
        """Open, identify and configure the instrument.

        Raises:
            InstrumentError: nobody answers; for `aemd doctor` to tell them apart, OtherInstrumentError where it is
                another instrument, BusyError where another program uses it, RefusedError where it cannot do what the
                options ask.
        """


class Simulator(Protocol):
    """What an entry point of group `aemd.simulators` loads."""

    @property
    def Options(self) -> type[Any]:  # noqa: N802 - it is a class
        """Frozen dataclass of what the config's [simulator] may hold."""

    def serve(self, options: Any, host: str, port: int) -> AbstractContextManager[str]:
        """Serve the simulated instrument from a thread; port 0 takes a free one.

        Returns:
            A context whose value is the VISA resource of the served instrument; leaving it stops the server.
        """


def _find(group: str, kind: str, name: str) -> object:
    found = {point.name: point for point in entry_points(group=group)}
    if name not in found:
        raise ConfigError(f"no {kind} {name!r} is installed; {not_among(name, found)}")
    return found[name].load()


def find_driver(name: str) -> Driver:
    """Return the installed driver of that name.

    Raises:
        ConfigError: there is none; the message lists those installed.
    """
    return cast("Driver", _find("aemd.drivers", "driver", name))


def find_simulator(name: str) -> Simulator:
    """Return the simulator of that driver's instrument.

    Raises:
        ConfigError: there is none; the message lists those installed.
    """
    return cast("Simulator", _find("aemd.simulators", "simulator of", name))
