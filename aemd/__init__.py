"""aemd: read a digital multimeter without losing a reading, estimate the true input, record both.

The way of a reading, and of the tree:

    acquire/   instrument -> ring: the meter's memory drained by one thread, every reading counted and timed
    estimate/  readings -> estimates: the paper's filters and better ones, kernels without I/O
    record/    readings and estimates -> MCAP, and back
    pipeline   the one loop that a live acquisition and a replay both run

`model/` states what we believe generates the readings; drivers and their simulators are found by entry point.

In Python, `aemd.open(path)` gives a recording as arrays. Importing aemd imports nothing else.
"""

from os import PathLike
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from aemd.tables import Columns

__all__ = ["__version__", "open"]

__version__ = "0.1.0"


def open(  # noqa: A001 - as one opens a file, and always by its full name
    path: str | PathLike[str],
    *,
    topic: str | None = None,
    field: str | None = None,
    time: Literal["publish", "log"] | None = None,
) -> "Columns":
    """Read a recording into memory: numpy arrays by name, with `to_pandas()` and `to_arrow()`, which do not copy them.

    Args:
        path: a recording, or any MCAP file with numbers.
        topic: in another program's file, the topic with the readings.
        field: in its messages, the field; `a.b` for one in a message within.
        time: which of a message's times is the reading's; publish_time where there is one.

    Raises:
        aemd.errors.RecordingError: it cannot be read.
        aemd.errors.UsageError: there is no such topic or field, or several could be meant; the message lists them.
    """
    from pathlib import Path  # noqa: PLC0415 - see above

    from aemd.record.source import Selection  # noqa: PLC0415
    from aemd.tables import read_columns  # noqa: PLC0415

    return read_columns(Path(path), Selection(topic, field, time))
