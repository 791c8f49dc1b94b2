"""The running Allan deviation against allantools, which computes it from the whole record."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aemd.live.allan import MOST_MISSING, RunningAllan


def fed(values: np.ndarray, cuts: list[int], index: np.ndarray | None = None) -> RunningAllan:
    running = RunningAllan()
    index = np.arange(values.size) if index is None else index
    for rows in np.split(np.arange(values.size), sorted(cut % (values.size + 1) for cut in cuts)):
        running.add(index[rows], values[rows])
    return running


@pytest.mark.filterwarnings("ignore")  # allantools warns of its own imports
@given(
    size=st.integers(4, 3000),
    seed=st.integers(0, 2**31),
    walk=st.booleans(),
    cuts=st.lists(st.integers(0, 3000), max_size=6),
)
def test_it_is_the_allan_deviation_of_the_record_so_far(size: int, seed: int, walk: bool, cuts: list[int]) -> None:
    allantools = pytest.importorskip("allantools")
    values = np.random.default_rng(seed).normal(3.0, 1e-3, size)
    values = np.cumsum(values) if walk else values

    lengths, deviations, pairs = fed(values, cuts).deviations()

    taus, expected, _, counts = allantools.adev(values, rate=1.0, data_type="freq", taus=[float(m) for m in lengths])
    # allantools leaves out averaging times of which it has a single pair.
    assert set(taus.astype(int)) >= {m for m, n in zip(lengths, pairs, strict=True) if n >= 2}
    mine = dict(zip(lengths, zip(deviations, pairs, strict=True), strict=True))
    assert [mine[int(tau)][0] for tau in taus] == pytest.approx(expected, rel=1e-6)
    assert [mine[int(tau)][1] for tau in taus] == counts.astype(int).tolist()


def test_a_lost_reading_costs_the_differences_beside_it_and_nothing_else() -> None:
    index = np.array([0, 1, 2, 4, 5, 6, 7])
    values = np.array([1.0, 2.0, 4.0, 7.0, 1.0, 0.0, 5.0])

    lengths, deviations, pairs = fed(values, [3], index).deviations()

    # m = 1: steps 1, 2, -6, -1, 5; m = 2: means 1.5, 4 (of one), 4, 2.5; m = 4: 7/3, 13/4
    assert lengths == [1, 2, 4]
    assert pairs == [5, 3, 1]
    steps = [np.array([1, 2, -6, -1, 5]), np.array([2.5, 0, -1.5]), np.array([13 / 4 - 7 / 3])]
    assert deviations == pytest.approx([np.sqrt((step**2).mean() / 2) for step in steps])


@pytest.mark.parametrize("cuts", [[], [1, 4, 8]])
def test_a_block_of_which_less_than_half_is_there_is_no_block(cuts: list[int]) -> None:
    index = np.array([0, *range(4, 16)])

    lengths, _, pairs = fed(np.zeros(13), cuts, index).deviations()

    assert dict(zip(lengths, pairs, strict=True))[4] == 2  # of blocks 1, 2, 3: block 0 has one reading of four


def test_nothing_is_compared_across_a_long_hole() -> None:
    running = fed(np.zeros(1000), [])
    running.add(np.arange(1000) + 1000 + 10 * MOST_MISSING, np.ones(1000))

    assert all(deviation == 0 for deviation in running.deviations()[1])


def test_a_hole_inside_a_batch_is_one_as_well() -> None:
    running = RunningAllan()
    running.add(np.array([0, 1, 2 + MOST_MISSING * 2, 3 + MOST_MISSING * 2]), np.array([0.0, 0.0, 5.0, 5.0]))

    assert running.deviations()[1] == [0.0]
