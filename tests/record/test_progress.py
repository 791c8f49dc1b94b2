"""On a terminal, what reads a whole file shows how far it is; elsewhere nothing stands between the results."""

import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from aemd.block import ESTIMATE, Batch
from aemd.record.description import Description
from aemd.record.writer import Recorder
from tests.record.made import readings_of


@pytest.fixture
def path(tmp_path: Path) -> Path:
    recorder = Recorder(tmp_path / "r.mcap", Description(interval_s=0.067), chunk_bytes=1 << 16)
    recorder.write(Batch(readings_of(60_000)), np.empty(0, ESTIMATE))
    return recorder.close("end")


def _on_a_terminal(*words: str | Path) -> tuple[int, str]:
    """Run aemd with a terminal of its own; return the exit code and what was drawn, without the colours."""
    ours, theirs = pty.openpty()
    settings = {**os.environ, "TERM": "xterm", "COLUMNS": "80", "LINES": "24"}
    child = subprocess.Popen(
        [sys.executable, "-m", "aemd", *map(str, words)], stdin=theirs, stdout=theirs, stderr=theirs, env=settings
    )
    os.close(theirs)
    drawn = b""
    try:
        while piece := os.read(ours, 1 << 16):
            drawn += piece
    except OSError:  # how a terminal says that nobody is on its other side any more
        pass
    os.close(ours)
    return child.wait(timeout=60), re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", drawn.decode())


@pytest.mark.parametrize(
    ("words", "bar"),
    [
        (("replay", "{file}"), "readings"),
        (("check", "{file}"), "MiB"),
        (("export", "{file}", "-o", "{folder}/r.csv"), "readings"),
    ],
    ids=["replay", "check", "export"],
)
def test_a_bar_runs_to_its_end_and_makes_way_for_the_result(path: Path, words: tuple[str, ...], bar: str) -> None:
    code, drawn = _on_a_terminal(*(word.format(file=path, folder=path.parent) for word in words))

    bars = list(re.finditer(rf"{bar} \S+ +(\d+)/(\d+)", drawn))
    counts = [(int(found[1]), int(found[2])) for found in bars]
    assert code == 0
    assert [done for done, _ in counts] == sorted(done for done, _ in counts)
    assert counts[-1][0] == counts[-1][1] > 0
    assert "60000" in drawn[bars[-1].end() :].replace(",", "")
