"""Where the residuals of a model are off is seen, said, and not seen where nothing is."""

import re

import numpy as np
import pytest

from aemd.diagnose.leftover import left_over

N, INTERVAL_S = 9000, 0.1
SLOT = np.arange(N)
EVERY = np.ones(N, dtype=bool)
T_S = SLOT * INTERVAL_S


def normal(seed):
    return np.random.default_rng(seed).standard_normal(N)


def test_of_normal_residuals_ninety_five_in_a_hundred_cells_lie_in_their_band_and_nothing_is_said_of_any():
    inside = []
    for seed in range(20):
        left = left_over(normal(seed), SLOT, EVERY, INTERVAL_S)
        inside += [np.mean((c.low <= c.ratio) & (c.ratio <= c.high)) for c in (left.over_time, left.over_frequency)]
        assert left.sentence.startswith("As coarsely as is shown here")

    assert np.mean(inside) == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / (40 * 48)))


def test_a_burst_is_told_with_its_time_its_frequency_and_its_energy():
    # A sine of amplitude a among unit noise has a^2/2 for its mean square, all of it in one band of sixteen.
    there = (T_S >= 300) & (T_S < 400)
    left = left_over(normal(1) + there * np.sin(2 * np.pi * 2.03 * T_S), SLOT, EVERY, INTERVAL_S)

    begin, end, low, high, ratio = map(float, re.findall(r"[0-9.]+", left.sentence)[:5])
    assert left.sentence.startswith("Between")
    assert (begin, end) == pytest.approx((300, 400), abs=N * INTERVAL_S / 48)
    assert low < 2.03 < high < low + 2 * 5 / 16 + 0.1
    assert ratio == pytest.approx(1 + 16 / 2, rel=0.35)  # less where a stretch has only a part of the burst


def test_a_burst_of_a_tenth_of_a_second_has_an_end_after_its_beginning():
    fast_s = 1e-3
    there = (T_S >= 300) & (T_S < 400)
    left = left_over(normal(1) + there * np.sin(2 * np.pi * 2.03 * T_S), SLOT, EVERY, fast_s)

    begin, end = map(float, re.findall(r"[0-9.]+", left.sentence)[:2])
    assert (begin, end) == pytest.approx((3.0, 4.0), abs=N * fast_s / 48)


@pytest.mark.parametrize(
    ("z", "words"),
    [
        (normal(2) * np.where(SLOT < N // 2, 1.0, 1.15), "^Between .* s and .* s the residuals hold 1"),
        (np.convolve(normal(3), [1.0, 0.12], "same") / np.hypot(1, 0.12), "Hz, over the whole record, the residuals"),
        (np.where(SLOT % 300 == 0, 6.0, normal(4)), "^Residuals beyond 4 of their standard deviations come .* times"),
    ],
)
def test_what_is_off_in_time_frequency_or_size_alone_is_told_as_that(z, words):
    assert re.search(words, left_over(z, SLOT, EVERY, INTERVAL_S).sentence)


def test_readings_that_are_missing_leave_no_hole_in_the_energy():
    there = EVERY & (np.random.default_rng(5).random(N) < 0.5)
    left = left_over(normal(6)[there], SLOT[there], np.ones(there.sum(), dtype=bool), INTERVAL_S)

    assert left.over_time.ratio.mean() == pytest.approx(1, abs=0.05)
    assert left.energy.mean() == pytest.approx(1, abs=0.05)


def test_a_hundred_residuals_are_enough():
    left = left_over(normal(7)[:100], SLOT[:100], EVERY[:100], INTERVAL_S)

    assert np.isfinite(left.energy).all()
    assert left.energy.shape == (left.band_edges_hz.size - 1, left.over_time.edges.size - 1)
