"""The manifest beside an archive's results: what was made of which file, so that a rerun makes only what is missing."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field

from aemd import __version__
from aemd.archive.places import Place
from aemd.errors import RecordingError

__all__ = ["FORM", "Entry", "Manifest"]

NAME = "manifest.json"
FORM = 2
"""Of the results and states: raised where the same version number makes others than it did. Results of form 1 had the
state of the recorded estimator, whichever had made them."""


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
    """What was asked for: the estimator with its options, topic, field and time; empty for what is recorded."""
    before_sha256: str
    """Of the state that the estimator had before the file's first reading; "" for none."""
    state_sha256: str
    """Of its state after the last; "" where the run ends, and nothing follows."""
    aemd: str = __version__
    form: int = 1
    """What `FORM` was when it was made; a manifest that does not tell is of the first."""


@dataclass(slots=True)
class Manifest:
    """All entries, by the name of the file in the archive."""

    folder: Place
    entries: dict[str, Entry] = field(default_factory=dict)
    begun: set[str] = field(default_factory=set)
    """Names whose results are ours though no entry tells of them yet: what a kill leaves behind may be replaced."""

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
            told = json.loads(text)
            entries = {name: Entry(**entry) for name, entry in told["files"].items()}
            return cls(folder, entries, {str(name) for name in told.get("begun", [])})
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise RecordingError(
                f"{folder.url}/{NAME}: is no manifest of an archive; choose another folder, or move it away"
            ) from error

    def begin(self, names: Iterable[str]) -> None:
        """Note, and write, which results are about to be made, before there is any.

        Raises:
            RecordingError: it cannot be written.
        """
        made = {name for name in names if name not in self.entries and not (self.folder / name).stamp()}
        if not made <= self.begun:
            self.begun |= made
            self.save()

    def end(self) -> None:
        """Write that nothing is under way any more.

        Raises:
            RecordingError: it cannot be written.
        """
        self.begun = {name for name in self.begun - self.entries.keys() if (self.folder / name).stamp()}
        self.save()

    def save(self) -> None:
        """Write it, in one step.

        Raises:
            RecordingError: it cannot be written.
        """
        files = {name: asdict(entry) for name, entry in sorted(self.entries.items())}
        begun = {"begun": sorted(self.begun)} if self.begun else {}
        (self.folder / NAME).write_text(json.dumps({"files": files} | begun, indent=1) + "\n")

    def holds(self, name: str, out: Place, source: Place, asked: Mapping[str, str], before_sha256: str) -> bool:
        """Tell whether the result is there, made by this version from this file, state and estimator, and unchanged.

        Sizes and times are compared first; where they differ, checksums decide.
        """
        entry = self.entries.get(name)
        return (
            entry is not None
            and (entry.aemd, entry.form) == (__version__, FORM)
            and dict(entry.asked) == dict(asked)
            and entry.before_sha256 == before_sha256
            and _is_unchanged(source, entry.source_stamp, entry.source_sha256)
            and _is_unchanged(out, entry.out_stamp, entry.out_sha256)
        )

    def made(self, name: str, out: Place) -> bool:
        """Tell whether what is at the place of a result may be replaced: there is nothing, or it is one."""
        return name in self.entries or name in self.begun or not out.stamp()


def _is_unchanged(place: Place, stamp: str, sha256: str) -> bool:
    now = place.stamp()
    return bool(now) and (now == stamp or place.checksum() == sha256)
