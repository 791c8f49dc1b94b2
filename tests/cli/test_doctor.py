"""`aemd devices` and `aemd doctor`, on the simulated meter and on none."""

import json
from pathlib import Path

from tests.cli.asking import Run, refused


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
    assert "aemd devices --host" in check["advice"]


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


def test_devices_end_within_their_time_and_say_what_is_wrong_with_a_host(aemd: Run) -> None:
    code, out, _ = aemd("devices", "--timeout", 0.5, "--host", "127.0.0.1:1", "--json")
    said = {device["found"]: device for device in json.loads(out)["devices"]}

    assert code == 0
    assert "refused" in said["127.0.0.1:1"]["hint"]
