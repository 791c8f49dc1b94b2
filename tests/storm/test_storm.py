"""A short storm on each link: the same judge as the long one of `make storm`."""

from pathlib import Path

import numpy as np
import pytest

from aemd.info import inspect
from sim34410.bench import Link
from sim34410.faults import draw_faults
from tests.storm.judge import judge
from tests.storm.weather import pass_through


@pytest.mark.parametrize("link", ["socket", "vxi11", "usb", "serial"])
@pytest.mark.parametrize("poll_s", [None, pytest.param(0.0, marks=pytest.mark.slow)])
def test_a_storm_leaves_every_reading_recorded_once_or_in_a_gap_and_every_stamp_true(
    link: Link, poll_s: float | None, tmp_path: Path
) -> None:
    faults = draw_faults(seed=3, count=12, length_s=600.0, longest_s=10.0)
    passed = pass_through(
        faults,
        660.0,
        link=link,
        recording=tmp_path / "storm.mcap",
        poll_s=poll_s,
        clock_error_ppm=100.0,
        clock_drift_ppm_per_day=5.0,
    )
    found = judge(passed)

    assert found.breaches == 0, found
    assert passed.stream.outages > 0
    assert passed.recording is not None
    told = inspect(passed.recording)
    assert (told.readings, told.lost, told.gaps) == (
        passed.readings.size,
        passed.tally.counts.lost,
        passed.tally.counts.gaps,
    )
    assert told.lost == sum(gap.last_index - gap.first_index + 1 for gap in passed.gaps)


def test_without_faults_nothing_is_lost_and_every_reading_is_the_meters() -> None:
    passed = pass_through((), 120.0)

    assert judge(passed).breaches == 0
    assert passed.gaps == []
    assert np.array_equal(passed.readings["value_V"], passed.truth["value_V"])
