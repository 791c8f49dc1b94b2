import re
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from agilent34410 import Options

GRID_S = 20e-6


def fold_hz(frequency_hz: float, interval_s: Any) -> Any:
    """Return where sampling at equal intervals puts a frequency, as its distance to the nearest multiple."""
    turns = frequency_hz * np.asarray(interval_s)
    return np.abs(turns - np.rint(turns)) / interval_s


def nearest_hz(interval_s: float) -> float:
    """Return how close the first three harmonics of 50 and 60 Hz come to each other, or to 0 Hz, when folded."""
    folded = np.sort(
        [0.0, *(fold_hz(harmonic * mains, interval_s) for mains in (50.0, 60.0) for harmonic in (1, 2, 3))]
    )
    return float(np.diff(folded).min())


def test_at_the_default_interval_each_harmonic_of_the_mains_folds_to_a_place_of_its_own() -> None:
    default_s = Options().interval_s

    assert default_s / GRID_S == pytest.approx(round(default_s / GRID_S), abs=1e-9)
    assert nearest_hz(default_s) > 0.2  # 50 Hz in 5 s: told apart in any record worth having
    assert nearest_hz(1 / 15) < 1e-9
    assert nearest_hz(7 / 110) < 0.01


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("range_V", 5, "range_V = 5: must be one of 0.1, 1, 10, 100, 1000"),
        ("nplc", 3, "nplc = 3: must be one of 0.001, 0.002, 0.006, 0.02, 0.06, 0.2, 1, 2, 10, 100"),
        ("aperture_s", 2.0, "less than or equal to 1"),
        ("autozero", "sometimes", "'on', 'off' or 'once'"),
        ("interval_s", 0, "greater than 0"),
        ("timeout_s", 0, "greater than 0"),
        ("trigger_delay_s", -1, "greater than or equal to 0"),
    ],
)
def test_a_setting_that_the_meter_does_not_have_is_refused(key: str, value: object, message: str) -> None:
    with pytest.raises(ValidationError, match=re.escape(message)):
        TypeAdapter(Options).validate_python({key: value})
