"""Which files of an archive follow each other: the segments of one session, in the order of their readings."""

from collections.abc import Sequence
from dataclasses import dataclass
from mmap import mmap
from pathlib import PurePosixPath

from mcap.opcode import Opcode
from mcap.records import Metadata

from aemd.archive.places import Found
from aemd.errors import RecordingError
from aemd.record.walk import parse, walk

__all__ = ["find_runs"]

_HEAD_BYTES = 1 << 18  # what stands before the first chunk: schemas, channels, metadata; some kilobytes


@dataclass(frozen=True, slots=True)
class _Part:
    found: Found
    session: tuple[str, ...]
    """What all segments of a session have in common; empty for a file that is none."""
    first_index: int


def find_runs(files: Sequence[Found]) -> list[list[Found]]:
    """Return the files in runs: through a run, an estimator is carried on.

    Files are of one run if they lie in one folder and say that they are of one session, made with one estimator and
    interval; their order is that of their first readings. Two that begin with the same reading are copies: the second
    is a run of its own, as is every file that says nothing of this kind, or cannot be read.
    """
    runs: dict[tuple[str, ...], list[_Part]] = {}
    alone = []
    for part in sorted(map(_look, files), key=lambda part: part.first_index):
        run = runs.setdefault(part.session, []) if part.session else []
        if not part.session or (run and run[-1].first_index == part.first_index):
            alone.append([part])
        else:
            run.append(part)
    found = [[part.found for part in run] for run in [*runs.values(), *alone]]
    return sorted(found, key=lambda run: run[0].name)


def _look(found: Found) -> _Part:
    told: dict[str, dict[str, str]] = {}
    try:
        head = found.place.head(_HEAD_BYTES)
        with mmap(-1, max(len(head), 1)) as octets:
            octets.write(head)
            for record in walk(octets):
                if record.opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                    break
                if record.opcode == Opcode.METADATA:
                    metadata = parse(Metadata, octets, record)
                    told.setdefault(metadata.name, {}).update(metadata.metadata)
        first_index = int(told.get("aemd.segment", {}).get("first_index", "0"))
    except (RecordingError, ValueError):  # whoever replays it will tell
        return _Part(found, (), 0)
    session = told.get("aemd.session", {}).get("id", "")
    if not session:
        return _Part(found, (), first_index)
    estimator = sorted(told.get("aemd.estimator", {}).items())
    interval = told.get("aemd.segment", {}).get("interval_s", "")
    return _Part(found, (session, str(PurePosixPath(found.name).parent), interval, repr(estimator)), first_index)
