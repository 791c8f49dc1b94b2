from dataclasses import replace
from math import sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aemd.model import (
    EFFECTS,
    ClockError,
    DeadBand,
    DifferenceNoise,
    HeavyTails,
    Latency,
    MissingSamples,
    Model,
    Nonlinearity,
    Quantiser,
    RangeSwitching,
    ReadingPattern,
    Readings,
    ReplayedBlock,
    Saturation,
    SignalDependentNoise,
    Sine,
    Smoothing,
    StuckReadings,
    SupplyCoupling,
    TimestampJitter,
    WhiteNoise,
)

SEED = 20190429
N = 200_000
EVERY = (
    DifferenceNoise(sd_V=0.1),
    HeavyTails(sd_V=0.1, dof=4.0),
    SignalDependentNoise(fraction=0.2),
    SupplyCoupling(coefficient_per_V=0.5, sd_V=0.1, tau_s=10.0),
    Nonlinearity(coefficient_per_V=0.1),
    DeadBand(width_V=0.4),
    RangeSwitching(threshold_V=1.0, hysteresis_V=0.3, offset_V=0.1, sd_V=0.2),
    ReadingPattern(offsets_V=(0.1, -0.1, 0.0), first=1),
    Smoothing(kept=0.4),
    Saturation(low_V=-1.5, high_V=1.5),
    Quantiser(step_V=0.01),
    StuckReadings(fraction=0.2, mean_readings=3.0),
    ReplayedBlock(first_index=5, readings=9),
    MissingSamples(fraction=0.2, mean_readings=2.0, counted=False),
    TimestampJitter(sd_s=0.05),
    ClockError(error_ppm=100.0, drift_ppm_per_day=1e6),
    Latency(lag_s=0.3),
)


def make_readings(value_V, interval_s=0.1):
    values = np.asarray(value_V, dtype=np.float64)
    index = np.arange(values.size)
    return Readings(index, index * interval_s, values)


def applied(effect, readings, seed=SEED):
    return effect.realise(np.random.default_rng(seed)).apply(readings)


def normal(n=N, seed=1):
    return np.random.default_rng(seed).standard_normal(n)


def test_every_effect_of_the_catalogue_is_tried_here():
    assert {type(effect) for effect in EVERY} == set(EFFECTS.values())


@settings(deadline=None)
@given(cuts=st.lists(st.integers(0, 200), max_size=8), seed=st.integers(0, 2**32))
def test_what_effects_do_does_not_depend_on_how_the_stream_is_cut(cuts, seed):
    model = Model((Sine(amplitude_V=2.0, frequency_hz=0.1), WhiteNoise(density_V_per_rt_hz=0.02)), seed, EVERY)
    start_s = np.arange(200) * 0.1
    whole, source = model.realise().read(start_s, 0.02), model.realise()
    pieces = [source.read(piece, 0.02) for piece in np.split(start_s, sorted(cuts))]

    for part in ("index", "stamp_s", "value_V"):
        assert np.concatenate([getattr(piece, part) for piece in pieces]).tobytes() == getattr(whole, part).tobytes()


def test_an_effect_keeps_its_history_when_terms_are_added():
    start_s, noise = np.arange(100) * 0.1, DifferenceNoise(sd_V=1.0)
    alone = Model((), 3, (noise,)).realise().read(start_s, 0.02).value_V
    sine = Sine(amplitude_V=1.0, frequency_hz=0.2)
    beside = Model((sine,), 3, (noise,)).realise().read(start_s, 0.02).value_V

    assert beside - sine.average(start_s, 0.02) == pytest.approx(alone, abs=1e-14)


def test_effects_meet_a_reading_in_their_order():
    bent_then_clipped = Model((), 1, (ReadingPattern(offsets_V=(2.0, 3.0)), Saturation(low_V=0.0, high_V=1.0)))
    clipped_then_bent = replace(bent_then_clipped, effects=bent_then_clipped.effects[::-1])

    assert bent_then_clipped.realise().read(np.zeros(1), 0.1).value_V.tolist() == [1.0]
    assert clipped_then_bent.realise().read(np.zeros(1), 0.1).value_V.tolist() == [2.0]


def test_difference_noise_has_twice_the_variance_and_minus_half_of_it_between_neighbours():
    noise = applied(DifferenceNoise(sd_V=2.0), make_readings(np.zeros(N))).value_V

    assert noise.var() == pytest.approx(8.0, rel=5 * sqrt(3 / N))
    assert noise[1:] @ noise[:-1] / N == pytest.approx(-4.0, rel=5 * sqrt(6 / N))
    assert abs(noise[2:] @ noise[:-2] / N) < 5 * 8 / sqrt(N)


def test_heavy_tails_have_the_standard_deviation_and_the_kurtosis_of_student():
    added = applied(HeavyTails(sd_V=3.0, dof=12.0), make_readings(np.zeros(N))).value_V

    assert added.std() == pytest.approx(3.0, rel=0.02)
    assert np.mean(added**4) / added.var() ** 2 - 3 == pytest.approx(6 / (12 - 4), abs=0.15)


def test_signal_dependent_noise_grows_with_the_reading():
    ratio = applied(SignalDependentNoise(fraction=0.1), make_readings(np.repeat([0.0, 5.0], N))).value_V

    assert np.all(ratio[:N] == 0)
    assert ratio[N:].std() == pytest.approx(0.5, rel=5 / sqrt(2 * N))


def test_a_bent_scale_turns_vibration_into_an_offset():
    bent = applied(Nonlinearity(coefficient_per_V=0.3, centre_V=1.0), make_readings(1.0 + 0.5 * normal())).value_V

    assert bent.mean() - 1.0 == pytest.approx(0.3 * 0.25, abs=5 * 0.55 / sqrt(N))


