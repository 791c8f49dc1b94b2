"""Each defect is found where it was put, and a sound record has none."""

import numpy as np
import pytest

from aemd.block import Status
from aemd.diagnose.checks.integrity import check_raw
from aemd.diagnose.checks.lattice import find_lattice
from tests.diagnose.plant import INTERVAL_S, N, clean, innovation_variance, series, times

SD_V = 1e-3 * np.sqrt(innovation_variance())


def causes(record) -> list[str]:
    return [defect.cause for defect in check_raw(record, SD_V)]


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("digits", [None, 4])
def test_a_sound_record_has_no_defect(seed, digits):
    """Rounded to 0.1 mV, a tenth of what is new in each reading, or not at all."""
    y = clean(seed, shocks_per_s=0.05)
    assert causes(series(y if digits is None else np.round(y, digits))) == []


def test_a_jump_of_the_index_is_counted():
    keep = np.ones(N, bool)
    keep[100:103] = keep[2000] = False
    y = clean(1)
    defects = check_raw(series(y[keep], index=np.arange(N)[keep], time_s=times()[keep]), SD_V)

    assert [d.cause for d in defects] == ["missing_samples"]
    assert defects[0].parameters["lost"].value == 4
    assert defects[0].parameters["gaps"].value == 2


def test_without_numbers_the_stamps_tell_what_is_missing():
    keep = np.ones(N, bool)
    keep[500] = keep[900:902] = False
    y = clean(1)
    defects = check_raw(series(y[keep], time_s=times()[keep], numbered=False, nominal_interval_s=0.0), SD_V)

    assert defects[0].parameters["lost"].value == 3


@pytest.mark.parametrize("gone", [[], [500, 900, 901, 3000]])
def test_without_numbers_late_stamps_are_not_missing_readings(gone):
    """One step in some forty is longer than one and a half intervals, and the next ones make up for it."""
    rng = np.random.default_rng(11)
    late = np.abs(rng.standard_normal(N)) * 0.3 * INTERVAL_S
    stamps = np.delete(np.sort(times() + late), gone)
    assert np.mean(np.diff(stamps) > 1.5 * INTERVAL_S) > 0.02

    defects = check_raw(series(np.delete(clean(1), gone), time_s=stamps, numbered=False, nominal_interval_s=0.0), SD_V)

    lost = {defect.cause: defect.parameters.get("lost") for defect in defects}
    assert "timestamp_jitter" in lost
    assert (lost["missing_samples"].value if gone else lost.get("missing_samples")) == (len(gone) or None)


@pytest.mark.parametrize("digits", [None, 4])
def test_a_block_that_comes_twice_is_dropped_the_second_time(digits):
    y = clean(2) if digits is None else np.round(clean(2), digits)
    y[3000:3040] = y[1000:1040]
    (defect,) = check_raw(series(y), SD_V)

    assert defect.cause == "replayed_block"
    assert defect.parameters["lag_s"].value == pytest.approx(2000 * INTERVAL_S)
    assert defect.parameters["dwell_s"].value == pytest.approx(40 * INTERVAL_S, abs=2 * INTERVAL_S)
    assert defect.dropped is not None
    assert not defect.dropped[1000:1040].any()


@pytest.mark.parametrize("digits", [None, 4])
def test_a_frozen_reading_is_found(digits):
    y = clean(3) if digits is None else np.round(clean(3), digits)
    y[700:720] = y[700]
    (defect,) = check_raw(series(y), SD_V)

    assert defect.cause == "stuck_readings"
    assert defect.dropped is not None
    assert defect.dropped.sum() == 19


def test_a_coarse_lattice_is_found_with_its_step():
    q = 0.6e-3
    (defect,) = check_raw(series(np.round(clean(4) / q) * q), SD_V)

    assert defect.cause == "quantisation"
    assert defect.parameters["step_V"].value == pytest.approx(q, rel=1e-6)


@pytest.mark.parametrize("step", [1e-3, 2.5e-7, 0.1])
def test_the_lattice_of_random_multiples_is_found_whatever_its_offset(step):
    rng = np.random.default_rng(5)
    values = 3.3 + step * rng.integers(-40, 40, 2000)

    assert find_lattice(values) == pytest.approx(step, rel=1e-6)
    assert find_lattice(values + step * rng.uniform(-0.5, 0.5, 2000)) == 0.0


