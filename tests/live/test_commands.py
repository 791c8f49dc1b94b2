"""`acquire --live`, `status` and `watch`, as a user gives them."""

import fcntl
import json
import os
import pty
import re
import socket
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from typer.main import get_command

from aemd.cli import app, main
from aemd.cli.common import AddressCommand
from aemd.errors import InstrumentError, UsageError
from aemd.live.access import Address
from aemd.live.options import LiveOptions
from aemd.live.runtime import Running, announced, find_running
from aemd.live.view import open_views
from aemd.watch import remote
from aemd.watch.terminal import draw_braille, fill_dots
from tests.live.browser import acquiring

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def aemd(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command line in this process; return exit code, stdout and stderr."""

    def run(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["aemd", *words])
        with pytest.raises(SystemExit) as stop:
            main()
        return int(stop.value.code or 0), *capsys.readouterr()

    return run


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """An acquisition that this module's commands find, and no other."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("runtime")))
        patch.delenv("RUNTIME_DIRECTORY", raising=False)
        patch.setattr("tempfile.tempdir", str(tmp_path_factory.mktemp("shared")))  # where other tests' are announced
        with acquiring(tmp_path_factory.mktemp("recordings")) as (url, _):
            yield url


def test_status_finds_the_running_acquisition_and_says_how_it_fares(running: str, aemd: Run) -> None:
    code, out, err = aemd("status")

    assert (code, err) == (0, "")
    for word in ("health", "ok", "rate", "lost", "mcap.active", "disk free", "window", "last", "estimate", running):
        assert word in out


def test_status_as_json_stands_alone_and_its_readings_grow(running: str, aemd: Run) -> None:
    first = json.loads(aemd("status", "--json")[1])
    deadline = time.monotonic() + 60
    while (second := json.loads(aemd("status", running, "--json")[1]))["readings"] <= first["readings"]:
        assert time.monotonic() < deadline

    assert second["file_bytes"] > 0
    assert second["pid"] == first["pid"]
    assert second["lost"] == 0


def test_watch_shows_the_plot_on_a_terminal_and_q_ends_it(running: str) -> None:
    child, terminal = pty.fork()
    if child == 0:
        os.environ["TERM"] = "xterm-256color"
        os.execv(sys.executable, [sys.executable, "-m", "aemd", "watch", running])
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 90, 0, 0))
    seen, deadline, asked = b"", time.monotonic() + 60, False
    try:
        while time.monotonic() < deadline:
            try:
                seen += os.read(terminal, 1 << 16)
            except OSError:  # the child has closed its end
                break
            if not asked and re.search("[\u2801-\u28ff]", seen.decode(errors="replace")):
                asked = True
                os.write(terminal, b"q")
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    finally:
        os.close(terminal)

    text = seen.decode(errors="replace")
    assert asked, text
    assert code == 0
    assert "34410A" in text
    assert "Traceback" not in text


def test_watch_needs_a_terminal_and_says_so(running: str, aemd: Run) -> None:
    code, out, err = aemd("watch", running)

    assert (code, out) == (2, "")
    assert "stdout is no terminal" in err


@pytest.mark.parametrize(
    ("url", "expected"),
    [("http://127.0.0.1:1/", 1), ("nonsense", 2), ("http://[", 2), ("https://127.0.0.1:8410/", 2)],
)
def test_an_address_where_nobody_is_is_one_line(url: str, expected: int, aemd: Run) -> None:
    code, out, err = aemd("status", url)

    assert (code, out) == (expected, "")
    assert len(err.splitlines()) == 1
    assert url in err


def test_where_none_runs_status_says_how_to_start_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "find_running", list)
    monkeypatch.setattr(remote, "Address", lambda: Address(port=1))
    with pytest.raises(InstrumentError, match="start one with `aemd acquire --live`"):
        remote.find_url(None)


