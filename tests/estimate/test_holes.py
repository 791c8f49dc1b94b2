"""What every estimator does where readings lack, and that no cutting of the stream changes a bit."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from aemd.block import READING, Block, Estimates, Status, make_block
from aemd.estimate import ESTIMATORS, make_estimator

INTERVAL_S = 1 / 15
OWN = ["aem", "rem", "kalman", "lms"]
EVERY = [*OWN, "filterpy"]
SMOOTHED = {"e_step": "smoothed", "delta": 1e-4}


def quiet(n: int, seed: int = 1, level_V: float = 0.1) -> Block:
    return make_block(
        level_V + np.random.default_rng(seed).normal(0, 1e-3, n), first_index=5, interval_ns=1e9 * INTERVAL_S
    )


def flag(block: Block, first: int, count: int = 1) -> Block:
    """Overload `count` readings."""
    block["status"][first : first + count] |= int(Status.OVERLOAD_HIGH)
    block["value_V"][first : first + count] = np.nan
    return block


def lose(block: Block, first: int, count: int) -> Block:
    """Let `count` readings be lost before the one at `first`."""
    block["index"][first:] += count
    block["status"][first] |= int(Status.GAP)
    return block


def run(name: str, block: Block, **options: object) -> Estimates:
    return make_estimator(name, options, INTERVAL_S).push(block)


def has(estimates: Estimates, bit: Status) -> list[int]:
    """Places of the estimates with this bit."""
    return np.flatnonzero(estimates["status"] & int(bit)).tolist()


@given(
    cuts=st.lists(st.integers(0, 200), max_size=12),
    seed=st.integers(0, 10**6),
    kind=st.sampled_from(
        [("aem", {}), ("aem", SMOOTHED), ("rem", {"r_max": 40, "delta": 0.0}), ("kalman", {}), ("lms", {})]
    ),
)
@hypothesis_settings(max_examples=150)
def test_no_cutting_of_the_stream_changes_a_bit(
    cuts: list[int], seed: int, kind: tuple[str, dict[str, object]]
) -> None:
    random = np.random.default_rng(seed)
    block = quiet(200, seed)
    block["value_V"][random.integers(0, 200, 5)] += random.normal(0, 0.02, 5)
    flag(lose(lose(block, random.integers(1, 200), 3), random.integers(1, 200), 30), random.integers(0, 200), 2)
    name, options = kind
    whole = make_estimator(name, options, INTERVAL_S).push(block)

    cut = make_estimator(name, options, INTERVAL_S)
    pieces = [cut.push(block[a:b]) for a, b in pairwise([0, *sorted(cuts), 200])]

    assert np.concatenate([*pieces, cut.flush()]).tobytes() == whole.tobytes()


@pytest.mark.parametrize("name", EVERY)
def test_one_estimate_comes_out_for_each_reading_with_its_number_instant_and_bits(name: str) -> None:
    block = flag(lose(quiet(60), 30, 4), 40)
    block["status"][50] |= int(Status.TIMING)

    estimates = run(name, block)

    np.testing.assert_array_equal(estimates["index"], block["index"])
    np.testing.assert_array_equal(estimates["t_ns"], block["t_ns"])
    np.testing.assert_array_equal(estimates["status"] & 0xFF, block["status"])


@pytest.mark.parametrize("name", EVERY)
def test_the_readings_are_left_as_they_were_and_may_be_read_only(name: str) -> None:
    block = quiet(40)
    before = block.tobytes()
    block.setflags(write=False)

    run(name, block)

    assert block.tobytes() == before


@pytest.mark.parametrize("name", EVERY)
def test_a_flagged_reading_is_predicted_over_and_sigma_grows(name: str) -> None:
    estimates = run(name, flag(quiet(60), 40, 3))

    assert set(has(estimates, Status.COASTED)) >= {40, 41, 42}
    assert np.all(np.diff(estimates["sigma_V"][39:43]) > 0)
    assert np.all(estimates["value_V"][40:43] == estimates["value_V"][39])
    assert np.all(estimates["log_likelihood"][40:43] == 0)


@pytest.mark.parametrize("name", ["kalman", "aem", "rem"])
def test_a_lost_reading_widens_sigma_as_a_flagged_one_does(name: str) -> None:
    lost = np.delete(quiet(60), [40, 41])
    flagged = flag(quiet(60), 40, 2)

    after_loss = run(name, lost)[40:]
    after_flags = run(name, flagged)[42:]

    for field in ("value_V", "sigma_V", "u_V", "window", "log_likelihood"):
        np.testing.assert_allclose(after_loss[field], after_flags[field], rtol=1e-12, err_msg=field)


def test_aem_coasts_until_no_window_holds_the_hole() -> None:
    estimates = run("aem", flag(quiet(100), 40))

    assert has(estimates, Status.COASTED) == list(range(40, 55))
    assert np.all(estimates["window"][40:55] == 0)
    assert np.all(estimates["window"][55:] > 0)
    assert np.all(np.diff(estimates["sigma_V"][39:55]) > 0)


def test_aem_with_the_kalman_filter_in_holes_loses_only_the_flagged_reading() -> None:
    estimates = run("aem", flag(quiet(100), 40), holes="kalman")

    assert has(estimates, Status.COASTED) == [40]
    assert has(estimates, Status.START_UP) == [*range(15), *range(41, 55)]
    assert estimates["sigma_V"][41:].max() < estimates["sigma_V"][40]


@pytest.mark.parametrize("holes", ["coast", "kalman"])
def test_frequent_flags_do_not_keep_aem_from_readings_for_ever(holes: str) -> None:
    block = quiet(1000)
    for place in range(50, 1000, 10):
        flag(block, place)

    estimates = run("aem", block, holes=holes)

    assert estimates["sigma_V"][100:].max() < 0.93e-3 * np.sqrt(20)
    assert np.count_nonzero(estimates["status"][100:] & int(Status.START_UP)) >= 800


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("lost", [True, False], ids=["lost", "flagged"])
def test_fifteen_readings_are_bridged_and_sixteen_start_afresh(name: str, lost: bool) -> None:
    def hole_of(count: int) -> Block:
        return lose(quiet(80), 40, count) if lost else flag(quiet(80), 40, count)

    back = 40 if lost else 56

    assert has(run(name, hole_of(15)), Status.RESTARTED) == []
    assert has(run(name, hole_of(16)), Status.RESTARTED) == [back]


@pytest.mark.parametrize("name", EVERY)
def test_after_a_restart_the_estimates_are_those_of_a_new_estimator(name: str) -> None:
    block = lose(quiet(120, level_V=0.0), 60, 1000)
    block["value_V"][:60] += 3.0

    old = run(name, block)[60:]
    new = run(name, block[60:])

    for field in ("value_V", "sigma_V", "u_V", "window", "spread"):
        np.testing.assert_array_equal(old[field], new[field], err_msg=field)


@pytest.mark.parametrize("name", EVERY)
def test_a_number_that_goes_back_is_another_acquisition(name: str) -> None:
    block = quiet(60)
    block["index"][30:] -= 20

    assert has(run(name, block), Status.RESTARTED) == [30]


@pytest.mark.parametrize("name", EVERY)
def test_before_the_first_value_the_answer_is_zero_give_or_take_a_kilovolt(name: str) -> None:
    estimates = run(name, flag(quiet(60), 0, 20))

    assert np.all(estimates["value_V"][:20] == 0)
    assert np.all(estimates["sigma_V"][:20] >= 1000)
    assert has(estimates, Status.COASTED) == list(range(20))
    assert has(estimates, Status.RESTARTED) == []
    assert estimates["value_V"][20] == pytest.approx(0.1, abs=5e-3)
    assert estimates["sigma_V"][20] < 2e-3


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("wild", [1e30, -1e300, np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("place", [0, 1, 30])
def test_a_wild_value_leaves_no_trace_but_a_hole(name: str, wild: float, place: int) -> None:
    """Even unflagged: the estimates are those of a stream in which that reading was flagged."""
    block, flagged = quiet(100), flag(quiet(100), place)
    block["value_V"][place] = wild

    estimates, expected = run(name, block), run(name, flagged)

    estimates["status"] |= flagged["status"]
    assert estimates.tobytes() == expected.tobytes()
    assert np.isfinite(estimates["value_V"]).all()


@pytest.mark.parametrize("name", EVERY)
def test_a_level_beyond_the_gate_is_accepted_once_it_stays(name: str) -> None:
    block = quiet(100)
    block["value_V"][50:] += 1e5  # 1e8 standard deviations

    estimates = run(name, block, prior_sigma_V=1e6)

    assert has(estimates, Status.RESTARTED) == [66]
    assert estimates["value_V"][-1] == pytest.approx(1e5 + 0.1, abs=5e-3)


@pytest.mark.parametrize("name", EVERY)
@given(
    values=st.lists(st.floats(width=64), min_size=1, max_size=60),
    flags=st.lists(st.sampled_from([0, 0, 0, 1, 2, 4, 8, 16]), min_size=60, max_size=60),
    jumps=st.lists(st.sampled_from([1, 1, 1, 2, 17, 10**12, -5]), min_size=60, max_size=60),
)
@hypothesis_settings(max_examples=40)
def test_whatever_comes_in_what_comes_out_is_finite(
    name: str, values: list[float], flags: list[int], jumps: list[int]
) -> None:
    block = make_block(values)
    block["status"] = flags[: block.size]
    block["index"] = np.cumsum(jumps[: block.size])

    estimates = run(name, block)

    for field in ("value_V", "sigma_V", "u_V", "spread", "log_likelihood"):
        assert np.isfinite(estimates[field]).all(), field
    assert np.all(estimates["sigma_V"] > 0)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_nothing_in_gives_nothing_out(name: str) -> None:
    estimator = make_estimator(name, {}, INTERVAL_S)

    assert estimator.push(np.empty(0, dtype=READING)).size == 0
    assert estimator.flush().size == 0
