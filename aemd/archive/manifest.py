"""The manifest beside an archive's results: what was made of which file, so that a rerun makes only what is missing."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from aemd import __version__
from aemd.archive.places import Place
from aemd.errors import RecordingError

__all__ = ["Entry", "Manifest"]

NAME = "manifest.json"


@dataclass(frozen=True, slots=True)
class Entry:
    """What was made of one file."""

    source: str
    """Where the file was."""
    source_stamp: str
    """Its size, and time or tag."""
    source_sha256: str
    out_stamp: str
    out_sha256: str
    readings: int
    estimates: int
    asked: Mapping[str, str]
    """The estimator that was asked for, with its options; empty for the recorded one."""
    before_sha256: str
    """Of the state that the estimator had before the file's first reading; "" for none."""
    state_sha256: str
    """Of its state after the last; "" where the run ends, and nothing follows."""
    aemd: str = __version__


@dataclass(slots=True)
class Manifest:
    """All entries, by the name of the file in the archive."""

    folder: Place
    entries: dict[str, Entry] = field(default_factory=dict)

    @classmethod
    def load(cls, folder: Place) -> "Manifest":
        """Read the manifest of a folder; an empty one where there is none.

        Raises:
            RecordingError: it cannot be read, or is none.
        """
        text = (folder / NAME).read_text()
        if text is None:
            return cls(folder)
        try:
            return cls(folder, {name: Entry(**entry) for name, entry in json.loads(text)["files"].items()})
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise RecordingError(
                f"{folder.url}/{NAME}: is no manifest of an archive; choose another folder, or move it away"
            ) from error

    def save(self) -> None:
        """Write it, in one step.

        Raises:
            RecordingError: it cannot be written.
        """
        files = {name: asdict(entry) for name, entry in sorted(self.entries.items())}
        (self.folder / NAME).write_text(json.dumps({"files": files}, indent=1) + "\n")

    def holds(self, name: str, out: Place, source: Place, asked: Mapping[str, str], before_sha256: str) -> bool:
        """Tell whether the result is there, made by this version from this file, state and estimator, and unchanged.

        Sizes and times are compared first; where they differ, checksums decide.
        """
        entry = self.entries.get(name)
        return (
            entry is not None
            and entry.aemd == __version__
            and dict(entry.asked) == dict(asked)
            and entry.before_sha256 == before_sha256
            and _is_unchanged(source, entry.source_stamp, entry.source_sha256)
            and _is_unchanged(out, entry.out_stamp, entry.out_sha256)
        )

    def made(self, name: str, out: Place) -> bool:
        """Tell whether what is at the place of a result may be replaced: there is nothing, or it is one."""
        return name in self.entries or not out.stamp()


def _is_unchanged(place: Place, stamp: str, sha256: str) -> bool:
    now = place.stamp()
    return bool(now) and (now == stamp or place.checksum() == sha256)
