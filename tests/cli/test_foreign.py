"""Another program's MCAP file, as the command line takes it."""

import json
from pathlib import Path

import numpy as np
import pytest

from aemd.record.reader import Recording
from tests.archive.made import write_json
from tests.cli.asking import Run, refused


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """300 JSON messages with two numbers, 10 a second."""
    write_json(tmp_path / "lab.mcap", lambda value: {"dmm": {"mV": value}, "celsius": 20.0})
    return tmp_path / "lab.mcap"


def test_a_number_is_chosen_by_topic_and_field_and_replayed(aemd: Run, foreign: Path, tmp_path: Path) -> None:
    code, out, err = aemd("replay", foreign, "--json")
    assert refused(code, err, out, 2).endswith("choose by --topic and --field among: /lab dmm.mV, /lab celsius")

    code, out, _ = aemd("replay", foreign, "--field", "dmm.mV", "--out", tmp_path / "o.mcap", "--json")

    assert (code, json.loads(out)["readings"]) == (0, 300)
    with Recording(tmp_path / "o.mcap") as recording:
        assert recording.statistics().estimates == 300
        assert recording.description.interval_s == pytest.approx(0.1)


def test_it_is_imported_in_volts_and_exported(aemd: Run, foreign: Path, tmp_path: Path) -> None:
    chosen = ("--topic", "/lab", "--field", "dmm.mV")

    imported, _, _ = aemd("import", foreign, *chosen, "--unit", "mV", "-o", tmp_path / "r.mcap")
    exported, _, _ = aemd("export", foreign, *chosen, "-o", tmp_path / "r.csv")

    assert (imported, exported) == (0, 0)
    values = np.random.default_rng(3).standard_normal(300)
    with Recording(tmp_path / "r.mcap") as recording:
        readings = np.concatenate([batch.readings for batch in recording.batches()])
        assert recording.description.unit == "V"
    assert readings["value_V"].tolist() == (values / 1e3).tolist()
    assert np.genfromtxt(tmp_path / "r.csv", delimiter=",", names=True)["value_V"].tolist() == values.tolist()
