"""A CSV log becomes a recording: readings and witnesses, no estimates.

A log does not number its rows, so nothing is counted as lost, however far apart two of them are.
"""

import csv
import gzip
import io
import math
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import chain, islice
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from aemd.block import ESTIMATE, READING, WITNESS, Batch, Status
from aemd.errors import RecordingError, UsageError
from aemd.record.description import Description
from aemd.record.writer import Recorder
from aemd.tables.grid import first_interval_of, interval_of, steps_for_good

__all__ = ["PER_VOLT", "ImportSummary", "import_csv"]

_BLOCK_READINGS = 65_536  # in memory at a time
# Volts are 1/1000 of millivolts, and 1000 is a double where 0.001 is none: dividing rounds once.
PER_VOLT = {"V": 1.0, "mV": 1e3, "uV": 1e6, "\u00b5V": 1e6, "\u03bcV": 1e6, "nV": 1e9}  # both signs that look like µ
_LAST_S = 9_200_000_000  # the year 2261; nanoseconds beyond it leave 64 bits
_NO_EPOCH_BEFORE_NS = 10**17  # 1973: no log that counts from 1970 is older, and no other one as long


@dataclass(frozen=True, slots=True)
class ImportSummary:
    """What an import made."""

    file: str
    out: str
    readings: int
    invalid: int
    """Readings without a usable value."""
    unit: str
    """Of the recorded values."""
    interval_s: float
    """Of the grid on which the first readings' times lie, s."""
    witnesses: tuple[str, ...]


def import_csv(path: Path, out: Path, *, unit: str = "V", scale: float = 1.0) -> ImportSummary:
    """Make a recording of a table with the header `time,value[,...]`.

    `time` is seconds, rising, since 1970 or since whenever the log began; it is kept as given, rounded to nanoseconds.
    `value` times `scale` is a value in `unit`; V, mV, uV and nV are recorded in volts, any other unit as it is. A value
    that is empty or not finite is a reading with the status INVALID. Each further column becomes the witness topic of
    its name; an empty cell there is no value. The nominal interval is that of the grid on which the stamps of the first
    65,536 readings lie.

    Args:
        path: the table; .gz is unpacked.
        out: the new recording.
        unit: of value times scale.
        scale: factor of every value.

    Raises:
        UsageError: the scale is not a number other than 0.
        RecordingError: the table cannot be read, or breaks a rule; or the recording cannot be written.
    """
    if not math.isfinite(scale) or scale == 0:
        raise UsageError(f"--scale {scale}: must be a finite number other than 0")
    with _open_text(path) as text:
        table = _Table(path, text)
        blocks = iter(table.blocks())
        first = next(blocks, None)
        if first is None:
            raise RecordingError(f"{path}: holds no reading below its header; there is nothing to import")
        interval_s = _interval_s(first.t_ns)
        description = _describe_import(path, table.witnesses, first.t_ns, interval_s, unit, scale)
        recorder = Recorder(out, description)
        invalid = 0
        try:
            for rows in chain([first], blocks):
                batch = rows.to_batch(scale, PER_VOLT.get(unit, 1.0))
                invalid += int(np.count_nonzero(batch.readings["status"]))
                recorder.write(batch, np.empty(0, ESTIMATE))
        except BaseException:
            recorder.discard()
            raise
        recorder.close("end")
    return ImportSummary(
        file=str(path),
        out=str(out),
        readings=recorder.counts.readings,
        invalid=invalid,
        unit=description.unit,
        interval_s=interval_s,
        witnesses=table.witnesses,
    )


@dataclass(frozen=True, slots=True)
class _Rows:
    """Some rows of a table, checked; shapes (n,)."""

    first_row: int
    t_ns: NDArray[np.int64]
    values: NDArray[np.float64]
    witnesses: Mapping[str, NDArray[np.float64]]
    """NaN where the cell is empty."""

    def to_batch(self, scale: float, per_volt: float) -> Batch:
        readings = np.zeros(len(self.t_ns), READING)
        readings["index"] = self.first_row + np.arange(len(self.t_ns))
        readings["t_ns"] = self.t_ns
        with np.errstate(over="ignore"):
            values = self.values * scale / per_volt
        usable = np.isfinite(values)
        readings["value_V"] = np.where(usable, values, np.nan)
        readings["status"] = np.where(usable, 0, int(Status.INVALID))
        witnesses = {}
        for name, column in self.witnesses.items():
            there = ~np.isnan(column)
            if there.any():
                witnesses[name] = np.empty(np.count_nonzero(there), WITNESS)
                witnesses[name]["t_ns"], witnesses[name]["value"] = self.t_ns[there], column[there]
        return Batch(readings, witnesses=witnesses)


