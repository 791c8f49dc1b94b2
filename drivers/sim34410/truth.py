"""What each reading was made of and what became of it, for tests; a meter that is asked for nothing keeps nothing."""

from collections import deque
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from aemd.model import Truth
from sim34410.memory import Fates

__all__ = ["TRUTH", "TruthLog"]

_INPUT = [field.name for field in fields(Truth)]

TRUTH = np.dtype(
    [("run", "<i8"), ("index", "<i8"), ("begin_ns", "<i8"), ("middle_ns", "<i8"), ("aperture_ns", "<i8")]
    + [(name, "<f8") for name in (*_INPUT, "value_V")]
    + [("fate", "u1")]
)
"""One reading:

run             how often INITiate had been obeyed when it was made, 1 and up; the meter's readings ever are sorted by
index           run and index: its number since that INITiate, as if none had been lost
begin_ns        the host's instant at which its aperture began,
middle_ns       of the aperture's middle, to 1 ns and the 1e-4 of the meter's clock error within an aperture, and
aperture_ns     the aperture's length, in the meter's nanoseconds
signal_V ...    the input's means over the aperture, by role
value_V         what the meter put into its memory
fate            what became of it (`Fate`)
"""


class TruthLog:
    """The truth of the last readings."""

    def __init__(self, most: int) -> None:
        """Keep that of at least `most` readings; none at 0."""
        self._most = most
        self._parts: deque[NDArray[np.void]] = deque()
        self._readings = 0
        self._made = 0

    def rows(self, fates: Fates) -> NDArray[np.void]:
        """Return an array of TRUTH, shape (n,), n <= most, with what became of each."""
        rows = np.concatenate([np.empty(0, TRUTH), *self._parts])[-self._most or None :]
        rows["fate"] = fates.of(self._made - rows.size, self._made)
        return rows

    def append(
        self,
        run: int,
        index: int,
        begin_ns: NDArray[np.int64],
        aperture_ns: int,
        truth: Truth,
        value_V: NDArray[np.float64],
    ) -> None:
        """Note consecutive readings of one run, the first of which is number `index`."""
        self._made += value_V.size
        if not self._most:
            return
        part = np.empty(value_V.size, TRUTH)
        part["run"] = run
        part["index"] = index + np.arange(value_V.size)
        part["begin_ns"] = begin_ns
        part["middle_ns"] = begin_ns + aperture_ns // 2
        part["aperture_ns"] = aperture_ns
        part["value_V"] = value_V
        for name in _INPUT:
            part[name] = getattr(truth, name)
        self._parts.append(part)
        self._readings += part.size
        while self._readings - self._parts[0].size >= self._most:
            self._readings -= self._parts.popleft().size
