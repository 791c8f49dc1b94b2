"""A record with more wrong than is looked for: the report comes, and says where the search stopped."""

import numpy as np

from aemd.diagnose import criticise
from tests.diagnose.plant import series, times

N = 1_500


def test_after_six_findings_the_search_stops_and_says_what_is_left():
    """Eight lines of D = A^2 n / 4 = 240 nats each; no two are harmonics of one another, and none wanders."""
    rng = np.random.default_rng(3)
    lines_hz = (0.53, 1.31, 1.97, 2.89, 3.67, 4.61, 5.83, 6.71)
    y = rng.standard_normal(N) + sum(0.8 * np.sin(2 * np.pi * f * times(N) + f) for f in lines_hz)
    found = criticise(series(1.0 + 1e-3 * y))
    *named, left = found.findings

    assert len(named) == 6
    assert all(finding.cause == "periodic_interference" and finding.gain.nats_total > 100 for finding in named)
    assert (found.verdict, left.cause) == ("unexplained", "unexplained")
    assert left.p_value < 1e-20
    assert "strongest line" in left.experiment
    assert "the search stops after 6 findings" in left.experiment
