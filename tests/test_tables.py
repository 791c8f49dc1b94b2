import csv
import gzip
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aemd.block import ESTIMATE, Batch, Block, Estimates, Status
from aemd.errors import RecordingError, UsageError
from aemd.record.description import Description, write_parameters
from aemd.record.reader import Recording
from aemd.record.writer import Recorder
from aemd.tables import export, import_csv
from tests.record.made import T0_NS, estimates_of, readings_of

HEADER = ["index", "time_s", "value_V", "status", "estimate_V", "sigma_V", "window"]


def _write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "log.csv"
    path.write_text(text, encoding="utf-8")
    return path


def _readings(path: Path) -> Block:
    with Recording(path) as recording:
        return np.concatenate([batch.readings for batch in recording.batches()])


# Import.


def test_a_log_becomes_readings_and_witnesses(tmp_path: Path) -> None:
    log = _write(tmp_path, "time,value,temperature\n0.000,10.0013260,24.752\n0.135,10.0013590,\n0.271,nan,24.8\n")

    summary = import_csv(log, tmp_path / "r.mcap")

    readings = _readings(tmp_path / "r.mcap")
    assert readings["index"].tolist() == [0, 1, 2]
    assert readings["t_ns"].tolist() == [0, 135_000_000, 271_000_000]
    assert readings["value_V"][:2].tolist() == [10.0013260, 10.0013590]
    assert readings["status"].tolist() == [0, 0, Status.INVALID]
    assert np.isnan(readings["value_V"][2])
    with Recording(tmp_path / "r.mcap") as recording:
        (batch,) = recording.batches()
        assert batch.witnesses["temperature"].tolist() == [(0, 24.752), (271_000_000, 24.8)]
        assert "/dmm/filtered" not in recording.channels
        assert recording.description.session["time_epoch"].startswith("unknown")
        assert recording.description.interval_s == pytest.approx(0.1355)
    assert (summary.readings, summary.invalid, summary.witnesses) == (3, 1, ("temperature",))


def test_the_nominal_interval_is_that_of_the_grid_about_which_the_stamps_scatter(tmp_path: Path) -> None:
    """The mean of n steps errs by sqrt(2) sd / n, which five times are the bound; their median by 1.8 sd / sqrt(n)."""
    sd_s, n = 0.002, 2000
    stamps = 1 + np.arange(n) / 15 + sd_s * np.random.default_rng(2).standard_normal(n)
    log = _write(tmp_path, "time,value\n" + "".join(f"{t_s:.6f},1.5\n" for t_s in stamps))

    assert import_csv(log, tmp_path / "r.mcap").interval_s == pytest.approx(1 / 15, abs=5 * 2**0.5 * sd_s / n)


@pytest.mark.parametrize(
    ("unit", "scale", "per_volt"),
    [
        ("V", 1.0, 1),
        ("V", -0.5, 1),
        ("mV", 1.0, 10**3),
        ("mV", 4.0, 10**3),
        ("uV", 1.0, 10**6),
        ("\u00b5V", 1.0, 10**6),
        ("\u03bcV", 1.0, 10**6),
        ("nV", 1.0, 10**9),
    ],
)
def test_volts_are_recorded_in_volts_rounded_once(tmp_path: Path, unit: str, scale: float, per_volt: int) -> None:
    import_csv(_write(tmp_path, "time,value\n0,5.3\n"), tmp_path / "r.mcap", unit=unit, scale=scale)

    assert _readings(tmp_path / "r.mcap")["value_V"].tolist() == [float(Fraction(5.3) * Fraction(scale) / per_volt)]
    with Recording(tmp_path / "r.mcap") as recording:
        assert recording.description.unit == recording.channels["/dmm/raw"].metadata["unit"] == "V"


def test_another_unit_is_recorded_as_it_is(tmp_path: Path) -> None:
    import_csv(_write(tmp_path, "time,value\n0,2498689\n"), tmp_path / "r.mcap", unit="counts", scale=2.0)

    assert _readings(tmp_path / "r.mcap")["value_V"].tolist() == [4997378.0]
    with Recording(tmp_path / "r.mcap") as recording:
        assert recording.description.unit == recording.channels["/dmm/raw"].metadata["unit"] == "counts"


