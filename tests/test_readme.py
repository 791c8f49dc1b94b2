"""What the README says can be typed, can be typed."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from aemd.cli import app

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


@pytest.mark.timeout(400)  # a couple of dozen programs, one after the other
def test_every_command_in_the_readme_runs_in_its_order(tmp_path: Path) -> None:
    for name in ("config", "replay_data"):
        shutil.copytree(ROOT / name, tmp_path / name)
    blocks = re.findall(r"```console\n(.*?)```", README, re.DOTALL)
    lines = [line[2:] for block in blocks for line in block.splitlines() if line.startswith("$ aemd ")]

    for line in lines:
        words = [sys.executable, "-m", *shlex.split(line)]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False)
        assert done.returncode == 0, f"{line}\n{done.stderr}"
    assert len(lines) > 5


def test_every_command_is_in_the_readme_and_has_help() -> None:
    for command in app.registered_commands:
        assert command.callback is not None
        name = command.name or command.callback.__name__
        assert re.search(rf"\baemd {name}\b", README), f"aemd {name} is not in the README"
        assert command.callback.__doc__
