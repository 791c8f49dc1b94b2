"""A record with more wrong than is looked for: the report comes, and says where the search stopped."""

from math import log

import numpy as np
import pytest

from aemd.diagnose import criticise, format_diagnosis
from aemd.diagnose.climb import Climb, race
from aemd.diagnose.fit import fit_base, refit, residuals
from aemd.diagnose.hypothesis import Base, base_box, make_data
from aemd.diagnose.naming import acts_throughout
from aemd.diagnose.search import _stop
from aemd.diagnose.terms.lines import Sines
from aemd.diagnose.terms.noise import Resonance
from tests.diagnose.counted import Counted
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
    assert "which was not fitted: the search stops after 6 findings" in left.experiment


@pytest.mark.parametrize(("n", "found", "stops"), [(1_500, 5, False), (150_000, 3, False), (150_000, 4, True)])
def test_of_a_long_record_fewer_findings_are_sought_and_it_is_said_so(n, found, stops):
    data = make_data(series(1.0 + 1e-3 * np.random.default_rng(8).standard_normal(n)))
    theta = np.array([log(0.3), log(0.1), log(100.0), log(0.01), 0.0, 0.0])
    fit = residuals([Base(theta, shocks=False, box=base_box(data))], theta, data)

    assert _stop(fit, fit, found) == (
        f"the search stops after {found} findings, as the record is long" if stops else ""
    )


@pytest.mark.parametrize(("resonances", "steps"), [(0, 5), (8, 1)])
def test_a_start_without_hope_has_fewer_steps_beside_a_large_model(resonances, steps):
    """A step is one pass of the filter for each free number and some trials; a million nats behind there is no hope."""
    rng = np.random.default_rng(5)
    base = fit_base(make_data(series(1.0 + 1e-3 * rng.standard_normal(400))))
    beside = [Resonance(0.5 + 0.7 * k, 0.5, 2.0, 1e-3, 0.0) for k in range(resonances)]
    known = np.concatenate((base.theta, *(term.start for term in beside)))
    kinds = [Counted(0.0, "likely"), *(Counted(1e6, f"hopeless {k}") for k in range(6))]
    race([Climb([*base.terms, *beside, kind], np.append(known, 0.1), base.data, kind.cost_nats) for kind in kinds], 10)

    passes = known.size + 2
    for kind in kinds[1:]:
        assert len(kind.asked) <= steps * (passes + 9) + 3
        assert steps == 1 or len(kind.asked) > passes + 9


def test_all_findings_together_have_a_gain_of_their_own():
    """Two lines of D = A^2 n / 4 = 60 and 135 nats that share nothing: together they gain what both gain."""
    rng = np.random.default_rng(4)
    y = rng.standard_normal(N) + sum(a * np.sin(2 * np.pi * f * times(N)) for a, f in ((0.4, 1.31), (0.6, 3.67)))
    found = criticise(series(1.0 + 1e-3 * y))
    one, two = (finding.gain.nats_total for finding in found.findings)

    assert found.gain is not None
    assert found.gain.nats_total == pytest.approx(one + two, rel=0.1)
    assert "All that was found together is worth" in format_diagnosis(found)


def test_a_strong_line_a_fifth_larger_in_half_the_record_is_a_line_still():
    """Of thousands of nats that is many deviations, and yet nothing that comes and goes."""
    rng = np.random.default_rng(6)
    amplitude = np.where(times(N) < times(N)[-1] / 2, 3.3, 2.7)
    before = fit_base(make_data(series(1.0 + 1e-3 * rng.standard_normal(N))))
    data = make_data(series(1.0 + 1e-3 * (rng.standard_normal(N) + amplitude * np.sin(2 * np.pi * 1.31 * times(N)))))
    line = Sines("periodic_interference", 1.31, 1.5, (1,), (0.0, 3.0 * 1e-3 / data.unit_V), 0.0)
    unit = log(before.data.unit_V / data.unit_V)
    known = before.theta + np.array([0.0, unit, 0.0, unit, unit, 0.0, *([0.0, unit, 0.0] * before.base.shocks)])
    without, with_it = residuals(before.terms, known, data), refit([*before.terms, line], data)

    assert with_it.log_likelihood - without.log_likelihood > 1_000
    assert acts_throughout(without, with_it)
