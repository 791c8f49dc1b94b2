"""A very long record: its beginning is judged, and the answer says so."""

from pathlib import Path

import numpy as np
import pytest

from aemd.block import ESTIMATE, Batch, make_block
from aemd.diagnose import format_diagnosis
from aemd.diagnose.engine import criticise
from aemd.diagnose.series import load_series
from aemd.errors import RecordingError
from aemd.record.description import Description
from aemd.record.writer import Recorder

INTERVAL_S = 0.067
READINGS = 30_000


@pytest.fixture
def values() -> np.ndarray:
    return 1.0 + 1e-3 * np.random.default_rng(7).standard_normal(READINGS)


def _write(path: Path, values: np.ndarray) -> Recorder:
    recorder = Recorder(path, Description(interval_s=INTERVAL_S), chunk_bytes=20_000)
    recorder.write(Batch(make_block(values, interval_ns=INTERVAL_S * 1e9)), np.empty(0, ESTIMATE))
    return recorder


def test_of_a_longer_record_the_beginning_is_read_and_the_rest_counted(tmp_path: Path, values: np.ndarray) -> None:
    path = _write(tmp_path / "r.mcap", values).close()

    series = load_series(path, 700)

    assert series.value_V.tolist() == values[:700].tolist()
    assert series.index.tolist() == list(range(700))
    assert series.left_out == READINGS - 700


@pytest.mark.parametrize("most", [READINGS, READINGS + 1])
def test_a_record_that_is_not_longer_is_read_whole(tmp_path: Path, values: np.ndarray, most: int) -> None:
    series = load_series(_write(tmp_path / "r.mcap", values).close(), most)

    assert (series.value_V.size, series.left_out) == (READINGS, 0)


def test_what_an_unfinished_record_holds_behind_the_beginning_is_counted_too(
    tmp_path: Path, values: np.ndarray
) -> None:
    recorder = _write(tmp_path / "r.mcap", values)
    recorder.release()  # as a kill leaves it: the last chunk was not full

    series = load_series(tmp_path / "r.mcap.active", 700)

    assert 29_000 < recorder.written.readings < READINGS
    assert (series.value_V.size, series.left_out) == (700, recorder.written.readings - 700)


def test_the_rest_of_a_long_table_is_counted_too(tmp_path: Path) -> None:
    lines = [f"{row * INTERVAL_S:.3f},{row % 7}" for row in range(1000)]
    (tmp_path / "t.csv").write_text("\n".join(["time,value", *lines]) + "\n")

    series = load_series(tmp_path / "t.csv", 400)

    assert (series.value_V.size, series.left_out) == (400, 600)


def test_the_report_says_which_part_was_judged(tmp_path: Path, values: np.ndarray) -> None:
    path = _write(tmp_path / "r.mcap", values).close()

    diagnosis = criticise(load_series(path, 300))

    assert (diagnosis.n, diagnosis.left_out) == (300, READINGS - 300)
    last = format_diagnosis(diagnosis).splitlines()[-1]
    assert last.startswith("The first 300 readings at 14.93 /s, judged in ")
    assert last.endswith(" The 29,700 readings behind them were not looked at.")


def test_the_report_of_a_whole_record_says_nothing_of_the_kind(tmp_path: Path, values: np.ndarray) -> None:
    last = format_diagnosis(criticise(load_series(_write(tmp_path / "r.mcap", values[:300]).close()))).splitlines()[-1]

    assert last.startswith("300 readings at 14.93 /s, judged in ")
    assert last.endswith(" s.")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda y: y * 1e200, "reading [0-9]+ is .*; scale the readings to numbers below 1e100"),
        (lambda y: y * 1e-200, "all readings are within 1e-100; scale them"),
        (
            lambda y: np.where(np.arange(y.size) == 7, 9.9e37, y),
            "reading 8 is 9.9e\\+37, 1e\\+12 times .*; leave its cell",
        ),
        (lambda y: np.where(y > 1, 1.25, 1.0), "every reading is 1 or 1.25; log more digits"),
    ],
)
def test_numbers_that_leave_nothing_to_judge_are_refused_with_the_way_out(tmp_path, values, change, words):
    path = _write(tmp_path / "r.mcap", change(values[:200])).close()

    with pytest.raises(RecordingError, match=words):
        load_series(path)
