"""What every command shares: usage errors, odd names, a quick start."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.asking import Run, refused

USAGE = {
    "no command": (["nope"], "No such command 'nope'; see aemd --help"),
    "no file": (["replay"], "Missing argument 'FILE'; see aemd replay --help"),
    "a negative time": (["acquire", "--seconds", "-1"], "--seconds -1: must be a finite number above 0"),
    "no number": (["acquire", "--seconds", "abc"], "--seconds"),
    "not a number": (["acquire", "--seconds", "nan"], "--seconds nan: must be a finite number above 0"),
    "endless": (["acquire", "--seconds", "inf"], "--seconds inf: must be a finite number above 0"),
    "an unknown option": (["info", "x.mcap", "--yaml"], "--yaml"),
    "a picture of no kind": (["replay", "x.mcap", "--plot", "picture"], "must end in .png, .pdf or .svg"),
    "a picture nowhere": (["replay", "x.mcap", "--plot", "no/such/a.png"], "no such folder"),
}


@pytest.mark.parametrize("name", USAGE)
def test_a_wrong_command_line_is_one_line_and_exit_code_2(name: str, aemd: Run) -> None:
    words, says = USAGE[name]

    code, out, err = aemd(*words)

    assert says in refused(code, err, out, 2)


def test_names_with_brackets_are_shown_as_they_are(aemd: Run, tmp_path: Path) -> None:
    table, out_file = tmp_path / "log.csv", tmp_path / "[bold][" / "x.mcap"
    out_file.parent.mkdir()
    table.write_text("time,value\n0.0,1.0\n0.1,2.0\n")

    assert aemd("import", table, "-o", out_file, "--unit", "[/x]")[0] == 0
    code, out, _ = aemd("info", out_file)

    assert code == 0
    assert "[/x]" in out
    assert "[bold][" in "".join(out.split())


def test_help_starts_without_the_heavy_packages() -> None:
    code = "import sys; sys.argv=['aemd','--help']\ntry:\n import aemd.cli; aemd.cli.main()\nexcept SystemExit: pass\n"
    code += "print([m for m in ('numba', 'scipy', 'matplotlib', 'pyvisa', 'pyarrow') if m in sys.modules])"

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env={**os.environ})

    assert done.stdout.strip().endswith("[]")
