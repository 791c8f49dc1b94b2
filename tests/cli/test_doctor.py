"""`aemd devices` and `aemd doctor`, on the simulated meter and on none."""

import json
from contextlib import closing
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

import agilent34410
from aemd import doctor
from aemd.acquire.acquisition import Acquisition
from aemd.acquire.instrument import Drain, host_ns
from aemd.config import load_config
from aemd.session import simulated
from tests.cli.asking import Run, refused
from tests.cli.test_meters import talking


def test_a_meter_that_is_fit_passes_every_check(aemd: Run) -> None:
    code, out, _ = aemd("doctor", "--json")
    found = json.loads(out)

    assert code == 0
    assert found["ok"] is True
    names = [check["name"] for check in found["checks"]]
    assert names == ["link", "identity", "line frequency", "error queue", "interval", "timing kept", "losses"]
    assert all(check["ok"] for check in found["checks"])


def test_a_meter_that_is_not_there_fails_with_what_to_do(aemd: Run) -> None:
    code, out, _ = aemd("doctor", "--resource", "TCPIP0::127.0.0.1::1::SOCKET", "--json")
    (check,) = json.loads(out)["checks"]

    assert code == 1
    assert (check["name"], check["ok"]) == ("link", False)
    assert "refused" in check["found"]
    assert "has nothing at port 1:" in check["advice"]


def test_an_address_that_is_none_is_told_of_in_a_sentence(aemd: Run, tmp_path: Path) -> None:
    resource = "TCPIP0::192.168..5::5025::SOCKET"
    code, out, err = aemd("doctor", "--resource", resource, "--json")
    (check,) = json.loads(out)["checks"]
    assert (code, check["name"], check["ok"]) == (1, "link", False), err
    assert "no computer is called '192.168..5'" in check["advice"]

    code, out, err = aemd("doctor", "--resource", resource, "--characterise", "--out", tmp_path / "r.md")
    assert "no computer can be called so" in refused(code, err, out, 1)


STRANGERS = {
    "another meter": (b"KEITHLEY INSTRUMENTS INC.,MODEL 2000,1234,A20\n", "another instrument is there"),
    "a web server": (b"HTTP/1.1 400 Bad Request\r\n\r\n", "what answers there is no instrument"),
}


@pytest.mark.parametrize("name", STRANGERS)
def test_a_stranger_is_no_fault_of_the_link(name: str, aemd: Run) -> None:
    answer, advice = STRANGERS[name]
    with talking(answer) as resource:
        code, out, _ = aemd("doctor", "--resource", resource, "--json")
    link, identity = json.loads(out)["checks"]

    assert code == 1
    assert (link["name"], link["ok"]) == ("link", True)
    assert (identity["name"], identity["ok"]) == ("identity", False)
    assert answer.decode().split()[0] in identity["found"]
    assert advice in identity["advice"]


