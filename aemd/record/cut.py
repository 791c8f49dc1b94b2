"""Messages cut into batches so that what belongs to a reading comes with it.

In the file an event or a witness value stands before the first reading that came after it, and an estimate behind the
reading that made it ready. A batch keeps to that: what stands directly before one of its readings is in it, and so are
the estimates up to the next batch's first reading. Where chunks begin and end does not matter.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aemd.block import ESTIMATE, READING, Batch, Estimates
from aemd.record.rows import concatenate
from aemd.record.schema import EVENT, FILTERED, RAW, WITNESS_PREFIX

__all__ = ["Messages", "Piece", "cut", "make_batch"]


@dataclass(frozen=True, slots=True)
class Messages:
    """What one topic brought, in the order of the file."""

    at: NDArray[np.int64]
    """Where each began, bytes from the first chunk's beginning, all chunks unpacked; shape (n,)."""
    values: NDArray[Any]
    """Array of READING, ESTIMATE or WITNESS, or of Event objects; shape (n,)."""


Piece = Mapping[str, Messages]
"""By topic; a topic that brought nothing may be missing."""


def cut(pieces: Iterable[Piece], batch_readings: int | None) -> Iterator[Piece]:
    """Yield the same messages in pieces of so many readings, the last one fewer; None for a piece a chunk.

    A piece is held back until the next one's first reading shows that its estimates are complete.
    """
    held: list[Piece] = []
    count = 0
    for piece in pieces:
        if batch_readings is None and len(held) == 1 and _are_apart(held[0], piece):
            yield held.pop()
            count = 0
        most = batch_readings or count
        held.append(piece)
        count += _readings(piece)
        if 0 < most < count:
            rest = _join(held)
            while most < count:
                first, rest = _split(rest, most)
                count -= most
                yield first
                if batch_readings is None:
                    break
            held = [rest]
    if held:
        rest = _join(held)
        if any(len(messages.at) for messages in rest.values()):
            yield rest


def make_batch(piece: Piece) -> tuple[Batch, Estimates]:
    """Return the piece as a batch, and its estimates."""
    nothing = Messages(np.empty(0, np.int64), np.empty(0, READING))
    batch = Batch(
        readings=piece.get(RAW, nothing).values,
        events=tuple(piece[EVENT].values) if EVENT in piece else (),
        witnesses={
            topic.removeprefix(WITNESS_PREFIX): messages.values
            for topic, messages in piece.items()
            if topic.startswith(WITNESS_PREFIX) and len(messages.at)
        },
    )
    return batch, piece[FILTERED].values if FILTERED in piece else np.empty(0, ESTIMATE)


def _are_apart(piece: Piece, following: Piece) -> bool:
    """Tell whether the first piece is a batch as it is: most are, and need no joining to be cut at the same place."""
    if not (_readings(piece) and _readings(following)):
        return False
    last, first = piece[RAW].at[-1], following[RAW].at[0]
    return all(
        messages.at[-1] < last for topic, messages in piece.items() if len(messages.at) and topic not in (RAW, FILTERED)
    ) and not (FILTERED in following and len(following[FILTERED].at) and following[FILTERED].at[0] < first)


def _readings(piece: Piece) -> int:
    return len(piece[RAW].at) if RAW in piece else 0


def _join(pieces: list[Piece]) -> Piece:
    if len(pieces) == 1:
        return pieces[0]
    joined = {}
    for topic in {topic: None for piece in pieces for topic in piece}:
        parts = [piece[topic] for piece in pieces if topic in piece]
        joined[topic] = Messages(concatenate([part.at for part in parts]), concatenate([part.values for part in parts]))
    return joined


def _split(piece: Piece, reading: int) -> tuple[Piece, Piece]:
    """Cut before this reading, counted from the piece's first; there is one, and one before it."""
    last, following = piece[RAW].at[reading - 1], piece[RAW].at[reading]
    first, rest = {}, {}
    for topic, messages in piece.items():
        count = int(np.searchsorted(messages.at, following if topic in (RAW, FILTERED) else last))
        first[topic] = Messages(messages.at[:count], messages.values[:count])
        rest[topic] = Messages(messages.at[count:], messages.values[count:])
    return first, rest
