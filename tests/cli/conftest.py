"""The command line run in this process, a quick simulated meter, and a recording made of it."""

import json
import sys
from pathlib import Path

import pytest

from aemd.cli import main
from tests.cli.asking import Run

QUICK = """
[instrument]
resource = "sim"
range_V = 10.0
nplc = 0.02
autozero = "off"
interval_s = 0.002
[simulator]
seed = 7
"""


@pytest.fixture
def aemd(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command line in this process; return exit code, stdout and stderr."""

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["aemd", *map(str, words)])
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.fixture
def quick(tmp_path: Path) -> Path:
    """A config whose readings come 500 a second."""
    path = tmp_path / "quick.toml"
    path.write_text(QUICK)
    return path


@pytest.fixture
def recording(aemd: Run, quick: Path, tmp_path: Path) -> Path:
    code, out, err = aemd("acquire", quick, "--seconds", 1, "--out", tmp_path / "rec", "--json")
    assert code == 0, err
    return Path(json.loads(out)["file"])
