"""A recording in Python: arrays, and the same memory as a DataFrame and as an Arrow table."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

import aemd
from aemd.block import ESTIMATE, Batch
from aemd.errors import UsageError
from aemd.record.description import Description, write_parameters
from aemd.record.reader import Recording
from aemd.record.writer import Recorder
from tests.record.made import estimates_of, readings_of


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A recording of 70,000 readings with estimates but for the last ten, in millikelvin."""
    readings = readings_of(70_000)
    recorder = Recorder(tmp_path / "r.mcap", Description(unit="mK", estimator=write_parameters("aem", {})))
    recorder.write(Batch(readings), estimates_of(readings)[:-10])
    return recorder.close()


def test_columns_are_the_recorded_bits_and_nan_where_there_is_no_estimate(path: Path) -> None:
    readings = readings_of(70_000)
    estimates = estimates_of(readings)

    found = aemd.open(path)

    assert found.readings == 70_000
    for name in ("index", "t_ns", "value_V", "status"):
        assert found[name].tobytes() == readings[name].tobytes()
    for name, field in (("estimate_V", "value_V"), ("u_V", "u_V"), ("passes", "passes"), ("estimate_status", "status")):
        assert found[name][:-10].tobytes() == estimates[field][:-10].tobytes()
    assert np.isnan(found["estimate_V"][-10:]).all()
    assert not found["window"][-10:].any()
    assert found.time[0] == np.datetime64("2023-11-14T22:13:20", "ns")


def test_a_dataframe_is_the_same_memory(path: Path) -> None:
    pytest.importorskip("pandas", reason="no pandas: install aemd[pandas]")
    found = aemd.open(path)

    frame = found.to_pandas()

    assert frame.index.name == "time"
    assert str(frame.index.tz) == "UTC"
    for name in frame.columns:
        assert np.shares_memory(frame[name].to_numpy(), found[name]), name
    assert np.shares_memory(frame.index.asi8, found["t_ns"])


def test_an_arrow_table_is_the_same_memory_and_knows_its_unit(path: Path) -> None:
    found = aemd.open(path)

    table = found.to_arrow()

    for name in ("index", "value_V", "estimate_V", "status"):
        buffer = table[name].chunk(0).buffers()[1]
        assert buffer.address == found[name].ctypes.data, name
    assert table["time"].chunk(0).buffers()[1].address == found["t_ns"].ctypes.data
    assert table.schema.metadata[b"unit"] == b"mK"


def test_a_recording_without_estimates_has_no_columns_for_them(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "r.mcap", Description())
    recorder.write(Batch(readings_of(5)), np.empty(0, ESTIMATE))

    assert list(aemd.open(recorder.close())) == ["index", "t_ns", "value_V", "status"]


def test_another_programs_file_opens_by_topic_and_field(tmp_path: Path) -> None:
    with (tmp_path / "v.mcap").open("wb") as out:
        writer = Writer(out)
        writer.start()
        channel = writer.register_channel("/v", "json", 0)
        for number in range(3):
            writer.add_message(channel, number, b'{"a": %d, "b": 0}' % number, number)
        writer.finish()

    assert aemd.open(tmp_path / "v.mcap", field="a")["value_V"].tolist() == [0.0, 1.0, 2.0]
    with pytest.raises(UsageError, match="among: /v a, /v b"):
        aemd.open(tmp_path / "v.mcap")


def test_the_example_for_pandas_runs(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lines that the README gives."""
    pytest.importorskip("pandas", reason="no pandas: install aemd[pandas]")
    monkeypatch.chdir(path.parent)
    path.rename("recording.mcap")
    names: dict[str, object] = {}

    exec(  # the example is text there, too
        "import aemd\n"
        'frame = aemd.open("recording.mcap").to_pandas()\n'
        'frame["residual_V"] = frame["value_V"] - frame["estimate_V"]\n'
        'minutes = frame[["value_V", "estimate_V"]].resample("1min").mean()\n'
        "print(minutes.head())\n",
        names,
    )

    with Recording(Path("recording.mcap")) as recording:
        first = next(recording.batches(900)).readings["value_V"]
    minutes = names["minutes"]
    assert minutes["value_V"].iloc[0] == pytest.approx(first[:600].mean())  # type: ignore[index] # 22:13:20 to :14:00


def test_importing_aemd_imports_no_library() -> None:
    script = "import sys, aemd; print([name for name in ('numpy', 'mcap', 'pyarrow', 'numba') if name in sys.modules])"

    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)

    assert found.stdout.strip() == "[]"


def test_reading_makes_room_where_the_file_does_not_tell_how_many(tmp_path: Path, path: Path) -> None:
    octets = path.read_bytes()
    unfinished = tmp_path / "cut.mcap.active"
    unfinished.write_bytes(octets[: octets.rindex(b"aemd.close") - 20])

    assert aemd.open(unfinished)["value_V"].tobytes() == readings_of(70_000)["value_V"].tobytes()
