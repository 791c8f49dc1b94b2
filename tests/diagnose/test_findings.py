"""What may be said of a finding beside what is left unexplained."""

from dataclasses import replace

import numpy as np
import pytest

from aemd.diagnose.evidence import Evidence
from aemd.diagnose.findings import judge_all
from aemd.diagnose.fit import fit_base
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.search import search
from tests.diagnose.plant import clean, series, times

N = 800


@pytest.fixture(scope="module")
def searched():
    hum = 1e-3 * np.sin(2 * np.pi * 6.9 * times(N))
    return search(fit_base(make_data(series(clean(5, N) + hum))), None, lambda _: None)


@pytest.mark.parametrize(("times_as_surprising", "sure"), [(1e3, False), (1e-3, True)])
def test_a_line_that_surprises_less_than_what_is_left_may_be_part_of_that(searched, times_as_surprising, sure):
    (found,) = judge_all(searched, []).findings
    left = Evidence("anything else", found.p_value / times_as_surprising, 9.0, 0.0, 4.0)
    line = judge_all(replace(searched, left=[left]), []).findings[0]

    assert found.names == ("periodic_interference",)
    assert ("unexplained" not in line.names) == sure
    assert line.probability == pytest.approx(found.probability * (1 if sure else 0.5))