class _Table:
    """A CSV table on its way in, row by row, so that an error knows its line."""

    def __init__(self, path: Path, text: IO[str]) -> None:
        self._path = path
        self._reader = csv.reader(text, strict=True)
        header = next(self._reader, None)
        if header is None:
            raise RecordingError(f"{path}: is empty; its first line must be the header time,value[,...]")
        self._names = [name.strip() for name in header]
        if self._names[:2] != ["time", "value"]:
            raise self._refuse(f"header {','.join(header)[:60]!r}", "must begin with time,value; put that line on top")
        self.witnesses = tuple(self._names[2:])
        counts = Counter(self._names)
        for name in self.witnesses:
            if not name or counts[name] > 1:
                raise self._refuse(f"column {name!r}", "must have a name of its own; rename it")
        self._last_ns = -1
        self._last_time = ""

    def blocks(self) -> Iterator[_Rows]:
        """Yield the rows in blocks; the last one is shorter."""
        first_row = 0
        while rows := list(islice(self._rows(), _BLOCK_READINGS)):
            columns = np.array([cells for _, cells in rows], np.float64)
            yield _Rows(
                first_row=first_row,
                t_ns=np.array([t_ns for t_ns, _ in rows], np.int64),
                values=columns[:, 0],
                witnesses={name: columns[:, 1 + number] for number, name in enumerate(self.witnesses)},
            )
            first_row += len(rows)

    def _rows(self) -> Iterator[tuple[int, list[float]]]:
        for cells in self._reader:
            if not cells:
                continue  # an empty line
            if len(cells) != len(self._names):
                raise self._refuse(
                    f"{len(cells)} cells", f"must be {len(self._names)} as in the header; complete or remove the line"
                )
            t_ns = self._instant(cells[0])
            yield t_ns, [self._number(name, cell) for name, cell in zip(self._names[1:], cells[1:], strict=True)]

    def _instant(self, cell: str) -> int:
        try:
            time_s = Decimal(cell.strip())
        except InvalidOperation:
            time_s = Decimal("nan")
        if not (time_s.is_finite() and 0 <= time_s <= _LAST_S):
            raise self._refuse(
                f"column 'time': {cell[:40]!r}",
                "must be seconds from 0 to 9.2e9, as a number; correct or remove the line",
            )
        t_ns = int(time_s.scaleb(9).to_integral_value())
        if t_ns <= self._last_ns:
            raise self._refuse(
                f"column 'time': {cell!r}",
                f"must be later than the one before, {self._last_time!r}; sort the table, or remove the line",
            )
        self._last_ns, self._last_time = t_ns, cell
        return t_ns

    def _number(self, name: str, cell: str) -> float:
        if not cell.strip():
            return math.nan
        try:
            return float(cell)
        except ValueError:
            raise self._refuse(
                f"column {name!r}: {cell[:40]!r}", "must be a number; correct it, or leave the cell empty"
            ) from None

    def _refuse(self, place: str, rule: str) -> RecordingError:
        return RecordingError(f"{self._path}: line {self._reader.line_num}, {place}: {rule}")


@contextmanager
def _open_text(path: Path) -> Iterator[IO[str]]:
    """Open a table, unpacking it if it is packed; whatever goes wrong with its bytes is one clear line."""
    try:
        with gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb") as octets:
            yield io.TextIOWrapper(octets, encoding="utf-8-sig", newline="")
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise RecordingError(f"{path}: cannot be unpacked: {str(error).lower()}; fetch the file again") from error
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: is no text: {error.reason} in UTF-8; save it as UTF-8") from error
    except csv.Error as error:
        raise RecordingError(f"{path}: is no CSV table: {error}; save it as comma-separated values") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {_why(error)}") from error


def _interval_s(t_ns: NDArray[np.int64]) -> float:
    if len(t_ns) < 2:
        return 0.0
    time_s = (t_ns - t_ns[0]) * 1e-9
    first_s = first_interval_of(time_s)
    return interval_of(time_s, steps_for_good(np.diff(time_s) / first_s), first_s)


def _describe_import(
    path: Path, witnesses: Sequence[str], t_ns: NDArray[np.int64], interval_s: float, unit: str, scale: float
) -> Description:
    in_volts = unit in PER_VOLT
    if int(t_ns[0]) < _NO_EPOCH_BEFORE_NS:
        epoch = "unknown: the column's 0 is written as 1970-01-01"
    else:
        epoch = "1970-01-01, UTC if the log kept to it"
    session = {
        "origin": f"imported from {path.name}",
        "time_epoch": epoch,
        "value_scale": repr(scale),
        "value_unit": unit,
        "interval": f"as stamped, of the first {len(t_ns)} readings",
    }
    return Description(
        unit="V" if in_volts else unit,
        quantity="voltage" if in_volts else "reading",
        interval_s=interval_s,
        witnesses=dict.fromkeys(witnesses, ""),
        session=session,
    )


def _why(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
