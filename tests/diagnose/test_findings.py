"""What may be said of a finding beside what is left unexplained."""

from dataclasses import replace

import numpy as np
import pytest

from aemd.diagnose.evidence import Evidence
from aemd.diagnose.findings import judge_all
from aemd.diagnose.fit import fit_base, refit
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.naming import Named
from aemd.diagnose.search import Searched, search
from aemd.diagnose.terms.lines import Sines
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


@pytest.mark.parametrize(("p_value", "said"), [(5e-5, 0), (1e-6, 1)])
def test_what_does_not_predict_is_said_only_where_it_surprises_much(p_value, said):
    """A tone in one block of all: who has it in his half expects it in the other, who has not is surprised by it."""
    once = np.abs(times(N) - 25.0) < 1.2
    base = fit_base(make_data(series(clean(5, N) + 4e-3 * once * np.sin(2 * np.pi * 5.2 * times(N)))))
    line = Sines("periodic_interference", 5.2, 1.0, (1,), (0.0, 0.1), 10.0)
    fit = refit([*base.terms, line], base.data)
    evidence = Evidence("a line", p_value, 9.0, 0.0, 4.0, (line,))
    named = [(evidence, Named(fit, line, ("periodic_interference",), 1.0))]
    found = judge_all(Searched(base, fit, named, base, [evidence], [], [], ""), []).findings

    assert fit.log_likelihood > base.log_likelihood
    assert len(found) == said
    assert all("does not predict" in one.experiment for one in found)
