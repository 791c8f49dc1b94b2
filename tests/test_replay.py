"""The recordings that we keep replay to the estimates that they had when they were made."""

import hashlib
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from aemd.record.reader import Recording
from aemd.replay import replay
from aemd.tables import export

FOLDER = Path(__file__).parent.parent / "replay_data"
NAMES = ("static", "dynamic", "gap")


def test_the_kept_recordings_are_unchanged() -> None:
    sums = dict(reversed(line.split("  ")) for line in (FOLDER / "SHA256SUMS").read_text().splitlines())

    assert {path.name for path in FOLDER.iterdir() if path.suffix in {".mcap", ".csv"}} == set(sums)
    for name, digest in sums.items():
        assert hashlib.sha256((FOLDER / name).read_bytes()).hexdigest() == digest, name


@pytest.mark.parametrize("name", NAMES)
def test_a_kept_recording_replays_to_the_estimates_of_its_making(name: str, tmp_path: Path) -> None:
    """To 1e-12 rather than to the bit: another machine's mathematical library may round a logarithm otherwise."""
    made, table = tmp_path / "again.mcap", tmp_path / "again.csv"
    replay(FOLDER / f"{name}.mcap", out=made)
    export(made, table)

    expected, found = (
        np.genfromtxt(path, delimiter=",", names=True) for path in (FOLDER / f"{name}.expected.csv", table)
    )
    for column in expected.dtype.names:
        np.testing.assert_allclose(found[column], expected[column], rtol=1e-12, atol=1e-15, err_msg=column)


@pytest.mark.parametrize("name", NAMES)
def test_a_kept_recording_is_what_its_maker_makes(name: str, tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("make", FOLDER / "make.py")
    assert spec is not None
    assert spec.loader is not None
    maker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(maker)
    maker.make(name, tmp_path)

    readings = []
    for path in (FOLDER / f"{name}.mcap", tmp_path / f"{name}.mcap"):
        with Recording(path) as recording:
            readings.append(np.concatenate([batch.readings for batch in recording.batches()]))
    assert np.array_equal(readings[0]["index"], readings[1]["index"])
    assert np.array_equal(readings[0]["t_ns"], readings[1]["t_ns"])
    np.testing.assert_allclose(readings[0]["value_V"], readings[1]["value_V"], atol=3.1e-6)  # one step of the meter


def test_a_lost_stretch_and_an_overload_are_told_in_full() -> None:
    with Recording(FOLDER / "gap.mcap") as recording:
        batches = list(recording.batches())
        counted = recording.statistics()

    readings = np.concatenate([batch.readings for batch in batches])
    events = [event for batch in batches for event in batch.events]
    assert (counted.readings, counted.lost, counted.gaps) == (1460, 40, 1)
    assert [(event.kind, event.first_index, event.last_index) for event in events] == [
        ("gap", 600, 639),
        ("overload", -1, -1),
    ]
    assert np.flatnonzero(np.isnan(readings["value_V"])).tolist() == [860, 861, 862, 863, 864]  # 900 less 40 lost
