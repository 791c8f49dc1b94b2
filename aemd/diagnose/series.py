"""A file becomes a series: arrays on the grid of the meter's own timer, and what the checks need of their origin.

A meter paces itself, so the steps between readings are whole multiples of one interval; time stamps given by a host
scatter about that grid. Where they keep to it, steps are taken as whole multiples (the stamps' scatter is then itself
something to check), and only those that leave it for good as they are stamped. Whether one does is told by the stamps
about it, not by the step alone: of stamps that scatter by a seventh of an interval a third of the steps are off by more
than a fifth, and to take those as stamped and their neighbours as whole would add their scatter up.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from aemd.block import NOT_A_VALUE, READING, Batch, Status
from aemd.errors import RecordingError
from aemd.record.reader import Recording
from aemd.record.source import readings_told
from aemd.tables import import_csv
from aemd.tables.grid import ON_GRID, digit_of, first_interval_of, interval_of, jumps_for_good, scatter, steps_for_good

__all__ = ["MOST_READINGS", "Series", "load_series"]

Floats = NDArray[np.float64]

_LEAST_READINGS = 100
"""Fewer do not tell the base model's parameters apart."""
_LEAST_CHANGES = 5
"""Readings that are not the usual one."""
_USUAL_APERTURE_S = 0.02
MOST_READINGS = 1_400_000
"""26 hours at 15 readings/s: of a longer record the beginning is judged, and the report says so. Each fit goes through
all readings some hundred times and holds several arrays of them, so time and memory would grow with the record."""
_LARGEST = 1e100
"""Of a reading: a square of it is a float still."""
_FAR_OUT = 1e12
"""Typical deviations: no meter has more digits, and a sum with the others would hold none of them."""
_TWO, _MANY = 2, 1000
_COARSE = 0.05
"""Scatter of the steps, in intervals, above which stamps that walk off the grid are taken as they are, all of them."""
_ABOUT = 3
"""Steps about a late stamp that tell whether it was only late."""


