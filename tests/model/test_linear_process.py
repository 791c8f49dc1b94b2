from math import cos, exp, pi, sin, sqrt

import numpy as np
import pytest
from scipy.integrate import dblquad

from aemd.model import FlickerNoise, GaussMarkov, PopcornNoise, Resonance, SupplyCoupling, ThermalDrift, WanderingLine
from aemd.model.effect import Readings
from aemd.model.linear_process import LinearProcess

SEED = 20190429
N = 100_000


def history(term, lag_s, aperture_s, n=N, seed=SEED):
    return term.realise(np.random.default_rng(seed)).average(np.arange(n) * lag_s, aperture_s)


def autocovariance(readings, lag):
    return readings[lag:] @ readings[: readings.size - lag] / (readings.size - lag)


@pytest.mark.parametrize("pause_s", [0.0, 0.05, 40.0])
def test_a_system_of_first_order_is_the_gauss_markov_process(pause_s):
    sd_V, tau_s, aperture_s = 2e-3, 0.1, 0.02
    process = LinearProcess(
        np.random.default_rng(SEED), np.array([[-1 / tau_s]]), np.array([sd_V * sqrt(2 / tau_s)]), np.ones((1, 1))
    )
    readings = process.average(np.arange(N) * (aperture_s + pause_s), aperture_s)[:, 0]
    a = aperture_s / tau_s
    variance = sd_V**2 * 2 * (a - 1 + exp(-a)) / a**2
    covariance = sd_V**2 * ((1 - exp(-a)) / a) ** 2 * exp(-pause_s / tau_s)
    tolerance = 5 * variance * sqrt(2 * max(1, 2 * tau_s / (aperture_s + pause_s)) / N)

    assert readings @ readings / N == pytest.approx(variance, abs=tolerance)
    assert autocovariance(readings, 1) == pytest.approx(covariance, abs=tolerance)


@pytest.mark.parametrize("quality", [0.7, 5.0])
def test_a_resonance_has_the_autocovariance_of_a_damped_oscillator(quality):
    # sd^2 e^(-b t)(cos w1 t + b/w1 sin w1 t), b = w/2Q, w1^2 = w^2 - b^2; averaged over two apertures a lag apart.
    frequency_hz, sd_V, aperture_s, lag_s = 3.0, 0.5, 0.02, 0.07
    w = 2 * pi * frequency_hz
    b = w / (2 * quality)
    w1 = sqrt(w**2 - b**2)

    def covariance(s, t):
        gap = abs(t - s)
        return sd_V**2 * exp(-b * gap) * (cos(w1 * gap) + b / w1 * sin(w1 * gap))

    readings = history(Resonance(frequency_hz=frequency_hz, quality=quality, sd_V=sd_V), lag_s, aperture_s)
    for lag in (0, 1, 2, 5):
        expected, _ = dblquad(covariance, 0, aperture_s, lag * lag_s, lag * lag_s + aperture_s)
        tolerance = 5 * sd_V**2 * sqrt((1 + 2 / (b * lag_s)) / N)
        assert autocovariance(readings, lag) == pytest.approx(expected / aperture_s**2, abs=tolerance)


def test_flicker_noise_has_its_density_within_its_band():
    noise = FlickerNoise(amplitude_V=2e-3, low_hz=1e-3, high_hz=1e2)
    frequency_hz = np.geomspace(0.02, 5.0, 50)
    density = sum(
        4 * process.sd**2 * process.tau_s / (1 + (2 * pi * frequency_hz * process.tau_s) ** 2)
        for process in noise.processes
    )

    # Of the integral over all time constants, the band leaves the part between two arcs.
    part = 2 / pi * (np.arctan(frequency_hz / 1e-3) - np.arctan(frequency_hz / 1e2))
    assert density * frequency_hz == pytest.approx(4e-6 * part, rel=2e-3)  # ripple, and the ends of the sum


def test_a_history_of_flicker_noise_has_the_variance_of_its_processes():
    noise = FlickerNoise(amplitude_V=1.0, low_hz=0.5, high_hz=20.0)
    readings = history(noise, 0.05, 1e-6)

    assert readings.var() == pytest.approx(sum(p.sd**2 for p in noise.processes), rel=5 * sqrt(20 / N))
    assert all(isinstance(process, GaussMarkov) for process in noise.processes)


def test_popcorn_noise_has_the_moments_of_a_two_state_markov_process():
    # Stationary share p = high/(low + high), variance step^2 p (1 - p), autocovariance falling with 1/low + 1/high.
    noise = PopcornNoise(step_V=2.0, dwell_low_s=3.0, dwell_high_s=1.0)
    readings = history(noise, 0.2, 1e-6)
    correlated = 1 + 2 * 0.75 / 0.2
    share = 0.25

    assert set(np.unique(readings.round(4))) == {0.0, 2.0}
    assert readings.mean() == pytest.approx(2 * share, abs=5 * sqrt(share * (1 - share) * 4 * correlated / N))
    expected = 4 * share * (1 - share) * exp(-0.2 * (1 / 3.0 + 1 / 1.0))
    assert autocovariance(readings - readings.mean(), 1) == pytest.approx(expected, abs=5 * sqrt(correlated / N))


