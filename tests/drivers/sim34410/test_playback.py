import numpy as np
import pytest

from aemd.block import ESTIMATE, Batch, Status, make_block
from aemd.errors import RecordingError
from aemd.record.description import Description
from aemd.record.writer import Recorder
from sim34410 import Options, make_meter
from sim34410.playback import BEYOND_V, Playback, read_playback

TIME_s = np.array([5.0, 5.1, 5.3, 5.4])  # from 0: edges 0, 0.1, 0.3, 0.4 and, after another median of 0.1, 0.5
VALUE_V = np.array([1.0, -2.0, 4.0, 0.3])


@pytest.mark.parametrize(
    ("start_s", "aperture_s", "mean_V"),
    [
        (0.01, 0.02, 1.0),
        (0.15, 0.1, -2.0),
        (0.42, 0.05, 0.3),
        (0.08, 0.04, (0.02 * 1 - 0.02 * 2) / 0.04),
        (0.0, 0.5, (0.1 - 0.4 + 0.4 + 0.03) / 0.5),
        (0.45, 0.1, (0.05 * 0.3 + 0.05 * 1) / 0.1),  # round the end
        (5e3 + 0.15, 0.1, -2.0),  # the ten-thousandth round
        (0.0, 1.5, (0.1 - 0.4 + 0.4 + 0.03) / 0.5),
    ],
)
def test_a_recorded_value_holds_until_the_next_and_the_end_is_the_beginning(start_s, aperture_s, mean_V):
    truth = Playback(TIME_s, VALUE_V).average(np.array([start_s]), aperture_s)

    assert truth.signal_V == pytest.approx([mean_V], abs=1e-9)
    assert truth.total == pytest.approx(truth.signal_V)


def test_within_a_step_the_recorded_value_comes_back_to_the_bit():
    value_V = np.random.default_rng(1).standard_normal(1000)
    source = Playback(np.arange(1000) / 15, value_V)

    assert np.array_equal(source.average(np.arange(1000) / 15 + 0.02, 0.02).signal_V, value_V)


def test_a_csv_is_played(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("time,value,temperature\n10.0,0.5,21\n10.1,0.6,21\n10.2,0.7,21\n")
    meter = make_meter(Options(recording=path, noise=False))

    assert meter._converter._source.average(np.array([0.05, 0.15, 0.25]), 0.02).total.tolist() == [0.5, 0.6, 0.7]


def test_a_recording_of_ours_is_played_its_overloads_too(tmp_path):
    readings = make_block([0.1, np.nan, np.nan, 0.4], t0_ns=10**18, interval_ns=1e8)
    readings["status"] = [0, Status.OVERLOAD_LOW, Status.INVALID, 0]
    recorder = Recorder(tmp_path / "r.mcap", Description(interval_s=0.1))
    recorder.write(Batch(readings), np.zeros(0, ESTIMATE))
    source = read_playback(recorder.close("end"))

    assert source.average(np.array([0.05, 0.15, 0.25, 0.35]), 0.02).total.tolist() == [0.1, -BEYOND_V, -BEYOND_V, 0.4]


@pytest.mark.parametrize(
    ("content", "rule"),
    [
        (None, "No such file"),
        ("", "must begin with time,value"),
        ("t,v\n0,1\n1,2\n", "must begin with time,value"),
        ("time,value\n0,1\n", "at least two"),
        ("time,value\n", "at least two"),
        ("time,value\n0,1\n0,2\n", "ascending"),
        ("time,value\n0,1\n1,nan\n", "finite"),
        ("time,value\n0,1\n1,volt\n", "seconds,volts"),
        ("time,value\n0,1\n1\n", "seconds,volts"),
        ("time,value\n0,1\n\xff\n", "seconds,volts"),
    ],
)
def test_a_table_that_is_none_is_refused_in_one_line(tmp_path, content, rule):
    path = tmp_path / "log.csv"
    if content is not None:
        path.write_bytes(content.encode("latin-1"))

    with pytest.raises(RecordingError, match=rule) as caught:
        read_playback(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
