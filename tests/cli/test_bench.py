"""Commands at the bench: a session on the simulated meter, signals, configs."""

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from tests.cli.asking import Run, refused


def test_an_acquisition_leaves_a_finished_recording_and_a_summary_that_agrees_with_it(
    aemd: Run, quick: Path, tmp_path: Path
) -> None:
    code, out, _ = aemd("acquire", quick, "--seconds", 1, "--out", tmp_path, "--json")

    found = json.loads(out)
    assert code == 0
    assert list(found) == [
        "file", "readings", "lost", "not_written", "gaps", "outages", "rate_hz", "duration_s", "estimator",
        "raw_variance_V2", "estimate_variance_V2",
    ]  # fmt: skip
    assert (found["readings"], found["lost"], found["gaps"], found["estimator"]) == (500, 0, 0, "aem")
    assert found["rate_hz"] == pytest.approx(500, rel=0.1)  # one second; on a busy machine its ends are known to 20 ms
    with Path(found["file"]).open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        raw = [
            (message.sequence, decoded.value)
            for _, channel, message, decoded in reader.iter_decoded_messages()
            if channel.topic == "/dmm/raw"
        ]
    assert [sequence for sequence, _ in raw] == list(range(500))
    assert np.var([value for _, value in raw]) == pytest.approx(found["raw_variance_V2"])


def test_a_recording_tells_what_it_was_made_with(aemd: Run, recording: Path, quick: Path) -> None:
    with recording.open("rb") as file:
        reader = make_reader(file)
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        attachments = {record.name: record.data for record in reader.iter_attachments()}

    assert metadata["aemd.instrument"]["model"] == "34410A"
    assert float(metadata["aemd.instrument"]["SAMP:TIM?"]) == pytest.approx(0.002)
    assert metadata["aemd.estimator"]["name"] == "aem"
    assert metadata["aemd.close"]["reason"] == "stop"
    assert int(metadata["aemd.close"]["acquired"]) == 500
    assert 0 < float(metadata["aemd.clock"]["uncertainty_s"]) < 2e-3
    assert attachments["config.toml"].decode() == quick.read_text()


def test_ctrl_c_stops_cleanly_and_finalises_the_file(quick: Path, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "aemd", "acquire", quick, "--out", tmp_path, "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        wait_for(lambda: any(path.stat().st_size > 8000 for path in tmp_path.glob("*.mcap.active")))
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    finally:
        process.kill()

    assert process.returncode == 0, err
    found = json.loads(out)
    assert found["readings"] > 0
    assert Path(found["file"]).exists()
    assert not list(tmp_path.glob("*.active"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("module", ["typer", "aemd.cli.common", "numpy", "numba", "aemd.session", "pyvisa"])
def test_a_signal_while_it_starts_leaves_no_half_made_file_and_no_traceback(
    module: str, number: signal.Signals, quick: Path, tmp_path: Path
) -> None:
    """Whatever it was doing when that module had been imported: importing more, reading its config, connecting."""
    words = ["-X", "importtime", "-m", "aemd", "acquire", str(quick), "--out", str(tmp_path / "rec")]
    words += ["--seconds", "20"]  # an end, if the signal is lost
    process = subprocess.Popen([sys.executable, *words], stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        imported = (line.rpartition("|")[2].strip() for line in process.stderr)
        assert module in imported, f"{module} was never imported"
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()

    assert process.returncode in (0, 130, -number), err  # the last before our handlers are there
    said = [line for line in err.splitlines() if not line.startswith("import time:")]
    assert "Traceback (most recent call last):" not in said
    assert not list((tmp_path / "rec").glob("*.active"))


def test_the_simulated_meter_serves_anyones_client() -> None:
    process = subprocess.Popen([sys.executable, "-m", "aemd", "sim", "--port", "0"], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        resource = process.stdout.readline().strip()
        port = int(resource.split("::")[2])
        with socket.create_connection(("127.0.0.1", port), timeout=10) as client:
            client.sendall(b"*IDN?\n")
            answer = client.recv(1000)
        process.send_signal(signal.SIGTERM)
        code = process.wait(timeout=30)
        process.stdout.close()
    finally:
        process.kill()

    assert answer.startswith(b"Agilent Technologies,34410A,")
    assert code == 0


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it never came"
        time.sleep(0.05)


def test_a_folder_that_cannot_be_written_is_refused(aemd: Run, quick: Path, tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")

    code, out, err = aemd("acquire", quick, "--seconds", 1, "--out", blocked / "rec")

    assert str(blocked) in refused(code, err, out, 1)


def test_a_broken_config_exits_with_78(aemd: Run, tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text('[instrument]\nresource = "sim"\nnplc = 3\n')

    for words in (["check-config", config], ["acquire", config, "--seconds", 1], ["sim", config, "--port", 0]):
        code, out, err = aemd(*words)
        assert "nplc = 3: must be one of" in refused(code, err, out, 78)


def test_a_config_is_shown_with_its_defaults_and_reads_back_the_same(aemd: Run, quick: Path, tmp_path: Path) -> None:
    shown = aemd("check-config", quick)[1]
    again = tmp_path / "again.toml"
    again.write_text(shown)

    assert "flush_interval_s = 1.0" in shown
    assert aemd("check-config", again)[1] == shown
    assert json.loads(aemd("check-config", quick, "--json")[1])["instrument"]["nplc"] == 0.02