def test_popcorn_noise_begins_in_either_state_by_its_share():
    noise = PopcornNoise(step_V=1.0, dwell_low_s=3.0, dwell_high_s=1.0)
    first = [noise.realise(np.random.default_rng(seed)).average(np.zeros(1), 1e-9)[0] for seed in range(2000)]

    assert np.mean(first) == pytest.approx(0.25, abs=5 * sqrt(0.25 * 0.75 / 2000))


def test_popcorn_noise_over_long_apertures_is_the_mean_over_the_short_ones_inside():
    noise = PopcornNoise(step_V=2.0, dwell_low_s=0.05, dwell_high_s=0.02)
    short, long = history(noise, 0.01, 0.01, 1000), history(noise, 0.1, 0.1, 100)

    assert long == pytest.approx(short.reshape(-1, 10).mean(axis=1), abs=1e-10)


def test_a_line_that_does_not_wander_is_a_sine_and_one_that_sweeps_a_chirp():
    line = WanderingLine(amplitude_V=2.0, frequency_hz=3.0, chirp_hz_per_s=0.5, phase_rad=0.3)
    time_s = np.arange(200) * 0.05
    phase_rad = 2 * pi * (3.0 * time_s + 0.25 * time_s**2) + 0.3

    assert history(line, 0.05, 1e-9, 200) == pytest.approx(2 * np.sin(phase_rad), abs=1e-6)


def test_the_frequency_of_a_wandering_line_is_a_random_walk():
    # Phase after t against the straight line: variance (2 pi wander)^2 t^3/3; small enough here for sin x = x.
    line = WanderingLine(amplitude_V=1.0, frequency_hz=1.0, wander_hz_per_rt_s=1e-3)
    at_s = 8.0  # whole periods
    phases = [history(line, at_s, 1e-9, 2, seed)[1] for seed in range(2000)]

    assert np.std(phases) == pytest.approx(2 * pi * 1e-3 * sqrt(at_s**3 / 3), rel=5 / sqrt(2 * 2000) + 0.01)


@pytest.mark.parametrize("lag_s", [0.0, 4.0, 10.0])
def test_a_thermal_drift_is_the_lagged_temperature_that_its_witness_tells(lag_s):
    drift = ThermalDrift(coefficient_V_per_C=0.5, lag_s=lag_s, sd_C=2.0, tau_s=10.0).realise(
        np.random.default_rng(SEED)
    )
    drift_V = drift.average(np.arange(N) * 0.1, 0.1)
    temperature_C = drift.temperature_C - 23.0

    # First-order lag by the trapezoidal rule, from the drift's own first value on.
    followed = [drift_V[0] / 0.5]
    for now, before in zip(temperature_C[1:2000], temperature_C[:2000], strict=False):
        keep = exp(-0.1 / lag_s) if lag_s else 0.0
        followed.append(followed[-1] * keep + (1 - keep) * ((now + before) / 2 if lag_s else now))
    assert drift_V[:2000] == pytest.approx(0.5 * np.array(followed), abs=0.01)
    assert temperature_C.std() == pytest.approx(2.0, rel=5 * sqrt(1 / (N * 0.1 / 20)))


def test_the_supply_multiplies_readings_as_its_witness_tells():
    index = np.arange(1000)
    readings = Readings(index, index * 0.1, np.full(1000, 3.0))
    coupling = SupplyCoupling(coefficient_per_V=0.2, sd_V=0.1, tau_s=2.0, mean_V=5.0)
    read = coupling.realise(np.random.default_rng(SEED)).apply(readings)

    assert read.value_V == pytest.approx(3.0 * (1 + 0.2 * (read.witnesses["supply"].value - 5.0)), rel=1e-12)
    assert read.witnesses["supply"].value.std() == pytest.approx(0.1, rel=5 * sqrt(1 / (100 / 4)))


def test_what_is_let_through_of_the_supply_follows_it_with_its_lag():
    index = np.arange(1000)
    readings = Readings(index, index * 0.1, np.zeros(1000))
    coupling = SupplyCoupling(coefficient_V_per_V=0.2, lag_s=1.5, sd_V=0.1, tau_s=20.0, mean_V=5.0)
    read = coupling.realise(np.random.default_rng(SEED)).apply(readings)
    apart_V = read.witnesses["supply"].value - 5.0

    keep, followed = exp(-0.1 / 1.5), [read.value_V[0] / 0.2]  # by the trapezoidal rule, from its own first value on
    for now, before in zip(apart_V[1:], apart_V[:-1], strict=True):
        followed.append(followed[-1] * keep + (1 - keep) * (now + before) / 2)
    # Within 5 deviations of what the path does between readings.
    assert read.value_V == pytest.approx(0.2 * np.array(followed), abs=5e-4)
