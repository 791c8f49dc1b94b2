"""What each reading was made of, for tests and benchmarks; a meter that is asked for nothing keeps nothing."""

from collections import deque
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from aemd.model import Truth

__all__ = ["TRUTH", "TruthLog"]

TRUTH = np.dtype(
    [("index", "<i8"), ("begin_ns", "<i8"), ("aperture_ns", "<i8")]
    + [(name, "<f8") for name in ("signal_V", "internal_V", "external_V", "noise_V", "value_V")]
)
"""One reading:

index           its number since INITiate, as if none had been lost
begin_ns        the host's instant at which its aperture began, and
aperture_ns     the aperture's length, in the meter's nanoseconds
signal_V ...    the input's means over the aperture, by role
value_V         what the meter put into its memory
"""


class TruthLog:
    """The truth of the last readings."""

    def __init__(self, most: int) -> None:
        """Keep that of at least `most` readings; none at 0."""
        self._most = most
        self._parts: deque[NDArray[np.void]] = deque()
        self._readings = 0

    @property
    def rows(self) -> NDArray[np.void]:
        """Array of TRUTH, shape (n,), n <= most."""
        return np.concatenate([np.empty(0, TRUTH), *self._parts])[-self._most or None :]

    def append(
        self, index: int, begin_ns: NDArray[np.int64], aperture_ns: int, truth: Truth, value_V: NDArray[np.float64]
    ) -> None:
        """Note consecutive readings, the first of which is number `index`."""
        if not self._most:
            return
        part = np.empty(value_V.size, TRUTH)
        part["index"] = index + np.arange(value_V.size)
        part["begin_ns"] = begin_ns
        part["aperture_ns"] = aperture_ns
        part["value_V"] = value_V
        for role in fields(truth):
            part[role.name] = getattr(truth, role.name)
        self._parts.append(part)
        self._readings += part.size
        while self._readings - self._parts[0].size >= self._most:
            self._readings -= self._parts.popleft().size
