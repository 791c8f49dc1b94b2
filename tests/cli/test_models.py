"""Diagnoses, and files that cannot be judged."""

import json
from pathlib import Path

import pytest

from tests.cli.asking import Run, refused


def test_a_diagnosis_is_json_with_the_documented_keys(aemd: Run, tmp_path: Path) -> None:
    table = Path(__file__).parents[2] / "replay_data" / "log.csv"  # 2 "V" at 0.2 Hz in 20 mV of noise

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
        "experiment", "remark",
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