@settings(deadline=None, max_examples=50, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.integers(0, 9_200_000_000 * 10**9), min_size=1, max_size=20, unique=True))
def test_a_time_is_exact_to_the_nanosecond(tmp_path_factory: pytest.TempPathFactory, instants: list[int]) -> None:
    folder = tmp_path_factory.mktemp("t")
    instants.sort()
    rows = "".join(f"{Decimal(t_ns).scaleb(-9)},1\n" for t_ns in instants)

    import_csv(_write(folder, "time,value\n" + rows), folder / "r.mcap")
    export(folder / "r.mcap", folder / "back.csv")

    assert _readings(folder / "r.mcap")["t_ns"].tolist() == instants
    with (folder / "back.csv").open(newline="") as file:
        assert [Decimal(row["time_s"]).scaleb(9) for row in csv.DictReader(file)] == instants


def test_the_printed_double_of_a_time_rounds_to_it(tmp_path: Path) -> None:
    log = _write(tmp_path, f"time,value\n{0.1 + 0.2!r},1\n1.5e0,2\n")

    import_csv(log, tmp_path / "r.mcap")

    assert _readings(tmp_path / "r.mcap")["t_ns"].tolist() == [300_000_000, 1_500_000_000]


def test_packed_logs_byte_order_marks_windows_lines_and_empty_lines_are_fine(tmp_path: Path) -> None:
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress("\ufefftime, value\r\n\r\n0, 1\r\n1,2\r\n\r\n".encode()))

    import_csv(path, tmp_path / "r.mcap")

    assert _readings(tmp_path / "r.mcap")["value_V"].tolist() == [1.0, 2.0]


def test_a_log_longer_than_a_block_goes_on_counting(tmp_path: Path) -> None:
    count = 65_536 + 3
    log = _write(tmp_path, "time,value\n" + "".join(f"{1_700_000_000 + n},{n}\n" for n in range(count)))

    import_csv(log, tmp_path / "r.mcap")

    readings = _readings(tmp_path / "r.mcap")
    assert readings["index"].tolist() == readings["value_V"].tolist() == list(range(count))
    with Recording(tmp_path / "r.mcap") as recording:
        assert recording.description.session["time_epoch"].startswith("1970")
        assert (recording.statistics().lost, recording.statistics().gaps) == (0, 0)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", r"is empty; its first line must be the header time,value"),
        ("time,value\n", r"holds no reading below its header"),
        ("0,1\n1,2\n", r"line 1, header '0,1': must begin with time,value"),
        ("time\n0\n", r"line 1, header 'time': must begin with time,value"),
        ("value,time\n0,1\n", r"line 1, header 'value,time': must begin with time,value"),
        ("time;value\n0;1\n", r"line 1, header 'time;value': must begin"),
        ("time,value,t,t\n0,1,2,3\n", r"line 1, column 't': must have a name of its own"),
        ("time,value,\n0,1,2\n", r"line 1, column '': must have a name of its own"),
        ("time,value\n0,1\n1,volt\n", r"line 3, column 'value': 'volt': must be a number"),
        ("time,value\n0,1\n1,1,5\n", r"line 3, 3 cells: must be 2 as in the header"),
        ("time,value\n0,1\n1\n", r"line 3, 1 cells: must be 2 as in the header"),
        ("time,value,t\n0,1,warm\n", r"line 2, column 't': 'warm': must be a number"),
        ("time,value\n12:30,1\n", r"line 2, column 'time': '12:30': must be seconds"),
        ("time,value\n,1\n", r"line 2, column 'time': '': must be seconds"),
        ("time,value\nnan,1\n", r"line 2, column 'time': 'nan': must be seconds"),
        ("time,value\ninf,1\n", r"line 2, column 'time': 'inf': must be seconds"),
        ("time,value\n1e999999999,1\n", r"line 2, column 'time': '1e999999999': must be seconds"),
        ("time,value\n-1,1\n", r"line 2, column 'time': '-1': must be seconds from 0"),
        ("time,value\n0,1\n2,1\n1,1\n", r"line 4, column 'time': '1': must be later than the one before, '2'; sort"),
        ("time,value\n0,1\n0.0,1\n", r"line 3, column 'time': '0.0': must be later than the one before, '0'"),
        ('time,value\n0,"1\n', r"is no CSV table: unexpected end of data"),
    ],
)
def test_a_broken_log_is_one_clear_line_and_leaves_nothing_behind(tmp_path: Path, text: str, complaint: str) -> None:
    log = _write(tmp_path, text)

    with pytest.raises(RecordingError, match=r"log\.csv: " + complaint) as refused:
        import_csv(log, tmp_path / "r.mcap")

    assert "\n" not in str(refused.value)
    assert [path.name for path in tmp_path.iterdir()] == ["log.csv"]


