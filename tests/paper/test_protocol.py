"""The records of the paper's tests are what they are said to be."""

import numpy as np
import pytest

from aemd.paper.protocol import (
    APERTURE_S,
    CONDITIONS,
    INTERVAL_S,
    NOISE_V,
    READINGS,
    SHOCK_GROUPS,
    Condition,
    disturbance_scales,
    make_record,
)

SEEDS = range(30)


@pytest.mark.parametrize(("condition", "printed_mV2"), [("static", 0.212), ("dynamic", 35.5)])
def test_the_rule_gives_the_kalman_filter_the_papers_variance(condition: Condition, printed_mV2: float) -> None:
    readings = np.array([make_record(condition, seed).block["value_V"] for seed in range(200)])
    x, P = readings[:, 0].copy(), 0.99e-3**2  # a Kalman filter in five lines, all records at once
    estimates = [x.copy()]
    for k in range(1, READINGS):
        M = P + 0.93e-3**2
        K = M / (M + 0.99e-3**2)
        x, P = x + K * (readings[:, k] - x), (1 - K) * M
        estimates.append(x.copy())

    assert 1e6 * np.var(estimates, axis=0).mean() == pytest.approx(printed_mV2, rel=1e-6)


def test_shocks_and_slow_fluctuation_have_equal_shares_in_it() -> None:
    gain, share = 0.0, []
    q, r = 0.93**2, 0.99**2
    M = (q + np.sqrt(q * q + 4 * q * r)) / 2  # steady state of P = M r / (M + r), M = P + q
    gain = M / (M + r)
    for seed in range(200):
        record = make_record("static", seed)
        for part in (record.abrupt_V, record.slow_V):
            x = np.zeros(READINGS)
            for k in range(1, READINGS):
                x[k] = x[k - 1] + gain * (part[k] - x[k - 1])
            share.append(np.var(x))

    assert np.mean(share[0::2]) == pytest.approx(np.mean(share[1::2]), rel=0.01)  # but for the first reading


def test_the_static_test_has_table_2s_shocks() -> None:
    for seed in SEEDS:
        record = make_record("static", seed)
        at = np.flatnonzero(record.disturbed)
        height_mm = np.abs(record.abrupt_V[at]) / disturbance_scales().shock_V_per_mm

        assert not record.truth_V.any()
        for group in SHOCK_GROUPS:
            own = at[np.isclose(height_mm, group.displacement_mm)]
            assert own.size == group.shocks
            assert np.all(np.abs(np.diff(own) - group.cycle_s / INTERVAL_S) < 1)
        np.testing.assert_allclose(record.abrupt_variance_V2, record.abrupt_V**2)


def test_the_slow_fluctuation_is_slower_than_the_signal() -> None:
    power = np.abs(np.fft.rfft(make_record("static", 3).slow_V)) ** 2
    frequency_hz = np.fft.rfftfreq(READINGS, INTERVAL_S)

    assert power[frequency_hz > 0.0751].sum() < 1e-20 * power.sum()


def test_the_dynamic_test_has_table_4s_bursts_once_each() -> None:
    for seed in SEEDS:
        record = make_record("dynamic", seed)
        starts = np.flatnonzero(np.diff(np.concatenate([[0], record.disturbed, [0]])))
        lengths = np.sort(np.diff(starts)[::2])

        # Impulses may touch a burst or each other: at most that many readings are disturbed, and the bursts are long.
        assert 11 + 67 + 24 <= record.disturbed.sum() <= 11 + 68 + 25
        assert lengths[-1] >= 67
        assert lengths[-2] >= 24


def test_impulses_are_within_60_millivolts_and_square_waves_within_their_amplitude() -> None:
    limit_V = 2.2 * disturbance_scales().square_V_per_mm

    for seed in SEEDS:
        assert np.abs(make_record("dynamic", seed).abrupt_V).max() <= max(limit_V, 60e-3) * (1 + 1e-9)


@pytest.mark.parametrize(("place", "folded_hz"), [(0, 2.0), (1, 3.0)])
def test_the_square_waves_fold_onto_2_and_3_hz(place: int, folded_hz: float) -> None:
    record = make_record("dynamic", 2)
    level, count = np.unique(record.abrupt_variance_V2[record.disturbed], return_counts=True)
    bursts = level[count > 20]  # of 77 Hz, of which the aperture leaves little, and of 18 Hz
    wave = np.where(record.abrupt_variance_V2 == bursts[place], record.abrupt_V, 0.0)
    power = np.abs(np.fft.rfft(wave, 8 * READINGS)) ** 2

    assert np.fft.rfftfreq(8 * READINGS, INTERVAL_S)[np.argmax(power)] == pytest.approx(folded_hz, abs=0.1)


def test_the_noise_is_the_papers_peak_to_peak_over_6_6() -> None:
    record = make_record("dynamic", 1)
    noise_V = record.block["value_V"] - record.truth_V - record.abrupt_V

    assert np.std(noise_V) == pytest.approx(0.11e-3 / 6.6, rel=0.1)  # 1,000 readings: four standard deviations
    assert pytest.approx(16.7e-6, rel=1e-2) == NOISE_V


def test_the_sine_has_2_millivolts_and_0_2_hz_and_the_probe_a_tenth_of_it() -> None:
    angle = 2 * np.pi * 0.2 * INTERVAL_S * np.arange(READINGS)
    basis = np.column_stack([np.cos(angle), np.sin(angle)])
    for condition, amplitude_V in (("dynamic", 2e-3), ("probe", 0.2e-3)):
        truth_V = make_record(condition, 4).truth_V
        fit, residual, *_ = np.linalg.lstsq(basis, truth_V, rcond=None)
        assert residual[0] < 1e-20
        assert np.hypot(*fit) == pytest.approx(amplitude_V, rel=1e-4)  # the aperture takes 3 parts in 100,000


def test_the_broadband_input_is_the_mean_of_eq_2_over_the_aperture() -> None:
    inputs = np.array([make_record("broadband", seed).truth_V for seed in range(200)])

    # Covariance 2 mV^2 e^-|t - u|, averaged over one aperture twice, and over two apertures an interval apart.
    a = APERTURE_S
    variance_mV2 = 2 * 2 * (a - 1 + np.exp(-a)) / a**2
    correlation = np.exp(-INTERVAL_S) * (2 * np.cosh(a) - 2) / (2 * (a - 1 + np.exp(-a)))
    # 200 records of some 30 independent values each: 2.6 % is two standard deviations of the variance
    assert 1e6 * np.mean(inputs**2) == pytest.approx(variance_mV2, rel=0.04)
    assert np.mean(inputs[:, 1:] * inputs[:, :-1]) / np.mean(inputs**2) == pytest.approx(correlation, abs=0.002)


def test_the_probe_is_added_to_the_static_record() -> None:
    static, probe = make_record("static", 5), make_record("probe", 5)

    np.testing.assert_allclose(probe.block["value_V"] - static.block["value_V"], probe.truth_V, rtol=0, atol=1e-17)


def test_a_seed_is_a_record() -> None:
    for condition in CONDITIONS:
        once, again, other = (make_record(condition, seed).block.tobytes() for seed in (6, 6, 7))
        assert once == again
        assert once != other