@dataclass(frozen=True, slots=True)
class Series:
    """Readings in the order of time; shapes (n,)."""

    path: str
    time_s: Floats
    """As stamped, from the first reading."""
    value_V: Floats
    """NaN where there is none."""
    index: NDArray[np.int64]
    """Number of each reading; a jump is a counted loss. Consecutive where the file does not number them."""
    status: NDArray[np.uint32]
    interval_s: float
    """Of the grid."""
    nominal_interval_s: float = 0.0
    """As the file says it was asked for; 0 if it does not, or if it was only taken from the stamps."""
    numbered: bool = False
    """Whether the file numbers its readings, so that a loss is known and not inferred."""
    aperture_s: float = 0.02
    """As the file says; else one cycle of 50 Hz, as a meter at NPLC 1 takes, if the readings leave time for it."""
    witnesses: Mapping[str, Floats] = field(default_factory=dict)
    """Further quantities, interpolated at the readings' times."""
    left_out: int = 0
    """Readings of the file behind these, which are the beginning of a very long record."""

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which readings have a value."""
        return np.isfinite(self.value_V)

    @property
    def step_s(self) -> Floats:
        """Time since the reading before, s, on the grid where the stamps keep to it; the first is one interval."""
        whole = self.whole_steps.astype(np.float64)
        if not self.numbered:
            whole[1:] = _as_stamped(self.time_s / self.interval_s, whole[1:], digit_of(self.time_s) / self.interval_s)
        return whole * self.interval_s

    @property
    def whole_steps(self) -> NDArray[np.int64]:
        """Intervals since the reading before, at least 1, and for the first 1.

        As the numbers say, where there are any; more where the stamps jump for good by whole intervals.
        """
        steps = np.diff(self.time_s) / self.interval_s
        if not self.numbered:
            return np.concatenate(([1], steps_for_good(steps)))
        counted = np.maximum(np.diff(self.index), 1)
        whole = counted.copy()
        for at in np.flatnonzero(steps > counted + 1 - ON_GRID):
            # A stamp that came late is made up for by the next steps; readings that are missing are not.
            low, high = max(at - _ABOUT, 0), min(at + _ABOUT + 1, steps.size)
            extra = float(steps[low:high].sum() - counted[low:high].sum())
            if extra > 0.5 and abs(steps[at] - np.rint(steps[at])) <= ON_GRID and steps[at] - counted[at] < extra + 0.5:
                whole[at] = int(np.rint(steps[at]))
        return np.concatenate(([1], whole)).astype(np.int64)

    @property
    def slot(self) -> NDArray[np.int64]:
        """Place of each reading on the grid of whole intervals, from 0."""
        return np.asarray(np.cumsum(self.whole_steps) - 1)


def load_series(path: Path, most: int = MOST_READINGS) -> Series:
    """Read a recording, or a table `time,value[,...]`; of a very long one the beginning.

    Args:
        path: the file.
        most: readings.

    Raises:
        RecordingError: the file cannot be read, or what it holds cannot be criticised.
    """
    try:
        with path.open("rb") as file:
            is_mcap = file.read(5) == b"\x89MCAP"
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {(error.strerror or str(error)).lower()}") from error
    if is_mcap:
        return _from_recording(path, path, most, numbered=True)
    if path.suffix == ".mcap":
        raise RecordingError(f"{path}: is no MCAP file, it does not begin as one; copy it again, or name a table .csv")
    with TemporaryDirectory() as folder:  # one reader of tables, with all its refusals
        made = Path(folder) / "table.mcap"
        import_csv(path, made)
        return _from_recording(path, made, most, numbered=False)


def _check_changes(path: Path, values: Floats) -> None:
    """Refuse a record that hardly ever leaves one value: how it does cannot be told from so few times."""
    usual = float(np.nanmedian(values))
    others = int(np.count_nonzero(np.isfinite(values) & (values != usual)))
    if others < _LEAST_CHANGES:
        but = f"all readings but {'one are' if others == 1 else f'{others} are'} {usual:g}"
        raise RecordingError(f"{path}: {but}; too few others to judge by")


def _from_recording(path: Path, made: Path, most: int, *, numbered: bool) -> Series:
    with Recording(made, allow_unfinished=True) as recording:
        batches, left_out = _beginning(recording, most)
        nominal = recording.description.interval_s
        stated = recording.description.session.get("aperture_s", "") if numbered else ""
        stamps_only = "interval" in recording.description.session  # as the imports tell where they have it from
    blocks = [batch.readings for batch in batches if batch.readings.size]
    readings = np.concatenate(blocks) if blocks else np.empty(0, READING)
    if readings.size < _LEAST_READINGS:
        raise RecordingError(
            f"{path}: holds {readings.size} readings; at least {_LEAST_READINGS} are needed to say anything"
        )
    values = np.where(readings["status"] & NOT_A_VALUE, np.nan, readings["value_V"])
    usable = int(np.count_nonzero(np.isfinite(values)))
    if usable < max(_LEAST_READINGS, readings.size // 2):
        raise RecordingError(f"{path}: only {usable} of {readings.size} readings have a value; too few to judge by")
    if np.nanmin(values) == np.nanmax(values):
        raise RecordingError(f"{path}: every reading is {np.nanmax(values):g}; a constant has nothing to explain")
    _check_changes(path, values)
    _check_size(path, values)
    t_ns = readings["t_ns"]
    if np.any(np.diff(t_ns) <= 0):
        row = int(np.argmax(np.diff(t_ns) <= 0)) + 2
        raise RecordingError(f"{path}: reading {row} is not later than the one before; sort the file by time")
    time_s = (t_ns - t_ns[0]) * 1e-9
    index = readings["index"].astype(np.int64)
    interval_s = first_interval_of(time_s, np.maximum(np.diff(index), 1) if numbered else 1)
    found: dict[str, list[NDArray[np.void]]] = {}
    for batch in batches:
        for name, rows in batch.witnesses.items():
            found.setdefault(name, []).append(rows)
    witnesses = {}
    for name, pieces in found.items():
        rows = np.concatenate(pieces)
        rows = rows[np.isfinite(rows["value"])]
        if rows.size >= 2 and np.ptp(rows["value"]) > 0:
            order = np.argsort(rows["t_ns"], kind="stable")
            at_s = (rows["t_ns"][order] - t_ns[0]) * 1e-9
            witnesses[name] = np.interp(time_s, at_s, rows["value"][order])
    was_asked = numbered and math.isfinite(nominal) and not stamps_only
    series = Series(
        path=str(path),
        time_s=time_s,
        value_V=values,
        index=index,
        status=readings["status"].astype(np.uint32),
        interval_s=interval_s,
        nominal_interval_s=nominal if was_asked else 0.0,
        numbered=numbered,
        witnesses=witnesses,
        left_out=left_out,
    )
    interval_s = interval_of(time_s, series.whole_steps[1:], interval_s)
    aperture_s = float(stated) if stated else min(_USUAL_APERTURE_S, interval_s)
    return replace(series, interval_s=interval_s, aperture_s=aperture_s)


def _as_stamped(stamps: Floats, whole: Floats, digit: float) -> Floats:
    """Return the whole steps, but as they are stamped those that leave the grid; all in intervals.

    Of stamps that do not keep to any grid, as those of a program that waits a while after each reading, all steps are
    as stamped; where the scatter is too small to matter, those that are off by more than a fifth.
    """
    steps = np.diff(stamps)
    left = np.concatenate(([0.0], np.cumsum(steps - whole)))
    off = np.abs(steps - whole) > ON_GRID
    if not off.any():
        return whole
    chosen = np.where(jumps_for_good(left, digit), steps, whole)
    behind = np.cumsum(steps - chosen)
    if float(np.median(np.abs(behind - np.median(behind)))) < 0.5:
        return chosen
    return steps if scatter(steps - whole) > _COARSE else np.where(off, steps, whole)


def _check_size(path: Path, values: Floats) -> None:
    """Refuse numbers that leave nothing to judge: too large to be squared, or beside which the others do not vary.

    Raises:
        RecordingError: there is one.
    """
    there = values[np.isfinite(values)]
    sizes = np.abs(values - np.median(there))
    row = int(np.nanargmax(sizes))
    typical = float(np.median(np.abs(there - np.median(there))))
    place = f"{path}: reading {row + 1} is {values[row]:g}"
    if sizes[row] > _LARGEST or np.abs(there).max() > _LARGEST:
        raise RecordingError(f"{place}; scale the readings to numbers below 1e100")
    if np.ptp(there) < 1 / _LARGEST:
        raise RecordingError(f"{path}: all readings are within 1e-100; scale them to numbers above that")
    if sizes[row] > _FAR_OUT * typical > 0:
        raise RecordingError(f"{place}, {_FAR_OUT:.0e} times further out than the others; leave its cell empty")
    few = np.unique(there[:_MANY])
    if few.size == _TWO and np.unique(there).size == _TWO:
        raise RecordingError(f"{path}: every reading is {few[0]:g} or {few[1]:g}; log more digits, or more levels")


def _beginning(recording: Recording, most: int) -> tuple[list[Batch], int]:
    """Return the batches up to so many readings, and how many readings the file holds behind them."""
    batches, count = list[Batch](), 0
    for batch in recording.batches():
        batches.append(batch)
        count += len(batch.readings)
        if count > most:
            batches[-1] = replace(batch, readings=batch.readings[: most - count])
            told = readings_told(recording)  # without counting, where the file was closed in order
            return batches, (recording.statistics().readings if told is None else told) - most
    return batches, 0


OVERLOAD = int(Status.OVERLOAD_HIGH | Status.OVERLOAD_LOW)
"""Either end of the range."""
