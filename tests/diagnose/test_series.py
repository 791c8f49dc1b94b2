"""A file becomes a series: of a very long record the beginning; the stamps' grid, however they scatter about it."""

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
from aemd.tables import import_csv

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


# The grid.

_N = 2000


def _error_s(sd_s: float, n: int = _N) -> float:
    """Five times the standard error of the mean of differences L = n/8 apart, sd sqrt(2 / L) / (n - L).

    All stamps but the first and the last L cancel in that mean.
    """
    return 5 * sd_s * np.sqrt(2 * 8 / n) / (n * 7 / 8)


def _recording_of(path: Path, stamps_s: np.ndarray, index: np.ndarray | None = None) -> Path:
    readings = make_block(np.random.default_rng(0).standard_normal(stamps_s.size))
    readings["t_ns"] = np.rint((stamps_s + 1.0) * 1e9)
    if index is not None:
        readings["index"] = index
    recorder = Recorder(path, Description(interval_s=INTERVAL_S))
    recorder.write(Batch(readings), np.empty(0, ESTIMATE))
    return recorder.close()


def _table_of(path: Path, stamps_s: np.ndarray) -> Path:
    values = np.random.default_rng(0).standard_normal(stamps_s.size)
    lines = [f"{t_s + 1:.6f},{value:.6f}" for t_s, value in zip(stamps_s, values, strict=True)]
    path.write_text("\n".join(["time,value", *lines]) + "\n")
    return path


def _on_the_grid() -> np.ndarray:
    return np.arange(_N) * INTERVAL_S


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("numbered", [True, False])
@pytest.mark.parametrize("share", [0.0, 0.03, 0.15])
def test_the_interval_is_known_as_well_as_scattering_stamps_tell(tmp_path, seed, numbered, share):
    """Of a sine at 2 Hz over 134 s, an interval off by a thousandth would be a fifth of a turn off by the end."""
    sd_s = share * INTERVAL_S
    stamps = _on_the_grid() + sd_s * np.random.default_rng(seed).standard_normal(_N)

    series = load_series((_recording_of if numbered else _table_of)(tmp_path / "r", stamps))

    assert series.interval_s == pytest.approx(INTERVAL_S, abs=_error_s(sd_s) + 1e-9)
    assert np.all(series.step_s == series.interval_s)  # the time axis does not add the stamps' scatter up


@pytest.mark.parametrize("numbered", [True, False])
def test_readings_that_are_missing_at_random_do_not_move_the_interval(tmp_path, numbered):
    rng = np.random.default_rng(4)
    keep = rng.random(_N) > 0.02
    keep[700:900] = False
    stamps = (_on_the_grid() + 0.05 * INTERVAL_S * rng.standard_normal(_N))[keep]
    index = np.flatnonzero(keep)
    path = _recording_of(tmp_path / "r", stamps, index) if numbered else _table_of(tmp_path / "r", stamps)

    series = load_series(path)

    assert series.interval_s == pytest.approx(INTERVAL_S, abs=2 * _error_s(0.05 * INTERVAL_S))
    assert series.slot.tolist() == (index - index[0]).tolist()