def test_a_silent_listener_takes_connections_and_does_not_answer(aemd: Run, tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    with talking(None) as resource:
        config.write_text(f'[instrument]\nresource = "{resource}"\ntimeout_s = 0.3\n')
        code, out, _ = aemd("doctor", config, "--json")
    (check,) = json.loads(out)["checks"]

    assert code == 1
    assert (check["name"], check["ok"]) == ("link", False)
    assert "does not answer as an instrument does" in check["advice"]


def test_a_setting_that_the_meter_cannot_keep_is_no_fault_of_the_link(aemd: Run, tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text('[instrument]\nresource = "sim"\nnplc = 10\ninterval_s = 0.06712\n')
    code, out, _ = aemd("doctor", config, "--json")
    checks = {check["name"]: check for check in json.loads(out)["checks"]}

    assert code == 1
    assert checks["link"]["ok"]
    assert "interval_s" in checks["settings"]["found"]


def test_a_meter_in_use_is_left_alone(aemd: Run, tmp_path: Path) -> None:
    fast = agilent34410.Options(nplc=0.2, autozero="off", interval_s=0.01)
    config = tmp_path / "c.toml"
    with (
        simulated(load_config(None)) as resource,
        closing(agilent34410.open_instrument(resource, fast, host_ns)) as instrument,
        Acquisition(instrument, most_readings=300) as acquisition,
    ):
        config.write_text(f'[instrument]\nresource = "{resource}"\n')
        code, out, _ = aemd("doctor", config, "--json")
        taken = sum(batch.readings.size for batch in acquisition.batches())
    checks = {check["name"]: check for check in json.loads(out)["checks"]}

    assert code == 1
    assert checks["link"]["ok"]
    assert "stop the other program" in checks["in use"]["advice"]
    assert (taken, acquisition.counts.lost, acquisition.outages) == (300, 0, 0)


def test_a_meter_that_a_dead_program_left_sampling_is_taken_over(aemd: Run, tmp_path: Path) -> None:
    fast = agilent34410.Options(nplc=0.2, autozero="off", interval_s=0.01, timeout_s=1.0)
    config = tmp_path / "c.toml"
    with simulated(load_config(None)) as resource:
        instrument = agilent34410.open_instrument(resource, fast, host_ns)
        instrument.start()
        instrument.drain(1)
        instrument._dialogue.close()  # killed: not a word more, and the meter goes on
        config.write_text(f'[instrument]\nresource = "{resource}"\n')
        code, out, err = aemd("doctor", config, "--json")

    assert code == 0, (out, err)


class Idle:
    """An instrument of one reading an hour that takes none."""

    identity: ClassVar[dict[str, str]] = {}
    settings: ClassVar[dict[str, str]] = {}
    interval_s = 3600.0
    sample_delay_s = 0.0
    epoch_readings = 0
    memory_readings = 1000

    def start(self) -> None: ...

    def drain(self, most: int) -> Drain:
        now_ns = host_ns()
        return Drain(np.empty(0), np.empty(0, np.uint32), 0, now_ns, now_ns, now_ns)

    def stop(self) -> None: ...

    def close(self) -> None: ...


def test_the_measurement_has_an_end_where_no_reading_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "LONGEST_S", 0.1)
    found = {check.name: check for check in doctor._measure(Idle(), load_config(None))}

    assert not found["readings"].ok
    assert found["readings"].found.startswith("none within ")


@pytest.mark.parametrize("answer", ["junk", "", "nan", "1e400", "-50"])
def test_a_line_frequency_that_is_none_is_found(answer: str) -> None:
    (check,) = doctor._line_frequency({"SYST:LFR?": answer})

    assert not check.ok
    assert repr(answer) in check.found


def test_an_overload_is_found(aemd: Run, tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text(
        '[instrument]\nresource = "sim"\nrange_V = 0.1\n[simulator]\nterms = [{ term = "level", level_V = 5.0 }]\n'
    )
    code, out, err = aemd("doctor", config, "--json")

    assert code == 1, err
    (check,) = (check for check in json.loads(out)["checks"] if not check["ok"])
    assert check["name"] == "input"
    assert "larger range_V" in check["advice"]


def test_characterise_and_its_report_go_together(aemd: Run) -> None:
    code, out, err = aemd("doctor", "--characterise")

    assert "--out FILE" in refused(code, err, out, 2)


def test_a_report_that_cannot_be_written_is_known_before_the_meter_is_asked(aemd: Run, tmp_path: Path) -> None:
    resource = "TCPIP0::127.0.0.1::1::SOCKET"
    code, out, err = aemd("doctor", "--resource", resource, "--characterise", "--out", tmp_path / "none" / "report.md")
    assert "none/report.md: cannot be written: no such file or directory" in refused(code, err, out, 1)

    code, out, err = aemd("doctor", "--resource", resource, "--characterise", "--out", tmp_path / "report.md")
    assert "refused" in refused(code, err, out, 1)
    assert not list(tmp_path.iterdir())


def test_devices_end_within_their_time_and_say_what_is_wrong_with_a_host(aemd: Run) -> None:
    code, out, _ = aemd("devices", "--timeout", 0.5, "--host", "127.0.0.1:1", "--json")
    said = {device["found"]: device for device in json.loads(out)["devices"]}

    assert code == 0
    assert "refused" in said["127.0.0.1:1"]["hint"]
