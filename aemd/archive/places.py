"""Files by pattern, here or behind a scheme such as s3://: found, fetched to a local disk, put back.

Paths without a scheme need nothing; the others go through fsspec, with the package that serves their scheme. Only local
files are read and written by us: a remote one is fetched whole before, and put whole after, so that a reader can map
it, and a half-written one is never seen under its name.
"""

import glob
import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from aemd.errors import AemdError, RecordingError, UsageError

__all__ = ["Found", "Place", "find", "is_pattern"]

_SCRATCH = ".aemd-scratch"
_PIECE_BYTES = 1 << 20


def is_pattern(name: str) -> bool:
    """Tell whether a name means an archive: a folder, or with wildcards or a scheme; not a file that is there."""
    path = Path(name)
    if path.exists():
        return path.is_dir() and path.suffix != ".mcap"
    return glob.has_magic(name) or "://" in name


@dataclass(frozen=True, slots=True)
class Place:
    """A file or a folder, here or behind a scheme."""

    url: str

    @property
    def is_local(self) -> bool:
        """Whether it has no scheme."""
        return "://" not in self.url

    def __truediv__(self, name: str) -> "Place":
        return Place(f"{self.url.rstrip('/')}/{name}")

    def stamp(self) -> str:
        """Return what changes when the file does: its size, and its time or tag; "" where there is no file."""
        if self.is_local:
            try:
                state = Path(self.url).stat()
            except OSError:
                return ""
            return f"{state.st_size} {state.st_mtime_ns}"
        with self._or_refuse("read"):
            system, path = self._system()
            try:
                told = system.info(path)
            except FileNotFoundError:
                return ""
        tags = [str(told[key]) for key in ("ETag", "mtime", "LastModified", "last_modified", "created") if key in told]
        return " ".join([str(told["size"]), *tags[:1]])

    def checksum(self) -> str:
        """Return the SHA-256 of the file.

        Raises:
            RecordingError: it cannot be read.
        """
        digest = hashlib.sha256()
        with self._or_refuse("read"), self._open() as file:
            while piece := file.read(_PIECE_BYTES):
                digest.update(piece)
        return digest.hexdigest()

    def head(self, length: int) -> bytes:
        """Return the first bytes of the file.

        Raises:
            RecordingError: it cannot be read.
        """
        with self._or_refuse("read"), self._open() as file:
            octets: bytes = file.read(length)
        return octets

    def read_text(self) -> str | None:
        """Return the text of a small file; None where there is none.

        Raises:
            RecordingError: it cannot be read.
        """
        if not self.stamp():
            return None
        with self._or_refuse("read"), self._open() as file:
            return str(file.read(), "utf-8", "replace")

    def write_text(self, text: str) -> None:
        """Write a small file in one step: a reader sees the old one or the new one.

        Raises:
            RecordingError: it cannot be written.
        """
        self.write_bytes(text.encode())

    def write_bytes(self, octets: bytes) -> None:
        """Write a small file in one step; see `write_text`.

        Raises:
            RecordingError: it cannot be written.
        """
        with self.made() as path, self._or_refuse("written"):
            path.write_bytes(octets)

    @contextmanager
    def fetched(self) -> Iterator[Path]:
        """Give the file on a local disk; a copy of a remote one is removed afterwards.

        Raises:
            RecordingError: it cannot be fetched.
        """
        if self.is_local:
            yield Path(self.url)
            return
        with TemporaryDirectory() as folder:
            local = Path(folder) / PurePosixPath(self.url).name
            with self._or_refuse("read"):
                system, path = self._system()
                system.get_file(path, str(local))
            yield local

    @contextmanager
    def made(self) -> Iterator[Path]:
        """Give a path to write to, and then put what is there under this name, in one step.

        Raises:
            RecordingError: it cannot be written.
        """
        with self._or_refuse("written"):
            scratch = Path(self.url).parent / _SCRATCH if self.is_local else None
            if scratch is not None:
                scratch.mkdir(parents=True, exist_ok=True)
            folder = TemporaryDirectory(dir=scratch)
        with folder as name:
            made = Path(name) / PurePosixPath(self.url).name
            yield made
            with self._or_refuse("written"):
                if self.is_local:
                    made.replace(self.url)
                else:
                    system, path = self._system()
                    system.makedirs(path.rpartition("/")[0], exist_ok=True)
                    system.put_file(str(made), path)

    def tidy(self) -> None:
        """Remove what workers that were killed have left in this folder and those in it."""
        if self.is_local:
            for scratch in Path(self.url).rglob(_SCRATCH):
                shutil.rmtree(scratch, ignore_errors=True)

    def _open(self) -> Any:
        if self.is_local:
            return Path(self.url).open("rb")
        system, path = self._system()
        return system.open(path, "rb")

    def _system(self) -> tuple[Any, str]:
        return _system_of(self.url)

    def _or_refuse(self, done: str) -> AbstractContextManager[None]:
        return _or_refuse(self.url, done)


