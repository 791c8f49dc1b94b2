"""The command line as a user meets it: a session on the simulated meter, and every way to ask for the impossible."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from aemd.cli import main
from aemd.config import load_config
from aemd.session import simulated

Run = Callable[..., tuple[int, str, str]]

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


def test_an_acquisition_leaves_a_finished_recording_and_a_summary_that_agrees_with_it(
    aemd: Run, quick: Path, tmp_path: Path
) -> None:
    code, out, _ = aemd("acquire", quick, "--seconds", 1, "--out", tmp_path, "--json")

    found = json.loads(out)
    assert code == 0
    assert list(found) == [
        "file", "readings", "lost", "gaps", "rate_hz", "duration_s", "estimator", "raw_variance_V2",
        "estimate_variance_V2",
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


def test_a_replay_gives_the_same_bits_and_says_so(aemd: Run, recording: Path) -> None:
    code, out, _ = aemd("replay", recording, "--check", "--json")

    found = json.loads(out)
    assert code == 0
    assert found["identical"] is True
    assert found["readings"] == 500


def test_a_replay_that_differs_says_where_and_fails(aemd: Run, recording: Path, tmp_path: Path) -> None:
    """The recorded estimator's name is changed on the way to another file: its estimates no longer come out again."""
    other = tmp_path / "other.mcap"
    aemd("replay", recording, "--estimator", "kalman", "--out", other)
    forged = tmp_path / "forged.mcap"
    name = b"\x04\x00\x00\x00name\x06\x00\x00\x00kalman"
    option = b"\x09\x00\x00\x00sigma_R_V\x07\x00\x00\x000.00099"
    content = other.read_bytes()
    assert name in content
    assert option in content
    forged.write_bytes(checksummed(content.replace(option, option.replace(b"0.00099", b"0.00098"))))

    code, out, _ = aemd("replay", forged, "--check", "--json")

    found = json.loads(out)
    assert code == 1
    assert found["identical"] is False
    assert re.match(r"reading \d+: \w+ was .*, is ", found["difference"])


def checksummed(content: bytes) -> bytes:
    """Return a changed recording with its checksum of the data section set right, found by trying (MCAP: DataEnd)."""
    at = content.rindex(b"\x0f" + (4).to_bytes(8, "little"))
    return content[: at + 9] + zlib.crc32(content[:at]).to_bytes(4, "little") + content[at + 13 :]


def test_a_replay_with_another_estimator_writes_the_same_readings(aemd: Run, recording: Path, tmp_path: Path) -> None:
    out_file = tmp_path / "kalman.mcap"

    code, out, _ = aemd("replay", recording, "--estimator", "kalman", "--out", out_file, "--json")

    assert code == 0
    assert json.loads(out)["identical"] is None
    tables = []
    for path in (recording, out_file):
        table = tmp_path / f"{path.stem}.csv"
        aemd("export", path, "-o", table)
        tables.append(np.genfromtxt(table, delimiter=",", names=True))
    assert np.array_equal(tables[0]["value_V"], tables[1]["value_V"])
    assert not np.array_equal(tables[0]["estimate_V"], tables[1]["estimate_V"])
    assert aemd("replay", out_file, "--check")[0] == 0


def test_info_counts_what_the_acquisition_counted(aemd: Run, recording: Path) -> None:
    found = json.loads(aemd("info", recording, "--json")[1])

    assert (found["readings"], found["lost"], found["gaps"]) == (500, 0, 0)
    assert found["t1"] - found["t0"] == pytest.approx(499 * 0.002, abs=0.01)
    assert found["topics"]["/dmm/raw"] == found["topics"]["/dmm/filtered"] == 500