@pytest.mark.parametrize("period", [2, 3, 4, 5])
def test_a_lattice_is_found_under_a_pattern_that_was_added_to_it(period):
    """Of a pattern whose last phase alone is off by 0.23 of a step, half the steps between values are uneven."""
    step = 1.2e-3
    offset = 0.23 * step * (np.arange(N) % period == period - 1)
    y = step * np.rint(clean(3) / step) + offset
    (defect,) = check_raw(series(y), SD_V)

    assert find_lattice(y) == 0.0
    assert defect.cause == "quantisation"
    assert defect.parameters["step_V"].value == pytest.approx(step, rel=1e-6)


@pytest.mark.parametrize(("sign", "quantile"), [(1, 0.99), (-1, 0.99)])
def test_a_clipped_extreme_is_found_with_its_level(sign, quantile):
    y = 1 + sign * (clean(6) - 1)
    level = float(np.quantile(sign * y, quantile) * sign)
    clipped = np.minimum(y, level) if sign > 0 else np.maximum(y, level)
    defects = {defect.cause: defect for defect in check_raw(series(clipped), SD_V)}

    assert defects["saturation"].parameters["level_V"].value == level
    assert defects["saturation"].parameters["fraction"].value == pytest.approx(0.01, rel=0.1)


def test_readings_clipped_at_both_ends_are_saturated_and_not_stuck():
    y = clean(6)
    low, high = np.quantile(y, [0.03, 0.96])
    (defect,) = check_raw(series(np.clip(y, low, high)), SD_V)

    assert defect.cause == "saturation"
    assert defect.parameters["level_V"].value in (low, high)
    assert defect.parameters["fraction"].value == pytest.approx(0.07, rel=0.02)


def test_flagged_overloads_are_saturation():
    y, status = clean(7), np.zeros(N, np.uint32)
    y[50:60], status[50:60] = np.nan, int(Status.OVERLOAD_HIGH)

    assert causes(series(y, status=status)) == ["saturation"]


def test_stamps_of_a_host_scatter_and_those_rounded_to_a_millisecond_do_not():
    rng = np.random.default_rng(80)
    logged = {"numbered": False, "nominal_interval_s": 0.0}
    scattered = times() + rng.normal(0, 3e-3, N)
    (defect,) = check_raw(series(clean(8), time_s=scattered, **logged), SD_V)

    assert defect.cause == "timestamp_jitter"
    assert defect.parameters["sd_s"].low < 3e-3 < defect.parameters["sd_s"].high
    assert causes(series(clean(8), time_s=np.round(times(), 3), **logged)) == []


def test_the_interval_of_a_scatter_knows_that_late_stamps_are_not_normal():
    """The variance of a mean square of n numbers is their fourth moment less the second's square, over n; half-normal
    ones have an excess kurtosis of 8 (pi - 3) / (pi - 2)^2, and that their differences share stamps adds 1 to it."""
    late_s = 4e-3 * np.abs(np.random.default_rng(81).standard_normal(N))
    (defect,) = check_raw(
        series(clean(8), time_s=times() + late_s, numbered=False, nominal_interval_s=0.0),
        SD_V,
    )
    sd = defect.parameters["sd_s"]
    excess = 8 * (np.pi - 3) / (np.pi - 2) ** 2

    assert sd.low < 4e-3 * np.sqrt(1 - 2 / np.pi) < sd.high
    assert (sd.high - sd.low) / 4 / sd.value == pytest.approx(np.sqrt((3 + excess) / (4 * N)), rel=0.05)


@pytest.mark.parametrize(("late", "by_s", "known"), [(80, 30e-3, True), (5, 66e-3, False)])
def test_the_interval_of_a_scatter_holds_what_stamps_that_come_late_by_far_make_of_it(late, by_s, known):
    """0.75 ms for most; of all, the variance is that and p (1 - p) of the square by which a share p is late."""
    rng = np.random.default_rng(82)
    stamps = times() + rng.normal(0, 0.75e-3, N)
    stamps[rng.choice(N, late, replace=False)] += by_s
    (defect,) = check_raw(series(clean(8), time_s=stamps, numbered=False, nominal_interval_s=0.0), SD_V)
    sd = defect.parameters["sd_s"]

    assert defect.cause == "timestamp_jitter"
    assert sd.low < np.sqrt(0.75e-3**2 + late / N * (1 - late / N) * by_s**2) < sd.high
    if known:  # 80 late ones tell it well
        assert sd.high < 1.6 * sd.low
    else:  # of five nobody knows whether there are as many in the next hour
        assert sd.low < 0.75e-3 < 1.1 * sd.low


