"""A state that is saved and put back is the same state: the estimates go on as if nothing had been."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aemd.block import Block, Status, make_block
from aemd.estimate.registry import ESTIMATORS, make_estimator
from aemd.estimate.state import load_state, save_state

OPTIONS = {name: {"lag": 12} if name == "imm" else {} for name in ESTIMATORS}


def _readings(count: int) -> Block:
    """Readings with an overload and a gap, of both of which estimators keep count."""
    block = make_block(np.random.default_rng(5).standard_normal(count) * 1e-3, interval_ns=1e8)
    block["value_V"][40:44], block["status"][40:44] = np.nan, Status.INVALID
    block["index"][70:] += 7
    return block


@pytest.mark.parametrize("name", ESTIMATORS)
@given(cut=st.integers(0, 100), piece=st.integers(1, 30))
def test_an_estimator_with_a_state_put_back_goes_on_to_the_bit(name: str, cut: int, piece: int) -> None:
    readings = _readings(100)
    whole, first, rest = (make_estimator(name, OPTIONS[name], 0.1) for _ in range(3))
    expected = np.concatenate([whole.push(readings), whole.flush()])

    made = [first.push(readings[at : min(at + piece, cut)]) for at in range(0, cut, piece)]
    load_state(rest, save_state(first))
    made += [rest.push(readings[cut:]), rest.flush()]

    assert np.concatenate(made).tobytes() == expected.tobytes()


def test_a_state_of_another_estimator_or_with_other_options_is_refused() -> None:
    kalman, lms, short, long = (
        make_estimator(name, options, 0.1)
        for name, options in (("kalman", {}), ("lms", {}), ("rem", {"window": 5}), ("rem", {"window": 50}))
    )

    with pytest.raises(ValueError, match="in one of estimator and state only"):
        load_state(lms, save_state(kalman))
    with pytest.raises(ValueError, match="of another type or shape"):
        load_state(long, save_state(short))
    with pytest.raises(ValueError, match="_state: not a value as JSON has them"):
        load_state(kalman, {"_state": "{"})