def test_bytes_that_are_no_table_are_one_clear_line(tmp_path: Path) -> None:
    whole = gzip.compress(b"time,value\n" + b"".join(b"%d,1\n" % n for n in range(5000)))
    for name, octets, complaint in [
        ("cut.csv.gz", whole[:-100], "cannot be unpacked: .*; fetch the file again"),
        ("plain.csv.gz", b"time,value\n0,1\n", "cannot be unpacked: not a gzipped file"),
        ("latin.csv", b"time,value,\xb5\n0,1,2\n", "is no text: invalid start byte in UTF-8; save it as UTF-8"),
    ]:
        (tmp_path / name).write_bytes(octets)
        with pytest.raises(RecordingError, match=name + ": " + complaint):
            import_csv(tmp_path / name, tmp_path / "r.mcap")
    with pytest.raises(RecordingError, match=r"none\.csv: cannot be read: no such file or directory"):
        import_csv(tmp_path / "none.csv", tmp_path / "r.mcap")

    assert not list(tmp_path.glob("r.mcap*"))


@pytest.mark.parametrize("scale", [0.0, float("nan"), float("inf")])
def test_a_scale_that_loses_the_value_is_refused(tmp_path: Path, scale: float) -> None:
    with pytest.raises(UsageError, match=r"--scale .*: must be a finite number other than 0"):
        import_csv(_write(tmp_path, "time,value\n0,1\n"), tmp_path / "r.mcap", scale=scale)


# Export.


def _record(path: Path, pairs: list[tuple[Block, Estimates]], *, with_estimates: bool = True) -> Path:
    estimator = write_parameters("aem", {}) if with_estimates else {}
    recorder = Recorder(path, Description(estimator=estimator))
    for readings, estimates in pairs:
        recorder.write(Batch(readings), estimates)
    return recorder.close()


