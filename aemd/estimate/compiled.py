"""Kernels as they are written, or compiled: the same bits at two prices.

Compiled, a reading takes a microsecond, and numba with the compiler beneath it 90 MB and half a second of every start.
As it is written, in Python, it takes a tenth of a millisecond and nothing else. So an acquisition at a slow rate,
which goes on for months, runs its few readings as written, and all else is compiled; numba is imported by the first
call that needs it.

The bits are the same because both ways are the same IEEE operations in the same order: no fastmath, no fused
multiplication and addition, logarithm and exponential by the same C library, and no `**`, for which Python asks that
library and numba multiplies (see kernels.whole_power).
"""

import sys
from collections.abc import Callable
from functools import cache
from types import FunctionType, SimpleNamespace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

__all__ = ["FEW", "choose", "kernel"]

FEW = 1000
"""Readings that may be run as written at once: 0.2 s. What an outage has heaped up is worth a compiler."""

Function = TypeVar("Function", bound=Callable[..., Any])

_options: dict[Any, dict[str, Any]] = {}
"""numba's options of each kernel; the kernels of a module may call each other, and none of another module."""


def kernel(**options: Any) -> Callable[[Function], Function]:
    """Mark a function as a kernel, with numba's options for it. It stays as it is, and calls others as they are."""

    def mark(function: Function) -> Function:
        _options[function] = options
        return function

    return mark


def choose(function: Callable[..., Any], size: int, few: int) -> Callable[..., Any]:
    """Return what runs a block of so many readings: the kernel as written if they are fewer than `few`, or compiled."""
    return _as_written(function) if size < few else _compiled(function.__module__)[function.__name__]


@cache
def _compiled(module: str) -> dict[str, Any]:
    """Return the names of a module with its kernels compiled: copies of them, which know each other as such."""
    from numba import njit  # noqa: PLC0415 - the price that the others are spared

    names = dict(vars(sys.modules[module]))
    for function, options in _options.items():
        if function.__module__ == module:
            copy = FunctionType(function.__code__, names, function.__name__)
            copy.__qualname__ = function.__qualname__
            names[function.__name__] = njit(cache=True, nogil=True, **options)(copy)
    return names


@cache
def _as_written(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that takes what the compiled one takes."""

    def run(*arguments: Any) -> Any:
        opened: list[_Rows] = []
        # What overflows is infinite, without a word, as it is when compiled.
        with np.errstate(all="ignore"):
            result = function(*[_open(argument, opened) for argument in arguments])
        for rows in opened:
            rows.put_back()
        return result

    return run


class _Rows:
    """A structured array whose elements have their fields as attributes, as numba has them.

    They are taken out when they are first asked for, and put back at the end: numpy's own records, which do the same,
    take a microsecond for each field at each turn.
    """

    def __init__(self, array: NDArray[np.void]) -> None:
        self.size = array.size
        self._array = array
        self._names = array.dtype.names or ()
        self._taken: dict[int, SimpleNamespace] = {}

    def __getitem__(self, place: int) -> SimpleNamespace:
        row = self._taken.get(place)
        if row is None:
            fields = zip(self._names, self._array[place].item(), strict=True)
            row = self._taken[place] = SimpleNamespace(**dict(fields))
        return row

    def put_back(self) -> None:
        """Write what was taken out into the array."""
        for place, row in self._taken.items():
            self._array[place] = tuple(vars(row).values())


def _open(argument: Any, opened: list[_Rows]) -> Any:
    """Return the same with its structured arrays opened, which are noted."""
    if isinstance(argument, np.ndarray):
        if argument.dtype.names is None:
            return argument
        opened.append(_Rows(argument))
        return opened[-1]
    if hasattr(argument, "_fields"):
        return argument._make([_open(field, opened) for field in argument])
    return argument
