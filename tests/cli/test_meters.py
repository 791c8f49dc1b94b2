"""Meters that are absent, silent, strangers or mad: each is refused in one line."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from aemd.config import load_config
from aemd.session import simulated
from tests.cli.asking import Run, refused


@contextmanager
def talking(answer: bytes | None) -> Iterator[str]:
    """Something on a socket that is no 34410A: it answers every line with `answer`, or never."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            while True:
                try:
                    client, _ = server.accept()
                except OSError:
                    return
                with client, suppress(ConnectionError):  # a client may hang up on what it has not read
                    while answer is not None and client.recv(1000):
                        client.sendall(answer)
                    while answer is None and client.recv(1000):
                        pass

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"TCPIP0::127.0.0.1::{server.getsockname()[1]}::SOCKET"
        server.shutdown(socket.SHUT_RDWR)
    thread.join(timeout=10)


INSTRUMENTS = {
    "another instrument": (b"HEWLETT-PACKARD,34401A,0,11-5-2\n", "34401A"),
    "a server of something else": (b"HTTP/1.1 400 Bad Request\n", "HTTP/1.1 400"),
    "no text": (b"\xff\xfe\x00\n", "TCPIP0"),
    "silence": (None, "no whole answer"),
}


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_a_wrong_or_silent_instrument_is_refused(name: str, aemd: Run, tmp_path: Path) -> None:
    answer, says = INSTRUMENTS[name]
    config = tmp_path / "c.toml"
    with talking(answer) as resource:
        config.write_text(f'[instrument]\nresource = "{resource}"\ntimeout_s = 0.3\n')
        code, out, err = aemd("acquire", config, "--seconds", 1, "--out", tmp_path)

    line = refused(code, err, out, 1)
    assert says in line
    assert resource in line
    assert not list(tmp_path.glob("*.mcap*"))


@pytest.mark.parametrize(
    "resource",
    ["TCPIP0::127.0.0.1::1::SOCKET", "TCPIP0::127.0.0.1::SOCKET", "nonsense", "USB0::0x0957::0x0607::NONE::INSTR"],
)
def test_a_resource_that_cannot_be_reached_is_refused(resource: str, aemd: Run, tmp_path: Path) -> None:
    code, out, err = aemd("acquire", "--resource", resource, "--seconds", 1, "--out", tmp_path)

    assert resource in refused(code, err, out, 1)


def test_an_interval_that_the_meter_cannot_keep_is_refused_with_the_arithmetic(aemd: Run, tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text('[instrument]\nresource = "sim"\nnplc = 2\nautozero = "on"\ninterval_s = 0.06712\n')

    code, out, err = aemd("acquire", config, "--seconds", 1, "--out", tmp_path)

    line = refused(code, err, out, 1)
    assert "2 x 40 ms (2 PLC at 50 Hz)" in line
    assert "0.08 s or more" in line


ODD_ANSWERS = {
    "SAMP:COUN?": (b"nan", "SAMP:COUN?: the answer 'nan' is not a number above 0"),
    "SAMP:TIM?": (b"inf", "SAMP:TIM?: the answer 'inf' is not a number above 0"),
    "SYST:LFR?": (b"0", "SYST:LFR?: the answer '0' is not a number above 0"),
    "STAT:OPER:ENAB?;:DATA:POIN?;:STAT:QUES:EVEN?": (b"1;-5;0", "the answer '1;-5;0' is not 3 numbers"),
}


@contextmanager
def odd(question: str, answer: bytes) -> Iterator[str]:
    """A simulated meter behind a link that changes the answer to one question."""
    with simulated(load_config(None)) as resource, socket.create_server(("127.0.0.1", 0)) as server:
        port = int(resource.split("::")[2])

        def serve() -> None:
            client, _ = server.accept()
            with client, socket.create_connection(("127.0.0.1", port)) as meter, client.makefile("rb") as lines:
                for line in lines:
                    meter.sendall(line)
                    if b"?" in line:
                        said = meter.recv(1 << 16)
                        # Of a numbered message, whose last answer is its number.
                        asked = line.strip().decode().removesuffix(";:STAT:QUES:ENAB?")
                        is_it = asked.split(";:", 1)[-1] == question
                        client.sendall(answer + b";" + said.rpartition(b";")[2] if is_it else said)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"TCPIP0::127.0.0.1::{server.getsockname()[1]}::SOCKET"
    thread.join(timeout=10)


@pytest.mark.parametrize("question", ODD_ANSWERS)
def test_a_meter_whose_answers_make_no_sense_is_refused(question: str, aemd: Run, tmp_path: Path) -> None:
    answer, says = ODD_ANSWERS[question]
    config = tmp_path / "c.toml"
    with odd(question, answer) as resource:
        config.write_text(f'[instrument]\nresource = "{resource}"\n[acquisition]\ngive_up_s = 0.3\n')
        code, out, err = aemd("acquire", config, "--seconds", 1, "--out", tmp_path)

    line = err.strip().splitlines()[-1]
    assert code == 1
    assert line.startswith(f"aemd: {resource}: ")
    assert says in line
    assert "Traceback" not in err
    assert out == ""


def test_a_peer_that_never_ends_its_line_is_refused(aemd: Run, tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    with talking(b"x" * 100_000) as resource:
        config.write_text(f'[instrument]\nresource = "{resource}"\ntimeout_s = 1.0\n')
        code, out, err = aemd("acquire", config, "--seconds", 1, "--out", tmp_path)

    assert "no end of line" in refused(code, err, out, 1)


def test_what_looks_like_marks_of_the_table_is_shown_as_it_is(
    aemd: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    with talking(b"Agilent Technologies,[/red]34410A,:dog:,[bold]2.35\n") as resource:
        _, host, port, _ = resource.split("::")
        code, out, err = aemd("devices", "--timeout", 60, "--host", f"{host}:{port}", "--host", "[/x]:y")
        assert code == 0, err
        assert "Agilent Technologies,[/red]34410A,:dog:,[bold]2.35" in out
        assert "[/x]:y" in out

        code, out, err = aemd("doctor", "--resource", resource)
        assert code == 1, err
        assert "[/red]34410A,:dog:,[bold]2.35" in out

    config = tmp_path / "c.toml"
    config.write_text('[instrument]\nresource = "sim"\nnplc = 10\ninterval_s = 0.06712\n')
    code, out, err = aemd("doctor", config)
    assert code == 1, err
    assert "the config's [instrument] asks for" in out

    code, out, err = aemd("doctor", "--resource", "USB0::[/x]::1::2::INSTR")
    assert code == 1, err
    assert "USB0::[/x]::1::2::INSTR" in out.splitlines()[0]


def test_the_resource_of_a_device_is_whole_on_one_line_of_a_narrow_terminal(
    aemd: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with talking(b"Agilent Technologies,34410A,MY47006594,2.35-2.35-0.09-46-09\n") as resource:
        _, host, port, _ = resource.split("::")
        code, out, _ = aemd("devices", "--timeout", 2, "--host", f"{host}:{port}")

    assert code == 0
    assert resource in out
