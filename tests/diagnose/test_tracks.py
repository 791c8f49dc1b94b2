"""Lines that sweep."""

import numpy as np
import pytest

from aemd.diagnose.checks.tracks import check_wandering_line
from aemd.diagnose.fit import fit_base
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.terms.lines import WanderingLine
from tests.diagnose.plant import INTERVAL_S, clean, series, times

N = 1_600


@pytest.mark.parametrize("crosses", [20.0, 131.0, -147.0])
def test_a_line_that_sweeps_is_followed_through_many_of_the_records_frequencies(crosses):
    """131 lies halfway between two of the sweeps that are tried."""
    span_s = N * INTERVAL_S
    chirp = crosses / span_s**2
    since_s = times(N) - span_s / 2
    y = clean(11, N) + 1e-3 * np.cos(2 * np.pi * (3.1 + chirp * since_s / 2) * since_s)
    evidence = check_wandering_line(fit_base(make_data(series(y))))
    line = evidence.terms[0]

    assert evidence.p_value < 1e-6
    assert isinstance(line, WanderingLine)
    assert line.chirp_hz_per_s == pytest.approx(chirp, abs=1.5 / span_s**2)
    assert line.frequency_hz == pytest.approx(3.1, abs=1.5 / span_s)
