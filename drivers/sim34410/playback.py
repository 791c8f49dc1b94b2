"""A recording as the meter's input: each recorded value holds until the next one's instant."""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aemd.block import READING, Status
from aemd.errors import RecordingError
from aemd.model import Truth
from aemd.record.reader import Recording

__all__ = ["BEYOND_V", "Playback", "read_playback"]

BEYOND_V = 2000.0
"""What stands for an overload: more than any range takes."""


class Playback:
    """A staircase of recorded values, from the beginning again when it has ended."""

    def __init__(self, time_s: NDArray[np.float64], value_V: NDArray[np.float64]) -> None:
        """Take instants, s, ascending, and values, V, each of shape (n,), n >= 2.

        The last value holds for as long as the median of the others.
        """
        last_s = float(np.median(np.diff(time_s)))
        self._edge_s = np.append(time_s - time_s[0], time_s[-1] - time_s[0] + last_s)
        self._value_V = value_V
        self._integral_Vs = np.concatenate(([0.0], np.cumsum(value_V * np.diff(self._edge_s))))

    def average(self, start_s: NDArray[np.float64], aperture_s: float) -> Truth:
        """Return the exact means of the staircase; all of it counts as signal."""
        begin_s, length_s = start_s % self._edge_s[-1], self._edge_s[-1]
        end_s = begin_s + aperture_s
        mean_V = (self._integral_to(end_s, length_s) - self._integral_to(begin_s, length_s)) / aperture_s
        step = self._step(begin_s)
        within = end_s <= self._edge_s[step + 1]
        mean_V = np.where(within, self._value_V[step], mean_V)  # the very value, without rounding
        nothing = np.zeros(start_s.size)
        return Truth(mean_V, nothing, nothing, nothing)

    def _integral_to(self, time_s: NDArray[np.float64], length_s: float) -> NDArray[np.float64]:
        rounds, within_s = np.divmod(time_s, length_s)
        return np.asarray(rounds * self._integral_Vs[-1] + np.interp(within_s, self._edge_s, self._integral_Vs))

    def _step(self, time_s: NDArray[np.float64]) -> NDArray[np.intp]:
        return np.clip(np.searchsorted(self._edge_s, time_s, side="right") - 1, 0, self._value_V.size - 1)


def read_playback(path: Path) -> Playback:
    """Read a recording of aemd's, or a CSV (by its suffix) with the header `time,value[,...]`: seconds and volts.

    A reading that was an overload is played as a voltage beyond every range; one without a value is left out, so the
    one before it holds on.

    Raises:
        RecordingError: it cannot be read, or it does not hold two readings with ascending times.
    """
    time_s, value_V = _read_csv(path) if path.suffix == ".csv" else _read_recording(path)
    if time_s.size < 2 or not np.isfinite([time_s, value_V]).all() or not (np.diff(time_s) > 0).all():
        raise RecordingError(f"{path}: must hold at least two finite readings with ascending times")
    return Playback(time_s, value_V)


def _read_recording(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    with Recording(path, allow_unfinished=True) as recording:
        blocks = [batch.readings for batch in recording.batches()]
    readings = np.concatenate([np.empty(0, READING), *blocks])
    status = readings["status"]
    value_V = np.where(status & Status.OVERLOAD_HIGH, BEYOND_V, readings["value_V"])
    value_V = np.where(status & Status.OVERLOAD_LOW, -BEYOND_V, value_V)
    valid = status & Status.INVALID == 0
    time_ns = readings["t_ns"][valid]
    return (time_ns - time_ns[:1]) * 1e-9, value_V[valid]


def _read_csv(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    try:
        with path.open(newline="") as file:
            rows = csv.reader(file)
            header = next(rows, [])
            if header[:2] != ["time", "value"]:
                raise RecordingError(f"{path}: line 1: header is {','.join(header)!r}: must begin with time,value")
            table = np.array([(float(row[0]), float(row[1])) for row in rows if row]).reshape(-1, 2)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    except (ValueError, IndexError, csv.Error) as error:
        raise RecordingError(f"{path}: {error}: each line must be seconds,volts") from error
    return table[:, 0], table[:, 1]
