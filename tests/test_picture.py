"""What a picture shows: every point of a short recording; of a long one the extremes, in memory that does not grow."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread

from aemd.block import Batch, Block, Status
from aemd.picture import BINS, _gather, draw
from aemd.record.description import Description, write_parameters
from aemd.record.source import Selection, open_readings
from aemd.record.writer import Recorder
from tests.record.made import STEP_NS, estimates_of, readings_of


@pytest.fixture
def written(tmp_path: Path) -> Callable[[Block], Path]:
    """Return a function that writes readings with estimates in chunks of 20 kB."""

    def write(readings: Block) -> Path:
        description = Description(estimator=write_parameters("aem", {}))
        recorder = Recorder(tmp_path / "r.mcap", description, chunk_bytes=20_000)
        recorder.write(Batch(readings), estimates_of(readings))
        return recorder.close()

    return write


def test_a_short_recording_is_drawn_point_by_point_and_broken_at_a_gap(written: Callable[[Block], Path]) -> None:
    readings = np.delete(readings_of(1000), slice(300, 310))
    readings["status"][500], readings["value_V"][500] = Status.OVERLOAD_HIGH, np.nan

    with open_readings(written(readings)) as recording:
        shown = _gather(recording, None)

    assert shown is not None
    time_s, values = shown.lines["raw"]
    there = np.isfinite(values)
    np.testing.assert_array_equal(values[there], np.delete(readings["value_V"], 500))
    assert np.flatnonzero(~there).tolist() == [300, 501]  # the break itself, then the overload behind it
    assert np.allclose(shown.gaps, [(299 * STEP_NS * 1e-9, 310 * STEP_NS * 1e-9)])
    assert np.allclose(shown.no_value, [510 * STEP_NS * 1e-9])
    assert time_s[-1] == pytest.approx(shown.span_s)


@pytest.mark.parametrize("chunks", [[slice(0, 200)], [slice(0, 100), slice(100, 200)]])
def test_each_line_is_broken_at_a_gap_within_a_chunk_or_between_two(tmp_path: Path, chunks: list[slice]) -> None:
    readings = np.delete(readings_of(300), slice(100, 200))
    estimates = estimates_of(readings)
    now_ns = 0
    recorder = Recorder(
        tmp_path / "r.mcap",
        Description(estimator=write_parameters("aem", {})),
        flush_interval_s=1.0,
        clock=lambda: now_ns,
    )
    for part in chunks:
        recorder.write(Batch(readings[part]), estimates[part])
        now_ns += 2 * 10**9
        recorder.write(Batch(readings[:0]), estimates[:0])  # what is held is written: the chunk ends

    with open_readings(recorder.close()) as recording:
        assert len(list(recording.batches())) == len(chunks)
        shown = _gather(recording, None)

    assert shown is not None
    assert {name: np.flatnonzero(np.isnan(values)).tolist() for name, (_, values) in shown.lines.items()} == {
        name: [100] for name in ("raw", "estimate", "sigma", "window")
    }


@pytest.mark.parametrize("shock", [100, 198, 199, 200, 201])
def test_a_shock_is_seen_wherever_it_is_in_the_line(shock: int, tmp_path: Path) -> None:
    """Up in the readings, down in the estimates, and in the windows: each goes where nothing else is drawn."""
    readings = readings_of(400)
    estimates = estimates_of(readings)
    readings["value_V"], estimates["value_V"], estimates["sigma_V"], estimates["window"] = 0.0, 0.0, 1e-3, 15
    readings["value_V"][shock], estimates["value_V"][shock], estimates["window"][shock] = 5.0, -5.0, 1000
    recorder = Recorder(tmp_path / "r.mcap", Description(estimator=write_parameters("aem", {})))
    recorder.write(Batch(readings), estimates)

    draw(recorder.close(), tmp_path / "p.png")

    colours = np.rint(imread(tmp_path / "p.png")[..., :3] * 255)
    height = len(colours)
    for name, above, below in (("0.65", 0.15, 0.35), ("tab:blue", 0.45, 0.65), ("tab:green", 0.8, 0.9)):
        part = colours[int(above * height) : int(below * height)]
        is_line = (np.abs(part - 255 * np.array(to_rgb(name))) < 60).all(axis=2)
        assert is_line.any(axis=1).all(), name


def test_of_a_long_recording_each_column_shows_its_extremes(written: Callable[[Block], Path]) -> None:
    readings = readings_of(50_000)
    readings["value_V"][[12_345, 40_000]] = 77.0, -88.0

    with open_readings(written(readings)) as recording:
        shown = _gather(recording, None)

    assert shown is not None
    assert shown.is_binned
    time_s, values = shown.lines["raw"]
    place = np.minimum((np.arange(50_000) * BINS) // 49_999, BINS - 1)
    assert len(values) == 2 * BINS
    assert values[0::2].tolist() == [readings["value_V"][place == column].min() for column in range(BINS)]
    assert values[1::2].tolist() == [readings["value_V"][place == column].max() for column in range(BINS)]
    assert time_s[2 * int(np.argmax(values[1::2]))] == pytest.approx(12_345 * STEP_NS * 1e-9, abs=shown.span_s / BINS)


@pytest.mark.parametrize("readings", [50, 5000])
def test_a_picture_of_a_number_in_another_file_is_drawn(
    readings: int, tmp_path: Path, written: Callable[[Block], Path]
) -> None:
    draw(written(readings_of(readings)), tmp_path / "p.png", selection=Selection("/dmm/filtered", "sigma"))

    assert (tmp_path / "p.png").read_bytes()[1:4] == b"PNG"