def test_a_csv_table_has_a_row_for_each_reading_to_the_bit(tmp_path: Path) -> None:
    readings = readings_of(50)
    readings["t_ns"] = T0_NS + np.arange(50) * 66_666_667 + 1
    readings["status"][7], readings["value_V"][7] = Status.INVALID, np.nan
    estimates = estimates_of(readings)
    path = _record(tmp_path / "r.mcap", [(readings, estimates)])

    summary = export(path, tmp_path / "t.csv")

    with (tmp_path / "t.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == HEADER
    columns = dict(zip(HEADER, zip(*rows[1:], strict=True), strict=True))
    assert [int(cell) for cell in columns["index"]] == readings["index"].tolist()
    assert [int(Decimal(cell) * 10**9) for cell in columns["time_s"]] == readings["t_ns"].tolist()
    assert np.array([float(cell) for cell in columns["value_V"]]).tobytes() == readings["value_V"].tobytes()
    assert [int(cell) for cell in columns["status"]] == readings["status"].tolist()
    assert [float(cell) for cell in columns["estimate_V"]] == estimates["value_V"].tolist()
    assert [float(cell) for cell in columns["sigma_V"]] == estimates["sigma_V"].tolist()
    assert [int(cell) for cell in columns["window"]] == estimates["window"].tolist()
    assert (summary.readings, summary.estimates) == (50, 50)


def test_a_parquet_table_carries_units_and_what_the_recording_says_of_itself(tmp_path: Path) -> None:
    readings = readings_of(70_000)
    estimates = estimates_of(readings)
    path = _record(tmp_path / "r.mcap", [(readings, estimates)])

    export(path, tmp_path / "t.parquet")

    table = pq.read_table(tmp_path / "t.parquet")
    assert table.column_names == HEADER
    assert table["value_V"].to_numpy().tobytes() == readings["value_V"].tobytes()
    assert table["sigma_V"].to_numpy().tobytes() == estimates["sigma_V"].tobytes()
    assert np.abs(table["time_s"].to_numpy() * 1e9 - readings["t_ns"]).max() <= 256
    assert table.field("value_V").metadata[b"unit"] == b"V"
    assert b'"name": "aem"' in table.schema.metadata[b"aemd.estimator"]
    assert pq.ParquetFile(tmp_path / "t.parquet").metadata.num_row_groups == 2


@pytest.mark.parametrize("lag", [1, 40, 100])
def test_estimates_that_lag_stand_beside_their_reading(tmp_path: Path, lag: int) -> None:
    readings = readings_of(200)
    estimates = estimates_of(readings)
    pairs = [(readings[at : at + 25], estimates[max(at - lag, 0) : max(at + 25 - lag, 0)]) for at in range(0, 200, 25)]
    path = _record(tmp_path / "r.mcap", pairs)

    summary = export(path, tmp_path / "t.parquet")

    table = pq.read_table(tmp_path / "t.parquet")
    made = 200 - lag
    assert table["index"].to_pylist() == list(range(200))
    assert table["estimate_V"].to_pylist() == estimates["value_V"][:made].tolist() + [None] * lag
    assert table["window"].to_pylist() == estimates["window"][:made].tolist() + [None] * lag
    assert (summary.readings, summary.estimates) == (200, made)


def test_a_recording_without_estimates_has_empty_cells(tmp_path: Path) -> None:
    path = _record(tmp_path / "r.mcap", [(readings_of(2), np.empty(0, ESTIMATE))], with_estimates=False)

    export(path, tmp_path / "t.csv")

    lines = (tmp_path / "t.csv").read_text().splitlines()
    assert [line.split(",")[4:] for line in lines[1:]] == [["", "", ""]] * 2


def test_a_table_that_exists_or_has_no_known_suffix_is_refused(tmp_path: Path) -> None:
    path = _record(tmp_path / "r.mcap", [(readings_of(2), np.empty(0, ESTIMATE))])
    (tmp_path / "t.csv").write_text("mine")

    with pytest.raises(RecordingError, match=r"t\.csv: exists: a table is never overwritten"):
        export(path, tmp_path / "t.csv")
    with pytest.raises(UsageError, match=r"t\.xlsx: the name of a table must end in \.csv or \.parquet"):
        export(path, tmp_path / "t.xlsx")
    with pytest.raises(RecordingError, match=r"cannot be created: no such file or directory"):
        export(path, tmp_path / "nowhere" / "t.csv")

    assert (tmp_path / "t.csv").read_text() == "mine"


def test_a_damaged_recording_leaves_no_table_behind(tmp_path: Path) -> None:
    octets = bytearray(_record(tmp_path / "r.mcap", [(readings_of(500), np.empty(0, ESTIMATE))]).read_bytes())
    octets[octets.index(b"\x28\xb5\x2f\xfd") + 40] ^= 1  # in the first zstd frame
    (tmp_path / "bad.mcap").write_bytes(octets)

    with pytest.raises(RecordingError, match=r"bad\.mcap: is damaged: its chunk"):
        export(tmp_path / "bad.mcap", tmp_path / "t.csv")

    assert not (tmp_path / "t.csv").exists()
