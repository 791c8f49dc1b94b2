"""Decimation: whatever the level, the span and the cutting into batches, no extreme is lost and no sum is wrong."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from aemd.live.pyramid import BINS, LEVELS, Pyramid, bin_ns

T0_NS = 1_795_345_851_596_318_191


def make(t_ns: np.ndarray, value: np.ndarray, cuts: list[int]) -> Pyramid:
    pyramid = Pyramid(["lo"], ["hi"], ["count"])
    for rows in np.split(np.arange(t_ns.size), sorted(cut % (t_ns.size + 1) for cut in cuts)):
        ones = np.ones(rows.size)
        pyramid.add(t_ns[rows], {"lo": value[rows], "hi": value[rows], "count": ones})
    return pyramid


values = hnp.arrays(np.float64, st.integers(1, 300), elements=st.floats(-1e9, 1e9) | st.just(np.nan))


@given(value=values, interval_ns=st.integers(1, 10**9), cuts=st.lists(st.integers(0, 300), max_size=5), data=st.data())
def test_every_bin_has_the_extremes_and_the_count_of_the_readings_in_it(
    value: np.ndarray, interval_ns: int, cuts: list[int], data: st.DataObject
) -> None:
    t_ns = T0_NS + np.arange(value.size) * interval_ns
    level = data.draw(st.integers(0, LEVELS - 1))

    bins, cells = make(t_ns, value, cuts).cells(level, 0)

    number = t_ns // bin_ns(level)
    expected = [n for n in np.unique(number) if n > number[-1] - BINS]
    assert bins.tolist() == expected
    for at, n in enumerate(expected):
        inside = value[number == n]
        finite = inside[np.isfinite(inside)]
        assert cells["count"][at] == inside.size
        assert np.array_equal(cells["lo"][at], finite.min() if finite.size else np.nan, equal_nan=True)
        assert np.array_equal(cells["hi"][at], finite.max() if finite.size else np.nan, equal_nan=True)


@given(span_ns=st.integers(10**9, 10**14), most=st.integers(200, 4000))
def test_a_span_is_never_shown_in_more_columns_than_the_screen_has_nor_in_less_than_a_quarter(
    span_ns: int, most: int
) -> None:
    level = Pyramid.choose_level(span_ns, most)

    columns = span_ns / bin_ns(level)
    assert columns <= most or level == LEVELS - 1
    assert columns > most / 4 or level == 0


def test_a_shock_of_one_reading_is_seen_a_day_later() -> None:
    t_ns = T0_NS + np.arange(86_400 * 15) * 66_666_667
    value = np.zeros(t_ns.size)
    value[1234] = 1.0

    _, cells = make(t_ns, value, [500_000]).cells(Pyramid.choose_level(86_400 * 10**9, 1600), 0)

    assert cells["hi"].max() == 1.0
    assert np.count_nonzero(cells["hi"]) == 1
    assert cells["count"].sum() == t_ns.size


def test_the_memory_does_not_grow_with_the_record() -> None:
    pyramid = make(T0_NS + np.arange(100) * 10**6, np.zeros(100), [])
    before = sum(array.nbytes for array in vars(pyramid).values() if isinstance(array, np.ndarray))
    for hour in range(100):
        t_ns = T0_NS + hour * 3600 * 10**9 + np.arange(5000) * 7 * 10**8
        pyramid.add(t_ns, {"lo": t_ns * 0.0, "hi": t_ns * 0.0, "count": t_ns * 0.0 + 1})

    assert sum(array.nbytes for array in vars(pyramid).values() if isinstance(array, np.ndarray)) == before
    assert all(len(pyramid.cells(level, 0)[0]) <= BINS for level in range(LEVELS))


def test_an_instant_before_its_predecessor_counts_as_that_instant() -> None:
    pyramid = make(np.array([10, 9, 11]) * bin_ns(0), np.array([1.0, 2.0, 3.0]), [])

    bins, cells = pyramid.cells(0, 0)

    assert bins.tolist() == [10, 11]
    assert cells["hi"].tolist() == [2.0, 3.0]


@pytest.mark.parametrize(("first", "last", "expected"), [(3, 5, [3, 4, 5]), (8, None, [8, 9]), (20, None, [])])
def test_a_window_in_the_past_can_be_asked_for(first: int, last: int | None, expected: list[int]) -> None:
    pyramid = make(np.arange(10) * bin_ns(0), np.arange(10.0), [])

    assert pyramid.cells(0, first, last)[0].tolist() == expected