@dataclass(frozen=True, slots=True)
class Found:
    """A file that a pattern found."""

    place: Place
    name: str
    """Its path from the pattern's fixed part on, with / between folders."""


def find(pattern: str, *, besides: Place | None = None) -> list[Found]:
    """Return the files of a pattern in the order of their names; `**` stands for any folders.

    Args:
        pattern: a path with wildcards, with a scheme or without; a folder means every .mcap in it.
        besides: a folder whose files are left out: results in the midst of what they were made from.

    Raises:
        UsageError: there is none, or the scheme is unknown.
    """
    folder = pattern if "://" not in pattern and Path(pattern).is_dir() else ""
    if folder:
        pattern = str(Path(pattern) / "**" / "*.mcap")
    if "://" in pattern:
        system, path = _system_of(pattern)
        root = _fixed_part(path)
        with _or_refuse(pattern, "searched"):
            names = [name for name in system.glob(path) if not system.isdir(name)]
        found = [Found(Place(system.unstrip_protocol(name)), _below(name, root)) for name in names]
    else:
        root = _fixed_part(pattern)
        every = glob.glob(pattern, recursive=True)  # noqa: PTH207 - Path.glob takes no absolute pattern
        names = [name for name in every if Path(name).is_file()]
        found = [Found(Place(name), _below(name, root)) for name in names]
    if besides is not None:
        results = tuple(_forms(besides.url))
        folders = {_folder_of(item) for item in found}
        within = {folder for folder in folders if any(form.startswith(results) for form in _forms(folder))}
        found = [item for item in found if _folder_of(item) not in within]
    if not found and folder:
        raise UsageError(f"{folder}: holds no recording, no file *.mcap, nor do its folders")
    if not found:
        raise UsageError(f"{pattern}: no such file; put the pattern in quotes, so that the shell leaves it alone")
    return sorted(found, key=lambda item: item.name)


@contextmanager
def _or_refuse(url: str, done: str) -> Iterator[None]:
    """Tell in one line what the disk refuses; of a scheme, whatever its package raises: a wrong key is no OSError."""
    try:
        yield
    except OSError as error:
        raise RecordingError(f"{url}: cannot be {done}: {_said(error.strerror or error)}") from error
    except Exception as error:
        if "://" not in url or isinstance(error, AemdError):
            raise
        raise RecordingError(f"{url}: cannot be {done}: {_said(error)}") from error


def _said(error: Exception | str) -> str:
    """Return an error's text in one line, whatever a package put there; its type where there is none."""
    return " ".join(str(error).split()).lower() or type(error).__name__


def _system_of(url: str) -> tuple[Any, str]:
    if "::" in url:
        raise UsageError(f"{url}: is a chain of schemes, which is not supported; unpack it, or name the last one alone")
    try:
        core = import_module("fsspec.core")
    except ImportError as error:
        raise UsageError(f"{url}: needs the package fsspec; install aemd[remote]") from error
    with _or_refuse(url, "reached"):
        try:
            system, path = core.url_to_fs(url)
        except (ValueError, ImportError) as error:
            raise UsageError(f"{url}: {_said(error)}") from error
    return system, str(path)


def _folder_of(item: Found) -> str:
    """Return where a file lies, with the / at its end: a scheme's root is lost without."""
    return item.place.url[: item.place.url.rfind("/") + 1]


def _forms(folder: str) -> set[str]:
    """Return the names that tell whether one folder lies in another: of a local one, with links as named and followed.

    They are the same whichever of its schemes named the folder, or none.
    """
    if "://" in folder:
        system, path = _system_of(folder)
        protocols = (system.protocol,) if isinstance(system.protocol, str) else system.protocol
        if "file" not in protocols:
            return {str(system.unstrip_protocol(path)).rstrip("/") + "/"}
        folder = path
    names = (os.path.abspath(folder), os.path.realpath(folder))  # noqa: PTH100 - resolve() would follow links in both
    return {name.rstrip("/") + "/" for name in names}


def _fixed_part(pattern: str) -> str:
    """Return the folder above the first wildcard."""
    folders = pattern.split("/")[:-1]
    wild = next((at for at, folder in enumerate(folders) if glob.has_magic(folder)), len(folders))
    return "/".join(folders[:wild])


def _below(name: str, root: str) -> str:
    return name.removeprefix(root).lstrip("/")