@pytest.mark.parametrize("numbered", [True, False])
@pytest.mark.parametrize(("jump", "share"), [(0.5, 0.01), (10.4, 0.01), (3000.0, 0.15), (3000.5, 0.15)])
def test_a_clock_that_was_set_does_not_move_the_interval(tmp_path, numbered, jump, share):
    """Each half tells the interval alone: its error is 2^1.5 times that of the whole, and that of both 2."""
    stamps = _on_the_grid() + share * INTERVAL_S * np.random.default_rng(5).standard_normal(_N)
    stamps[_N // 2 :] += jump * INTERVAL_S

    series = load_series((_recording_of if numbered else _table_of)(tmp_path / "r", stamps))

    assert series.interval_s == pytest.approx(INTERVAL_S, abs=2.5 * _error_s(share * INTERVAL_S))


def test_a_pause_of_no_whole_length_stays_as_it_is_stamped_and_no_other_step(tmp_path):
    stamps = _on_the_grid() + 0.02 * INTERVAL_S * np.random.default_rng(6).standard_normal(_N)
    stamps[500:] += 3.4 * INTERVAL_S
    stamps[900] += 0.4 * INTERVAL_S  # late by itself
    stamps = np.round(stamps, 6)

    series = load_series(_table_of(tmp_path / "t.csv", stamps))

    off = np.flatnonzero(np.abs(series.step_s / series.interval_s - 1) > 1e-9)
    assert off.tolist() == [500]
    assert series.step_s[500] == pytest.approx(stamps[500] - stamps[499], abs=1e-6)


def test_stamps_that_keep_to_no_grid_are_the_time_axis_themselves(tmp_path):
    """A program that waits a while after each reading, of a length that varies by 0.3: that adds up."""
    steps = INTERVAL_S * np.random.default_rng(7).uniform(0.5, 1.5, _N)
    stamps = np.round(np.cumsum(steps), 6)

    series = load_series(_table_of(tmp_path / "t.csv", stamps))

    axis = np.cumsum(series.step_s)
    assert np.ptp(axis - stamps) < series.interval_s


@pytest.mark.parametrize("numbered", [True, False])
def test_pauses_of_no_whole_length_do_not_move_the_interval(tmp_path, numbered):
    """A program that writes its file after every 40 readings: stamps an eighth of the record apart lie over six."""
    pauses_s = INTERVAL_S * (3 + np.random.default_rng(9).uniform(0.1, 0.9, _N // 40))
    pauses = np.repeat(np.cumsum(pauses_s), 40)

    series = load_series((_recording_of if numbered else _table_of)(tmp_path / "r", _on_the_grid() + pauses))

    assert series.interval_s == pytest.approx(INTERVAL_S, rel=1e-6)


@pytest.mark.parametrize("interval_ms", [2.05, 2.3])
def test_stamps_of_few_digits_leave_the_grid_at_no_rounding(tmp_path, interval_ms):
    """Of 2.05 ms in whole ones every twentieth step is one and a half intervals, and none a pause or a loss."""
    path = tmp_path / "t.csv"
    lines = "".join(f"{interval_ms * row / 1000:.3f},{row % 7}\n" for row in range(_N))
    path.write_text("time,value\n" + lines)

    series = load_series(path)

    one_digit_over_what_is_compared_s = 0.001 / (_N * 7 / 8)
    assert series.interval_s == pytest.approx(interval_ms / 1000, abs=one_digit_over_what_is_compared_s)
    assert np.all(series.step_s == series.interval_s)


@pytest.mark.parametrize("late", [4, 150])
def test_one_burst_of_late_stamps_does_not_tilt_the_interval(tmp_path, late):
    """A host that stalls for ten seconds reads 150 stamps at once; a straight line's slope would be off by 1 %."""
    stamps = _on_the_grid()
    stamps[100 : 100 + late] = stamps[100 + late] - 1e-5 * np.arange(late, 0, -1)

    series = load_series(_recording_of(tmp_path / "r.mcap", stamps))

    assert series.interval_s == pytest.approx(INTERVAL_S, rel=1e-8)


def test_an_interval_that_an_import_took_from_the_stamps_was_not_asked_for(tmp_path):
    stamps = _on_the_grid() + 0.03 * INTERVAL_S * np.random.default_rng(8).standard_normal(_N)
    import_csv(_table_of(tmp_path / "t.csv", stamps), tmp_path / "r.mcap")

    assert load_series(tmp_path / "r.mcap").nominal_interval_s == 0.0
    assert load_series(_recording_of(tmp_path / "own.mcap", stamps)).nominal_interval_s == INTERVAL_S


@pytest.mark.parametrize(("others", "said"), [(1, "all readings but one are 1.5"), (4, "all readings but 4 are 1.5")])
def test_a_record_that_hardly_leaves_one_value_is_refused(tmp_path: Path, others: int, said: str) -> None:
    path = tmp_path / "flat.csv"
    rows = [f"{0.1 * row:.1f},{1.500001 if row in range(100, 100 + others) else 1.5}" for row in range(300)]
    path.write_text("time,value\n" + "\n".join(rows) + "\n")

    with pytest.raises(RecordingError, match=rf"flat\.csv: {said}; too few others to judge by"):
        load_series(path)


def test_a_damaged_recording_is_told_to_be_none_and_no_table(tmp_path: Path) -> None:
    path = tmp_path / "damaged.mcap"
    path.write_bytes(bytes(range(256)) * 9)

    with pytest.raises(RecordingError, match=r"damaged\.mcap: is no MCAP file"):
        load_series(path)
