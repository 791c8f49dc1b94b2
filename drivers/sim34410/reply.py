"""How the meter writes numbers, readings and blocks."""

from math import copysign, isinf

import numpy as np
from numpy.typing import NDArray

__all__ = ["format_block", "format_integer", "format_number", "format_readings"]

_REAL = {("REAL,64", "NORM"): ">f8", ("REAL,64", "SWAP"): "<f8", ("REAL,32", "NORM"): ">f4", ("REAL,32", "SWAP"): "<f4"}


def format_number(value: float) -> str:
    """Return the meter's NR3 form.

    >>> format_number(0.066668), format_number(float("inf"))
    ('+6.66680000E-02', '+9.90000000E+37')
    """
    return f"{copysign(9.9e37, value) if isinf(value) else value:+.8E}"


def format_integer(value: float) -> str:
    """Return the meter's NR1 form; infinity in the NR3 form.

    >>> format_integer(215), format_integer(float("inf"))
    ('+215', '+9.90000000E+37')
    """
    return format_number(value) if isinf(value) else f"{round(value):+d}"


def format_block(content: bytes) -> bytes:
    """Return a definite-length arbitrary block (IEEE 488.2, 8.7.9).

    >>> format_block(b"abc"), format_block(b"")
    (b'#13abc', b'#10')
    """
    length = str(len(content))
    return f"#{len(length)}{length}".encode() + content


def format_readings(value_V: NDArray[np.float64], data_format: str, byte_order: str, *, block: bool) -> bytes:
    """Return readings, shape (n,), in the format of FORMat:DATA; `block` asks for a block even in ASCII (R?)."""
    if data_format.startswith("ASC"):
        text = ",".join(format_number(value) for value in value_V).encode()
        return format_block(text) if block else text
    return format_block(value_V.astype(_REAL[data_format, byte_order]).tobytes())
