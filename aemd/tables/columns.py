"""A recording as columns in memory, for a notebook: numpy arrays, and without a copy what pandas and Arrow take.

Each column is one array of its own, since that is what both of them can take over as it is.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from aemd.block import ESTIMATE, READING
from aemd.record.description import Description
from aemd.record.schema import FILTERED
from aemd.record.source import Selection, open_readings, readings_told
from aemd.tables.paired import paired

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

__all__ = ["Columns", "read_columns"]

_ESTIMATES = {
    "value_V": "estimate_V",
    "sigma_V": "sigma_V",
    "u_V": "u_V",
    "window": "window",
    "passes": "passes",
    "spread": "spread",
    "log_likelihood": "log_likelihood",
    "status": "estimate_status",
}
"""Field of an estimate -> its column here; its number and instant are its reading's."""
_LEAST_ROOM = 65_536


@dataclass(frozen=True, slots=True)
class Columns(Mapping[str, NDArray[Any]]):
    """A recording in memory: `columns["value_V"]`, and the like.

    index       number of the reading; a jump is a loss
    t_ns        its instant, ns since 1970 (UTC)
    value_V     the reading; NaN where status says that there is none
    status      bits of aemd.block.Status
    estimate_V, sigma_V, u_V, window, passes, spread, log_likelihood, estimate_status
                its estimate; NaN or 0 where there is none. Only of a recording with estimates

    Values are in `description.unit`, which is V unless the recording says otherwise.
    """

    path: Path
    description: Description
    arrays: Mapping[str, NDArray[Any]]

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.arrays)

    def __len__(self) -> int:
        return len(self.arrays)

    @property
    def readings(self) -> int:
        """How many there are."""
        return len(self.arrays["index"])

    @property
    def time(self) -> NDArray[np.datetime64]:
        """The instants as numpy's, UTC: a view."""
        return self.arrays["t_ns"].view("datetime64[ns]")

    def to_pandas(self) -> "pd.DataFrame":
        """Return a DataFrame with the instants as its index; the columns are these arrays, not copies."""
        import pandas as pd  # noqa: PLC0415 - an extra, and slow to import

        named = {name: array for name, array in self.arrays.items() if name != "t_ns"}
        index = pd.DatetimeIndex(self.arrays["t_ns"], tz="UTC", name="time", copy=False)
        return pd.DataFrame({name: pd.Series(array, index, copy=False) for name, array in named.items()}, copy=False)

    def to_arrow(self) -> "pa.Table":
        """Return an Arrow table; its columns are these arrays, not copies. The metadata says the unit and the file."""
        import pyarrow as pa  # noqa: PLC0415 - slow to import

        unit = {"unit": self.description.unit, "quantity": self.description.quantity, "recording": self.path.name}
        columns = {name: pa.array(array) for name, array in self.arrays.items() if name != "t_ns"}
        stamps = pa.array(self.arrays["t_ns"]).view(pa.timestamp("ns", tz="UTC"))
        return pa.table({"time": stamps, **columns}).replace_schema_metadata(unit)


def read_columns(path: Path, selection: Selection | None = None) -> Columns:
    """Read a whole recording into memory: 28 bytes a reading, 84 with its estimate.

    Raises:
        RecordingError: it cannot be read.
        UsageError: the selected number is not there, or one must be selected.
    """
    with open_readings(path, selection) as recording:
        kinds = {name: READING[name] for name in READING.names or ()}
        if FILTERED in recording.channels and "aemd.estimator" in recording.metadata:
            kinds |= {name: ESTIMATE[column] for column, name in _ESTIMATES.items()}
        room = readings_told(recording) or _LEAST_ROOM
        arrays = {name: np.empty(room, kind) for name, kind in kinds.items()}
        count = 0
        for block, place, made in paired(recording):
            end = count + len(block)
            while end > room:
                room *= 2
                arrays = {name: np.resize(array, room) for name, array in arrays.items()}
            for name in READING.names or ():
                arrays[name][count:end] = block[name]
            for column, name in _ESTIMATES.items():
                if name in arrays:
                    arrays[name][count:end] = np.nan if arrays[name].dtype.kind == "f" else 0
                    arrays[name][count:end][place] = made[column]
            count = end
        # A view of what is filled; of a recording that tells its length, that is all.
        return Columns(path, recording.description, {name: array[:count] for name, array in arrays.items()})
