"""A witness is matched with the readings by the time of both."""

import numpy as np
import pytest

from aemd.diagnose.checks.witnessed import check_witness
from aemd.diagnose.fit import residuals
from aemd.diagnose.hypothesis import Base, base_box, make_data
from aemd.diagnose.terms.witnessed import Latency
from tests.diagnose.plant import INTERVAL_S, N, markov, series


def test_the_delay_of_a_witness_is_counted_in_time_and_not_in_readings_where_some_are_lost():
    """White readings, a rough witness 150 intervals before them, and every twentieth reading lost."""
    rng = np.random.default_rng(1)
    witness = markov(rng, N, 1.0, 1.0)
    value = rng.standard_normal(N) + np.concatenate((np.zeros(150), 0.3 * witness[:-150]))
    kept = np.flatnonzero(np.arange(N) % 20 != 7)
    made = series(
        value[kept],
        time_s=kept * INTERVAL_S,
        index=kept,
        status=np.zeros(kept.size, np.uint32),
        witnesses={"temperature": witness[kept]},
    )
    data = make_data(made)
    theta = np.array([np.log(INTERVAL_S), -12.0, np.log(5 * INTERVAL_S), -12.0, np.log(1.05 / data.unit_V), 0.0])
    fit = residuals([Base(theta, shocks=False, box=base_box(data))], theta, data)

    late = check_witness(fit, "temperature")[0]

    (lag_s,) = (term.lag_s for term in late.terms if isinstance(term, Latency))
    assert late.p_value < 1e-12
    assert lag_s == pytest.approx(150 * INTERVAL_S)