def test_a_clock_that_was_set_once_is_not_scatter():
    stamps = times() + np.random.default_rng(83).normal(0, 2e-3, N) + 0.5 * (np.arange(N) > 0.3 * N)
    found = check_raw(series(clean(8), time_s=stamps, nominal_interval_s=0.0), SD_V)
    (sd,) = (defect.parameters["sd_s"] for defect in found if defect.cause == "timestamp_jitter")

    assert 1.8e-3 < sd.low < 2e-3 < sd.high < 2.2e-3


def test_an_interval_off_by_a_thousandth_is_a_clock_error():
    (defect,) = check_raw(series(clean(9), nominal_interval_s=INTERVAL_S / 1.001), SD_V)

    assert defect.cause == "clock_error"
    assert defect.parameters["ratio"].value == pytest.approx(1.001, abs=1e-6)


@pytest.mark.parametrize(
    ("slowed", "between_eighths"),
    [(lambda i: np.where(i > 0.4 * N, (i - 0.4 * N) * 5e-4, 0.0), 5e-4), (lambda i: 2.5e-4 * i**2 / N, 5e-4 * 7 / 8)],
    ids=["at once", "by and by"],
)
def test_a_clock_that_slows_in_a_table_is_a_clock_error(slowed, between_eighths):
    """Of t = i + c i^2 / 2 the mean intervals of the first and the last eighth are 7/8 of c n apart."""
    stamps = times() + slowed(np.arange(N)) * INTERVAL_S
    (defect,) = check_raw(series(clean(9), time_s=np.round(stamps, 6), numbered=False, nominal_interval_s=0.0), SD_V)

    assert defect.cause == "clock_error"
    assert defect.parameters["ratio"].value - 1 == pytest.approx(between_eighths, rel=0.02)


def test_losses_that_the_numbers_hide_are_seen_in_the_stamps_and_no_clock_is_blamed():
    keep = np.random.default_rng(10).random(N) > 0.02
    y, t = clean(10)[keep], times()[keep]
    (defect,) = check_raw(series(y, time_s=t), SD_V)

    assert defect.cause == "missing_samples"
    assert defect.parameters["lost"].value == pytest.approx((~keep).sum(), abs=2)  # those at the ends nobody can see


@pytest.mark.parametrize("offset_V", [0.0, 3e-4, -4e-4])
def test_the_offset_of_a_lattice_is_known_as_well_as_its_readings_are_written(offset_V):
    step_V = 2e-3
    on_it = np.round(np.round((clean(2) - offset_V) / step_V) * step_V + offset_V, 6)

    told = {defect.cause: defect for defect in check_raw(series(on_it), SD_V)}["quantisation"].parameters["offset_V"]

    assert told.low <= told.value <= told.high
    assert told.value == pytest.approx(offset_V, abs=1e-7)
    assert told.high - told.low < 1e-6


def test_instants_that_readings_tell_are_known_to_a_reading():
    y = clean(7)
    y[1000:1040] = y[1000]  # from somewhere between that reading and the next on
    stuck = check_raw(series(y), SD_V)[0].parameters

    assert stuck["time_s"].low <= times()[1000] < times()[1001] <= stuck["time_s"].high + 1e-9
    assert stuck["dwell_s"].low <= 39 * INTERVAL_S < 40 * INTERVAL_S <= stuck["dwell_s"].high
    assert stuck["fraction"].low == stuck["fraction"].high  # counted


def test_a_range_that_cut_a_lattice_ends_within_a_cell():
    y = np.round(clean(3), 4)
    level = np.quantile(y, 0.93)
    told = {d.cause: d for d in check_raw(series(np.minimum(y, level)), SD_V)}["saturation"].parameters["level_V"]

    assert told.low == pytest.approx(level - 5e-5, abs=1e-9)
    assert told.high == pytest.approx(level + 5e-5, abs=1e-9)


@pytest.mark.parametrize("digits", [9, 10])
def test_a_digit_less_from_ten_volts_on_is_rounding_and_no_dead_band(digits):
    rng = np.random.default_rng(41)
    value_V = np.array([float(f"{value:.{digits}g}") for value in 10 + 1e-6 * rng.standard_normal(9_000)])
    record = series(value_V)
    step_V = 10.0 ** (2 - digits)

    assert "dead_band" not in [defect.cause for defect in check_raw(record, 1e-6)]
    assert "quantisation" not in [defect.cause for defect in check_raw(record, 4 * step_V)]
    coarse = {defect.cause: defect for defect in check_raw(record, 2 * step_V)}["quantisation"]
    assert coarse.parameters["step_V"].value == pytest.approx(step_V)