def test_a_table_goes_in_and_comes_out_with_its_values(aemd: Run, tmp_path: Path) -> None:
    table, out_file, back = tmp_path / "log.csv", tmp_path / "log.mcap", tmp_path / "back.csv"
    table.write_text("time,value,temperature\n0.000,1.25,20.5\n0.125,-2.5,20.6\n0.250,3.75,20.7\n")

    assert aemd("import", table, "-o", out_file, "--unit", "mV")[0] == 0
    assert aemd("replay", out_file)[0] == 0
    assert aemd("export", out_file, "-o", back)[0] == 0

    read = np.genfromtxt(back, delimiter=",", names=True)
    assert read.dtype.names[:7] == ("index", "time_s", "value_V", "status", "estimate_V", "sigma_V", "window")
    assert read["value_V"].tolist() == [0.00125, -0.0025, 0.00375]
    assert read["time_s"].tolist() == [0.0, 0.125, 0.25]
    assert json.loads(aemd("info", out_file, "--json")[1])["topics"]["/witness/temperature"] == 3


def test_a_picture_is_drawn_of_a_recording(aemd: Run, recording: Path, tmp_path: Path) -> None:
    picture = tmp_path / "picture.png"

    assert aemd("replay", recording, "--plot", picture)[0] == 0

    assert picture.read_bytes().startswith(b"\x89PNG")


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
@pytest.mark.parametrize("after_s", [0.4, 1.0, 1.6, 2.2])
def test_a_signal_while_it_starts_leaves_no_half_made_file_and_no_traceback(
    number: signal.Signals, after_s: float, quick: Path, tmp_path: Path
) -> None:
    """Whatever it was doing by then: importing, connecting, compiling or acquiring."""
    process = subprocess.Popen(
        [sys.executable, "-m", "aemd", "acquire", quick, "--out", tmp_path / "rec"], stderr=subprocess.PIPE, text=True
    )
    try:
        time.sleep(after_s)  # the moment is the point of the test
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()

    assert process.returncode in (0, 130, -number), err  # the last before our first line has run
    assert "Traceback" not in err or "site" in err or after_s < 1
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


# Every way to ask for the impossible: one clear line, a documented exit code, no traceback.


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


def refused(code: int, err: str, out: str, expected: int) -> str:
    """Assert that this is one clear line with the expected exit code; return the line."""
    lines = err.strip().splitlines()
    assert code == expected, err
    assert len(lines) == 1, err
    assert lines[0].startswith("aemd: ")
    assert out == ""
    return lines[0]


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
    "DATA:POIN?;:STAT:QUES:EVEN?": (b"-5;0", "the answer '-5;0' is not two numbers"),
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
                        client.sendall(answer + b"\n" if line.strip().decode() == question else said)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"TCPIP0::127.0.0.1::{server.getsockname()[1]}::SOCKET"
    thread.join(timeout=10)


@pytest.mark.parametrize("question", ODD_ANSWERS)
def test_a_meter_whose_answers_make_no_sense_is_refused(question: str, aemd: Run, tmp_path: Path) -> None:
    answer, says = ODD_ANSWERS[question]
    with odd(question, answer) as resource:
        code, out, err = aemd("acquire", "--resource", resource, "--seconds", 1, "--out", tmp_path)

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


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        (b"0.00099", b"x.00099", "metadata aemd.estimator: sigma_R_V = 'x.00099'"),
        (b"\x04\x00\x00\x00name", b"\x04\x00\x00\x00nome", "metadata aemd.estimator: name: missing"),
    ],
)
def test_a_damaged_description_of_the_estimator_is_refused(
    before: bytes, after: bytes, says: str, aemd: Run, recording: Path, tmp_path: Path
) -> None:
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(recording.read_bytes().replace(before, after))

    code, out, err = aemd("replay", damaged)

    assert says in refused(code, err, out, 1)


