"""What an archive cannot read or make is one line, whatever lies beneath it raises; and what it kept calls nothing."""

import pickle
import re
from pathlib import Path

import pytest
from numpy.testing import runstring

from aemd.archive import replay_archive
from aemd.archive.state import load_state
from aemd.errors import RecordingError, UsageError
from tests.archive.made import readings_of, write


@pytest.mark.parametrize("refused", ["glob", "info", "get_file"])
def test_what_a_scheme_refuses_is_one_line_whatever_its_package_raises(tmp_path: Path, refused: str) -> None:
    fsspec = pytest.importorskip("fsspec")
    memory = fsspec.get_filesystem_class("memory")

    class NoCredentialsError(Exception):  # as a package of a cloud raises it, which is no OSError
        pass

    def refuse(*_: object, **__: object) -> None:
        raise NoCredentialsError("Unable to locate credentials")

    own = {"protocol": "refusing", "_strip_protocol": vars(fsspec.AbstractFileSystem)["_strip_protocol"]}
    kind = type("Refusing", (memory,), own | {"store": {}, "pseudo_dirs": [""], refused: refuse})
    fsspec.register_implementation("refusing", kind, clobber=True)
    local = write(tmp_path / "a.mcap", readings_of(200))
    memory.put_file(kind(), str(local), "/in/a.mcap")

    try:
        done = replay_archive("refusing:///in/*.mcap", str(tmp_path / "out"), estimator="kalman").failed
    except RecordingError as error:
        done = (str(error),)

    assert len(done) == 1
    assert re.search(r"refusing:.*mcap: cannot be (read|searched): unable to locate credentials$", done[0])


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError(), "ValueError"),
        (ValueError("\n"), "ValueError"),
        (ValueError("No\nhost\n"), "no host"),
        (OSError("Connection\n  refused"), "connection refused"),
        (OSError(5, "Timed\nout"), "timed out"),
        (OSError(), "OSError"),
        (RuntimeError("Two\nlines"), "two lines"),
    ],
)
@pytest.mark.parametrize("refused", ["__init__", "glob"])
def test_an_error_of_several_lines_or_none_is_one_line(
    tmp_path: Path, error: Exception, said: str, refused: str
) -> None:
    fsspec = pytest.importorskip("fsspec")
    memory = fsspec.get_filesystem_class("memory")

    def refuse(*_: object, **__: object) -> None:
        raise error

    own = {"protocol": "lines", "_strip_protocol": vars(fsspec.AbstractFileSystem)["_strip_protocol"]}
    kind = type("Lines", (memory,), own | {refused: refuse})
    fsspec.register_implementation("lines", kind, clobber=True)

    with pytest.raises((RecordingError, UsageError)) as caught:
        replay_archive("lines:///in/*.mcap", str(tmp_path / "out"))
    assert re.fullmatch(rf"lines:///in/\*\.mcap: (cannot be \w+: )?{said}", str(caught.value))


@pytest.mark.parametrize(
    ("pattern", "complaint"),
    [
        ("nothing-*.mcap", r"nothing-\*\.mcap: no such file; put the pattern in quotes"),
        ("nosuch://x/*.mcap", r"nosuch://x/\*\.mcap: protocol not known: nosuch"),
        ("zip://*.mcap::/x.zip", r"zip://\*\.mcap::/x\.zip: is a chain of schemes, which is not supported; unpack it"),
    ],
)
def test_an_archive_that_is_not_there_is_one_line(tmp_path: Path, pattern: str, complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint):
        replay_archive(pattern, str(tmp_path / "out"))


def test_a_folder_without_a_recording_is_told_to_be_one(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    with pytest.raises(UsageError, match=r"in: holds no recording, no file \*\.mcap"):
        replay_archive(str(tmp_path / "in"), str(tmp_path / "out"))


def test_a_manifest_that_is_none_is_one_line(tmp_path: Path) -> None:
    write(tmp_path / "in" / "a.mcap", readings_of(200))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "manifest.json").write_text("[1]")

    with pytest.raises(RecordingError, match=r"manifest\.json: is no manifest of an archive; choose another folder"):
        replay_archive(f"{tmp_path}/in/**/*.mcap", str(tmp_path / "out"))


class _Called:
    """What a pickle calls when it is read: a function of numpy that executes its text."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return runstring, (f"open({str(self.path)!r}, 'w')", {})


@pytest.mark.parametrize("wrapped", [False, True])
def test_a_state_calls_nothing_when_it_is_read(tmp_path: Path, *, wrapped: bool) -> None:
    called = tmp_path / "called"
    octets = pickle.dumps((_Called(called), 1) if wrapped else _Called(called), protocol=4)

    with pytest.raises(RecordingError, match=r"an estimator's state is damaged: .*; remove it to begin anew$"):
        load_state(octets, 0.067)
    assert not called.exists()


@pytest.mark.parametrize(
    "octets",
    [
        b"",
        b"[" * 100_000,
        b"[]",
        b"null",
        b'{"estimator": {}, "state": {}}',
        b'{"estimator": {"name": "lms"}, "state": {}}',
        b'{"estimator": {"name": "lms"}, "state": []}',
        b'{"estimator": {"name": "nosuch"}, "state": {}}',
        b'{"estimator": [], "state": {}}',
        b'{"estimator": {"name": "lms", "mu": 1}, "state": {}}',
        b"\xff\xfe",
    ],
)
def test_a_state_that_is_none_is_one_line(octets: bytes) -> None:
    with pytest.raises(RecordingError, match=r"^an estimator's state is damaged: [^\n]+; remove it to begin anew$"):
        load_state(octets, 0.067)


def test_a_file_in_the_place_of_the_folder_is_one_line(tmp_path: Path) -> None:
    write(tmp_path / "in" / "a.mcap", readings_of(100))
    (tmp_path / "out").write_text("mine")

    with pytest.raises(RecordingError, match=r"out: is a file: name a folder by --out$"):
        replay_archive(str(tmp_path / "in"), str(tmp_path / "out"))
    assert (tmp_path / "out").read_text() == "mine"
