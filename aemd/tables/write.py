"""A recording becomes a table, CSV or Parquet: readings and their estimates, row by row.

Witnesses stay out: they have instants of their own, and would need either further rows or values that nobody measured.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet
from numpy.typing import NDArray
from rich.console import Console

from aemd.block import Block, Estimates
from aemd.display import advancing
from aemd.errors import RecordingError, UsageError
from aemd.record.source import Readings, Selection, open_readings, readings_told
from aemd.tables.paired import paired

__all__ = ["ExportSummary", "export"]


@dataclass(frozen=True, slots=True)
class ExportSummary:
    """What an export made."""

    file: str
    out: str
    readings: int
    estimates: int


def export(
    path: Path, out: Path, *, selection: Selection | None = None, console: Console | None = None
) -> ExportSummary:
    """Write a recording as a table with the columns index, time_s, value_V, status, estimate_V, sigma_V, window.

    `time_s` counts from 1970 (UTC). In CSV it is an exact decimal; in Parquet it is a double, which at today's date is
    within 0.12 us of the recorded instant. Where there is no estimate its columns are empty (CSV) or null (Parquet).
    The columns ending in _V are in the recording's unit, which is V unless the Parquet metadata says otherwise.

    Args:
        path: the recording.
        out: the new table; its suffix, .csv or .parquet, says which.
        selection: which number of the file is the reading, where it is not a recording of ours.
        console: where progress is shown; None for nowhere.

    Raises:
        UsageError: the suffix is neither, or no such topic or field.
        RecordingError: the recording cannot be read, or the table exists or cannot be written.
    """
    if out.suffix not in (".csv", ".parquet"):
        raise UsageError(f"{out}: the name of a table must end in .csv or .parquet")
    readings = estimates = 0
    with open_readings(path, selection) as recording, _create(out) as file:
        is_text = out.suffix == ".csv"
        schema = _schema(recording, is_text=is_text)
        with (
            _open_table(file, schema, is_text=is_text) as table,
            advancing(readings_told(recording), console) as bar,
        ):
            for block, place, made in paired(recording):
                bar(len(block))
                table.write(pa.record_batch(_columns(block, place, made, is_text=is_text), schema=schema))
                readings += len(block)
                estimates += len(made)
    return ExportSummary(file=str(path), out=str(out), readings=readings, estimates=estimates)


def _schema(recording: Readings, *, is_text: bool) -> pa.Schema:
    unit = {"unit": recording.description.unit}
    fields = [
        pa.field("index", pa.int64()),
        pa.field("time_s", pa.string() if is_text else pa.float64(), metadata={"unit": "s since 1970 (UTC)"}),
        pa.field("value_V", pa.float64(), metadata=unit),
        pa.field("status", pa.uint32()),
        pa.field("estimate_V", pa.float64(), metadata=unit),
        pa.field("sigma_V", pa.float64(), metadata=unit),
        pa.field("window", pa.uint32(), metadata={"unit": "readings"}),
    ]
    told = {"recording": recording.path.name, "quantity": recording.description.quantity} | unit
    return pa.schema(fields, told | {name: json.dumps(pairs) for name, pairs in recording.metadata.items()})


def _columns(block: Block, place: NDArray[np.intp], made: Estimates, *, is_text: bool) -> list[Any]:
    """Return the table's columns; `place` is where in the block each estimate belongs."""
    missing = np.ones(len(block), np.bool_)
    missing[place] = False

    def spread(name: str) -> Any:
        column = np.zeros(len(block), made.dtype[name])
        column[place] = made[name]
        return pa.array(column, mask=missing)

    t_ns = block["t_ns"]
    return [
        pa.array(block["index"]),
        _decimal(t_ns) if is_text else pa.array(t_ns / 1e9),
        pa.array(block["value_V"]),
        pa.array(block["status"]),
        spread("value_V"),
        spread("sigma_V"),
        spread("window"),
    ]


def _decimal(t_ns: NDArray[np.int64]) -> Any:
    """Return instants as exact decimals of seconds."""
    whole, rest = (pa.array(part).cast(pa.string()) for part in np.divmod(t_ns, 10**9))
    return pc.binary_join_element_wise(whole, pc.utf8_lpad(rest, 9, "0"), ".")


@contextmanager
def _create(out: Path) -> Iterator[IO[bytes]]:
    """Create a file that is removed again if it cannot be completed."""
    try:
        file = out.open("xb")
    except FileExistsError as error:
        raise RecordingError(f"{out}: exists: a table is never overwritten; choose another name") from error
    except OSError as error:
        raise RecordingError(f"{out}: cannot be created: {_why(error)}") from error
    try:
        with file:
            yield file
    except OSError as error:
        out.unlink()
        raise RecordingError(f"{out}: cannot be written: {_why(error)}; make room") from error
    except BaseException:
        out.unlink()
        raise


def _open_table(file: IO[bytes], schema: pa.Schema, *, is_text: bool) -> Any:
    if not is_text:
        return pa.parquet.ParquetWriter(file, schema)
    options = pa.csv.WriteOptions(quoting_style="none", quoting_header="none")
    return pa.csv.CSVWriter(file, schema, write_options=options)


def _why(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