def test_the_quantiser_rounds_to_its_lattice():
    values = normal(1000)
    rounded = applied(Quantiser(step_V=0.25, offset_V=0.1), make_readings(values)).value_V

    assert np.abs(rounded - values).max() <= 0.125 + 1e-12
    assert np.unique(np.round((rounded - 0.1) / 0.25, 9) % 1).tolist() == [0.0]


def test_a_fine_quantiser_adds_a_twelfth_of_its_step_squared():
    values = normal()
    error = applied(Quantiser(step_V=0.2), make_readings(values)).value_V - values

    assert error.var() == pytest.approx(0.2**2 / 12, rel=5 * sqrt(0.8 / N))


def test_the_dead_band_leaves_an_atom_and_a_hole():
    values = normal()
    read = applied(DeadBand(width_V=0.2, level_V=0.5), make_readings(values)).value_V
    inside = np.abs(values - 0.5) < 0.1

    assert np.all(read[inside] == 0.5)
    assert read[~inside].tolist() == values[~inside].tolist()


def test_ranges_are_left_below_where_they_are_taken():
    switching = RangeSwitching(threshold_V=1.0, hysteresis_V=0.5, offset_V=10.0)
    read = applied(switching, make_readings([0.6, 0.9, 1.0, 0.6, -0.7, 0.49, 0.6, -1.2])).value_V

    assert (read > 5).tolist() == [False, False, True, True, True, False, False, True]


def test_a_pattern_follows_the_number_of_the_reading_over_a_gap():
    readings = make_readings(np.zeros(6))
    gapped = replace(readings, index=np.array([0, 1, 2, 7, 8, 9]))

    assert applied(ReadingPattern(offsets_V=(1.0, 2.0, 3.0), first=1), gapped).value_V.tolist() == [2, 3, 1, 3, 1, 2]


@pytest.mark.parametrize("mean_readings", [1.0, 4.0])
def test_missing_samples_are_as_many_and_in_runs_as_long_as_they_should(mean_readings):
    kept = applied(MissingSamples(fraction=0.1, mean_readings=mean_readings), make_readings(np.zeros(N)))
    runs = np.diff(kept.index) - 1
    runs = runs[runs > 0]
    episodes = 0.1 * N / mean_readings

    assert 1 - kept.index.size / N == pytest.approx(0.1, rel=5 * sqrt(2 / episodes))
    # Episodes may touch: a run is one of them and, each time with the chance that the wait is 0, one more.
    wait_is_0 = 0.1 / (0.1 + 0.9 * mean_readings)
    assert runs.mean() == pytest.approx(mean_readings / (1 - wait_is_0), rel=5 * sqrt(2 / episodes))


def test_missing_samples_that_nobody_counts_leave_no_jump_in_the_numbers_but_in_the_stamps():
    kept = applied(MissingSamples(fraction=0.3, counted=False), make_readings(np.zeros(1000)))

    assert kept.index.tolist() == list(range(kept.index.size))
    assert np.diff(kept.stamp_s).max() > 0.15


def test_stuck_readings_repeat_the_last_good_one():
    values = np.arange(float(N))
    read = applied(StuckReadings(fraction=0.2, mean_readings=5.0), make_readings(values)).value_V
    stuck = read != values

    assert stuck.mean() == pytest.approx(0.2, rel=5 * sqrt(10 / (0.2 * N)))
    assert read[1:][stuck[1:]].tolist() == read[:-1][stuck[1:]].tolist()


def test_a_replayed_block_follows_its_original():
    read = applied(ReplayedBlock(first_index=3, readings=4), make_readings(np.arange(14.0))).value_V

    assert read.tolist() == [0, 1, 2, 3, 4, 5, 6, 3, 4, 5, 6, 11, 12, 13]


def test_jittered_stamps_scatter_and_never_go_back():
    small = applied(TimestampJitter(sd_s=0.01), make_readings(np.zeros(N))).stamp_s - np.arange(N) * 0.1
    large = applied(TimestampJitter(sd_s=0.5), make_readings(np.zeros(N))).stamp_s

    assert small.std() == pytest.approx(0.01, rel=5 / sqrt(2 * N))
    assert np.diff(large).min() >= 0


def test_a_clock_runs_fast_by_its_parts_in_a_million_and_drifts():
    stamp_s = applied(ClockError(error_ppm=50.0, drift_ppm_per_day=20.0), make_readings([0.0, 0.0], 86_400)).stamp_s

    assert stamp_s[1] - 86_400 == pytest.approx(86_400 * 60e-6, rel=1e-6)  # 50 at first, 70 at last


def test_latency_is_in_every_stamp():
    assert applied(Latency(lag_s=0.25), make_readings([0.0, 0.0])).stamp_s.tolist() == [0.25, 0.35]


def test_saturation_piles_up_at_its_ends():
    values = normal()
    clipped = applied(Saturation(low_V=-1.0, high_V=2.0), make_readings(values)).value_V

    assert np.count_nonzero(clipped == -1.0) == np.count_nonzero(values <= -1)
    assert np.count_nonzero(clipped == 2.0) == np.count_nonzero(values >= 2)


def test_smoothing_forgets_by_its_share_from_a_settled_start():
    read = applied(Smoothing(kept=0.6), make_readings([5.0, 5.0, 6.0, 5.0, 5.0])).value_V

    assert read == pytest.approx([5, 5, 5.4, 5.24, 5.144])


def test_smoothing_leaves_the_variance_of_an_exponential_mean():
    # (1 - kept)/(1 + kept) of white noise's variance.
    read = applied(Smoothing(kept=0.6), make_readings(normal())).value_V

    assert read.var() == pytest.approx(0.25, rel=5 * sqrt(2 * 4 / N))
