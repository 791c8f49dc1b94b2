import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from aemd.model import Truth
from sim34410.memory import Fates
from sim34410.truth import TruthLog


def note(log, index, size):
    numbers = np.arange(index, index + size, dtype=float)
    log.append(1, index, numbers.astype(np.int64), 7, Truth(numbers, -numbers, 2 * numbers, 3 * numbers), numbers)


@given(sizes=st.lists(st.integers(1, 20), max_size=20), most=st.integers(0, 60))
def test_the_truth_of_the_last_readings_is_kept(sizes, most):
    log, total = TruthLog(most), 0
    for size in sizes:
        note(log, total, size)
        total += size
    expected = np.arange(max(total - most, 0), total)

    assert np.array_equal(log.rows(Fates())["index"], expected)
    assert np.array_equal(log.rows(Fates())["external_V"], 2 * expected)