def test_what_a_running_view_announces_is_for_its_owner_alone_and_goes_with_it(tmp_path: Path) -> None:
    environment = {"XDG_RUNTIME_DIR": str(tmp_path)}
    with announced("http://x/?token=t", "34410A", environment) as path:
        assert path is not None
        assert path.stat().st_mode & 0o077 == 0
        assert path.parent.stat().st_mode & 0o077 == 0
        assert Running(os.getpid(), "http://x/?token=t", "34410A") in find_running(environment)

    assert not path.exists()


def test_what_a_killed_process_announced_is_passed_over(tmp_path: Path) -> None:
    (tmp_path / "aemd").mkdir()
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    (tmp_path / "aemd" / "a.json").write_text(json.dumps(asdict(Running(gone.pid, "http://x/", "34410A"))))
    (tmp_path / "aemd" / "b.json").write_text("{")

    assert all(one.pid != gone.pid for one in find_running({"XDG_RUNTIME_DIR": str(tmp_path)}))


@pytest.mark.parametrize(
    ("words", "address"),
    [
        (["--live"], ""),
        (["--live", "bench.toml"], ""),
        (["--live", "--json"], ""),
        (["--live", "0"], "0"),
        (["--live", ":0", "bench.toml"], ":0"),
        (["--live", "0.0.0.0", "--json"], "0.0.0.0"),
        (["--live", "[::1]:80"], "[::1]:80"),
        (["--live=meter"], "meter"),
        (["bench.toml"], None),
    ],
)
def test_an_address_option_takes_the_next_word_only_if_it_is_an_address(words: list[str], address: str | None) -> None:
    command = get_command(app).commands["acquire"]  # type: ignore[attr-defined]  # it is a group
    assert isinstance(command, AddressCommand)
    assert command.make_context("acquire", words).params["live"] == address


def test_braille_shows_every_column_from_its_least_to_its_greatest_value() -> None:
    low, high = np.array([0.0, 1.0, np.nan, 2.0]), np.array([0.0, 3.0, np.nan, 2.0])

    mask = fill_dots((4, 4), np.array([0.0, 0.25, 0.5, 0.75]), low, high, (0.0, 3.0))

    assert mask.T.astype(int).tolist() == [[0, 0, 0, 1], [1, 1, 1, 0], [0, 0, 0, 0], [0, 1, 0, 0]]
    assert [line.plain for line in draw_braille([(mask, "red")])] == ["⡸⠐"]


def test_the_default_port_gives_way_where_it_is_taken_and_one_that_was_named_does_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with open_views("0", LiveOptions()) as first:
        port = urlsplit(first[0].url).port
        assert port is not None
        monkeypatch.setattr("aemd.live.access.Address.__init__.__defaults__", ("127.0.0.1", port))
        with open_views("", LiveOptions()) as second:
            assert urlsplit(second[0].url).port not in {None, 0, port}
        with pytest.raises(UsageError, match="is taken"), open_views(str(port), LiveOptions()):
            pass


def test_an_address_that_is_not_this_machines_is_refused_with_the_way_out() -> None:
    # 192.0.2.0/24 is for documentation (RFC 5737): no machine has one.
    for elsewhere in ("192.0.2.1:0", "no-such-machine.invalid:0"):
        with (
            pytest.raises(UsageError, match=r"is no address of this machine; leave it out"),
            open_views(elsewhere, LiveOptions()),
        ):
            pass


def test_a_page_for_other_machines_says_what_to_open_there() -> None:
    with open_views("0.0.0.0:0", LiveOptions(token="0123456789abcdef")) as views:
        here, there = urlsplit(views[0].url), urlsplit(views[0].url_elsewhere)
    with open_views("127.0.0.1:0", LiveOptions()) as views:
        alone = views[0].url_elsewhere

    assert (there.hostname, there.port, there.query) == (socket.gethostname().lower(), here.port, here.query)
    assert here.hostname == "127.0.0.1"
    assert alone == ""
