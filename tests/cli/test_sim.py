"""`aemd sim`: its links, and faults from a file."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import pyvisa

from tests.cli.asking import Run, refused


@contextmanager
def simulated(*words: object) -> Iterator[dict[str, str]]:
    """Run `aemd sim` in a process of its own; the value is its resources by link."""
    command = [sys.executable, "-m", "aemd", "sim", "--port", "0", "--json", *map(str, words)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        lines = []
        while not lines or lines[-1] != "}\n":
            lines.append(process.stdout.readline())
            assert lines[-1], "it ended"
        yield json.loads("".join(lines))["resources"]
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=30) == 0
        process.stdout.close()
    finally:
        process.kill()


def ask(resource: str, question: str, timeout_ms: int = 5000) -> str:
    manager = pyvisa.ResourceManager("@py")
    try:
        line = manager.open_resource(
            resource, open_timeout=5000, timeout=timeout_ms, read_termination="\n", write_termination="\n"
        )
        answer = line.query(question)
        line.close()
        return answer
    finally:
        manager.close()


def test_every_link_is_served_and_named() -> None:
    with simulated("--serial") as resources:
        answers = {link: ask(resource, "*IDN?") for link, resource in resources.items()}

    assert list(answers) == ["socket", "vxi11", "serial"]
    assert {answer.split(",")[1] for answer in answers.values()} == {"34410A"}


def test_faults_come_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "faults.toml"
    file.write_text('memory_readings = 100\n[[faults]]\nkind = "silent"\nat_s = 0\n')
    with simulated("--faults", file) as resources:
        with pytest.raises(pyvisa.VisaIOError):
            ask(resources["socket"], "*IDN?", timeout_ms=200)

        assert ask(resources["socket"], "DATA:POIN:EVEN:THR? MAX") == "+100"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[faults]]\nkind = "sulk"\nat_s = 1\n', "faults.0.kind = \"sulk\": must be 'refuse', 'close'"),
        ('[[faults]]\nkind = "late"\n', "faults.0.at_s: missing"),
        ('[[faults]]\nkind = "nan"\nat_s = 1\n', "lasts_s must be above 0"),
        ("mode = 3\n", "mode: unknown"),
    ],
)
def test_a_wrong_file_of_faults_is_one_line(aemd: Run, tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "faults.toml"
    file.write_text(text)

    code, out, err = aemd("sim", "--port", 0, "--faults", file)

    assert message in refused(code, err, out, 78)