def test_a_check_finds_damage_outside_the_chunks_too(aemd: Run, recording: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(recording.read_bytes().replace(b"readings\x03\x00\x00\x00500", b"readings\x03\x00\x00\x00900"))

    for words, says in ((["replay", damaged, "--check"], "checksum"), (["info", damaged], "it tells of 900 readings")):
        code, out, err = aemd(*words)
        assert says in refused(code, err, out, 1)


def test_a_table_of_one_reading_cannot_be_estimated(aemd: Run, tmp_path: Path) -> None:
    table, path = tmp_path / "log.csv", tmp_path / "log.mcap"
    table.write_text("time,value\n0.0,1.0\n")
    assert aemd("import", table, "-o", path)[0] == 0

    code, out, err = aemd("replay", path)

    assert str(path) in refused(code, err, out, 1)


def test_enormous_values_are_drawn_and_summed_without_complaint(aemd: Run, tmp_path: Path) -> None:
    table, path = tmp_path / "log.csv", tmp_path / "log.mcap"
    table.write_text("time,value\n0,1e308\n1,-1e308\n2,1e308\n")
    aemd("import", table, "-o", path)

    code, out, err = aemd("replay", path, "--plot", tmp_path / "p.png", "--json")

    assert code == 0, err
    assert json.loads(out)["raw_variance_V2"] is None


def test_what_was_flushed_of_an_unfinished_file_can_be_replayed_and_exported(
    aemd: Run, recording: Path, tmp_path: Path
) -> None:
    active = tmp_path / "cut.mcap.active"
    content = recording.read_bytes()
    active.write_bytes(content[: len(content) - 3000])

    assert json.loads(aemd("info", active, "--json")[1])["finalised"] is False
    assert aemd("replay", active)[0] == 0
    assert aemd("export", active, "-o", tmp_path / "cut.csv")[0] == 0


def test_a_diagnosis_is_json_with_the_documented_keys(aemd: Run, tmp_path: Path) -> None:
    table = Path(__file__).parent.parent / "replay_data" / "log.csv"  # 2 "V" at 0.2 Hz in 20 mV of noise

    code, out, err = aemd("diagnose", table, "--json", "-o", tmp_path / "m.toml", "--html", tmp_path / "r.html")

    found = json.loads(out)
    assert code == 0, err
    assert {"verdict", "n", "rate_hz", "findings", "discrepancies", "base_model", "extended_model", "seconds"} <= set(
        found
    )
    assert found["verdict"] == "explained"
    finding = found["findings"][0]
    assert finding["cause"] == finding["names"][0] == "periodic_interference"
    assert set(finding) == {
        "cause", "names", "probability", "p_value", "d_nats", "parameters", "gain", "rms_before", "rms_after",
        "experiment",
    }  # fmt: skip
    assert set(finding["gain"]) == {"nats_per_reading", "nats_total", "low", "high"}
    frequency = finding["parameters"]["frequency_hz"]
    assert frequency["low"] <= 0.2 <= frequency["high"]
    assert frequency["unit"] == "Hz"
    assert (tmp_path / "r.html").read_text().count("http") <= 5  # one file: nothing to fetch but names of namespaces
    assert aemd("simulate", "--model", tmp_path / "m.toml", "--seconds", 10, "-o", tmp_path / "s.mcap")[0] == 0


UNFIT = {
    "constant": "time,value\n" + "".join(f"{0.1 * k:.1f},1.0\n" for k in range(200)),
    "five readings": "time,value\n0,1\n1,2\n2,3\n3,4\n4,5\n",
    "unsorted": "time,value\n" + "".join(f"{100 - k},{k % 7}\n" for k in range(100)),
    "one column": "time\n0\n1\n",
    "text": "It was a dark and stormy night.\n",
    "no number": "time,value\n" + "".join(f"{0.1 * k:.1f},nan\n" for k in range(200)),
}


@pytest.mark.parametrize("name", UNFIT)
def test_a_file_that_cannot_be_judged_is_refused(name: str, aemd: Run, tmp_path: Path) -> None:
    table = tmp_path / "log.csv"
    table.write_text(UNFIT[name])

    code, out, err = aemd("diagnose", table)

    assert str(table) in refused(code, err, out, 1)


TABLES = {
    "empty": b"",
    "no header": b"0.0,1.0\n0.1,2.0\n",
    "one column": b"time\n0.0\n0.1\n",
    "other names": b"t,v\n0.0,1.0\n0.1,2.0\n",
    "a word for a number": b"time,value\n0.0,1.0\n0.1,lots\n",
    "a word for a time": b"time,value\n0.0,1.0\nnoon,2.0\n",
    "times that stand still": b"time,value\n0.0,1.0\n0.0,2.0\n",
    "times that go back": b"time,value\n1.0,1.0\n0.5,2.0\n",
    "a row too short": b"time,value\n0.0,1.0\n0.1\n",
    "a row too long": b"time,value\n0.0,1.0\n0.1,2.0,3.0\n",
    "header only": b"time,value\n",
    "binary": bytes(range(256)) * 4,
    "a column twice": b"time,value,value\n0.0,1.0,1.0\n0.1,2.0,1.0\n",
}


@pytest.mark.parametrize("name", TABLES)
def test_a_broken_table_is_refused(name: str, aemd: Run, tmp_path: Path) -> None:
    table, out_file = tmp_path / "log.csv", tmp_path / "log.mcap"
    table.write_bytes(TABLES[name])

    code, out, err = aemd("import", table, "-o", out_file)

    assert str(table) in refused(code, err, out, 1)
    assert not list(tmp_path.glob("*.mcap*"))


def test_a_table_that_is_no_gzip_or_not_there_is_refused(aemd: Run, tmp_path: Path) -> None:
    table = tmp_path / "log.csv.gz"
    for content in (None, b"time,value\n0,1\n1,2\n"):
        if content is not None:
            table.write_bytes(content)
        code, out, err = aemd("import", table, "-o", tmp_path / "log.mcap")
        assert str(table) in refused(code, err, out, 1)


def foreign(path: Path) -> None:
    """An MCAP of somebody else: valid, with other topics."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Pose", "jsonschema", b"{}")
        channel = writer.register_channel("/robot/pose", "json", schema)
        writer.add_message(channel, log_time=1, publish_time=1, data=b"{}")
        writer.finish()


@pytest.mark.parametrize("command", ["replay", "info", "export"])
@pytest.mark.parametrize("kind", ["missing", "empty", "text", "foreign", "truncated", "damaged", "a folder"])
def test_a_file_that_is_no_sound_recording_is_refused(
    kind: str, command: str, aemd: Run, recording: Path, tmp_path: Path
) -> None:
    path = tmp_path / "file.mcap"
    content = recording.read_bytes()
    if kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("time,value\n0,1\n")
    elif kind == "foreign":
        foreign(path)
    elif kind == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif kind == "damaged":
        middle = len(content) // 2
        path.write_bytes(
            content[:middle] + bytes(byte ^ 0xFF for byte in content[middle : middle + 64]) + content[middle + 64 :]
        )
    elif kind == "a folder":
        path.mkdir()

    words = ["-o", tmp_path / "t.csv"] if command == "export" else []
    code, out, err = aemd(command, path, *words)

    if (
        kind in {"truncated", "damaged"} and command == "info"
    ):  # it tells what the file says of itself, as far as it goes
        assert code == 0
    else:
        assert str(path) in refused(code, err, out, 1)


def test_what_exists_is_never_overwritten(aemd: Run, recording: Path) -> None:
    before = recording.read_bytes()

    code, out, err = aemd("replay", recording, "--out", recording)

    assert "exists" in refused(code, err, out, 1)
    assert recording.read_bytes() == before


def test_an_unknown_estimator_is_a_usage_error_that_lists_those_there_are(aemd: Run, recording: Path) -> None:
    code, out, err = aemd("replay", recording, "--estimator", "aen")

    assert "did you mean 'aem'?" in refused(code, err, out, 2)


def test_a_check_without_recorded_estimates_is_a_usage_error(aemd: Run, tmp_path: Path) -> None:
    table, path = tmp_path / "log.csv", tmp_path / "log.mcap"
    table.write_text("time,value\n0.0,1.0\n0.1,2.0\n0.2,3.0\n")
    aemd("import", table, "-o", path)

    code, out, err = aemd("replay", path, "--check")

    assert "no estimates" in refused(code, err, out, 2)


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


def test_help_starts_without_the_heavy_packages() -> None:
    code = "import sys; sys.argv=['aemd','--help']\ntry:\n import aemd.cli; aemd.cli.main()\nexcept SystemExit: pass\n"
    code += "print([m for m in ('numba', 'scipy', 'matplotlib', 'pyvisa', 'pyarrow') if m in sys.modules])"

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env={**os.environ})

    assert done.stdout.strip().endswith("[]")
