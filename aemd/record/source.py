"""Readings from any MCAP file: one of our recordings, or a number in a file of another program."""

from itertools import takewhile
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel

from aemd.record.foreign import ForeignRecording, Selection
from aemd.record.reader import Recording, open_map
from aemd.record.schema import RAW
from aemd.record.walk import parse, walk

__all__ = ["Readings", "Selection", "open_readings", "readings_told"]

Readings = Recording | ForeignRecording


def open_readings(path: Path, selection: Selection | None = None, *, allow_unfinished: bool = False) -> Readings:
    """Open a file for reading: as a recording of ours where it is one and nothing is selected, else as a foreign file.

    Args:
        path: the file.
        selection: which number of it is the reading.
        allow_unfinished: read a recording of ours that has no end as far as it goes.

    Raises:
        RecordingError: it cannot be read, is no MCAP file, is damaged, or holds no number.
        UsageError: what was selected is not there, or something must be selected.
    """
    if not selection and (path.suffix == ".active" or _is_ours(path)):
        return Recording(path, allow_unfinished=allow_unfinished)
    return ForeignRecording(path, selection or Selection())


def readings_told(recording: Readings) -> int | None:
    """Return how many readings a file says it has, without counting; None where it does not say."""
    if isinstance(recording, ForeignRecording):
        return recording.readings_told
    said = recording.metadata.get("aemd.close", {}).get("readings", "")
    return int(said) if said.isdecimal() else None


def _is_ours(path: Path) -> bool:
    """Tell whether the topic of our readings is there; where another program has rewritten the file, by its summary."""
    octets = open_map(path)
    try:
        around = takewhile(lambda record: record.opcode not in (Opcode.CHUNK, Opcode.MESSAGE), walk(octets))
        channels = [record for record in around if record.opcode == Opcode.CHANNEL]
        if not channels:
            channels = [record for record in walk(octets) if record.opcode == Opcode.CHANNEL]
        return any(parse(Channel, octets, record).topic == RAW for record in channels)
    except ValueError:
        return True  # damaged: as a recording it is told how
    finally:
        octets.close()
