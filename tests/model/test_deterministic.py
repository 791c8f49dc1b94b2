import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from aemd.model import Level, PeriodicPulse, Sine, SquareBurst, Step, WarmUp

APERTURES_s = st.floats(1e-4, 1.0)
STARTS_s = st.floats(0.0, 10.0)


def mean_over(term, start_s, aperture_s):
    return term.average(np.array([start_s]), aperture_s)[0]


def test_a_level_is_the_same_in_every_aperture():
    assert Level(level_V=-1.5).average(np.array([0.0, 7.0]), 0.02).tolist() == [-1.5, -1.5]


@given(start_s=STARTS_s, aperture_s=APERTURES_s, frequency_hz=st.floats(0.01, 20.0), phase_rad=st.floats(-7, 7))
def test_the_mean_of_a_sine_is_its_integral_over_the_aperture(start_s, aperture_s, frequency_hz, phase_rad):
    sine = Sine(amplitude_V=2.0, frequency_hz=frequency_hz, phase_rad=phase_rad)
    integral, _ = quad(
        lambda t: 2 * np.sin(2 * np.pi * frequency_hz * t + phase_rad), start_s, start_s + aperture_s, limit=200
    )

    assert mean_over(sine, start_s, aperture_s) == pytest.approx(integral / aperture_s, abs=1e-9)


@pytest.mark.parametrize("periods", [1, 2, 5])
def test_an_aperture_of_whole_periods_does_not_see_the_mains(periods):
    mains = Sine(amplitude_V=1.0, frequency_hz=50.0, phase_rad=0.3)

    assert np.abs(mains.average(np.linspace(0, 1, 37), periods / 50)).max() < 1e-12


def test_a_burst_is_exact_wherever_the_aperture_cuts_it():
    burst = SquareBurst(amplitude_V=3.0, frequency_hz=2.0, start_s=1.0, duration_s=1.25)  # 2.5 periods
    first_half, across_an_edge, beginning, end, beside = 1.0, 1.2, 0.9, 2.2, 5.0

    assert mean_over(burst, first_half, 0.25) == pytest.approx(3.0)
    assert mean_over(burst, across_an_edge, 0.1) == pytest.approx(0.0, abs=1e-12)
    assert mean_over(burst, beginning, 0.2) == pytest.approx(1.5)
    assert mean_over(burst, end, 0.1) == pytest.approx(1.5)
    assert mean_over(burst, beside, 0.1) == 0.0


@given(
    start_s=STARTS_s, aperture_s=st.floats(0.05, 1.0), frequency_hz=st.floats(0.5, 8.0), duration_s=st.floats(0.2, 6)
)
def test_the_mean_of_a_burst_is_that_of_many_points_of_the_wave(start_s, aperture_s, frequency_hz, duration_s):
    burst = SquareBurst(amplitude_V=1.0, frequency_hz=frequency_hz, start_s=2.0, duration_s=duration_s)
    points = 4001
    elapsed = start_s + aperture_s * (np.arange(points) + 0.5) / points - 2.0
    wave = np.where(elapsed * frequency_hz % 1 < 0.5, 1.0, -1.0) * ((elapsed >= 0) & (elapsed < duration_s))
    edges = 2 * frequency_hz * aperture_s + 3

    assert mean_over(burst, start_s, aperture_s) == pytest.approx(wave.mean(), abs=2 * edges / points)


def test_a_step_is_in_an_aperture_by_the_part_that_is_after_it():
    step = Step(time_s=1.0, step_V=2.0)

    assert [mean_over(step, start_s, 0.2) for start_s in (0.0, 0.8, 0.95, 1.0, 5.0)] == pytest.approx([0, 0, 1.5, 2, 2])


@given(start_s=STARTS_s, aperture_s=APERTURES_s, tau_s=st.floats(0.05, 1e6))
def test_the_mean_of_a_warm_up_is_its_integral_over_the_aperture(start_s, aperture_s, tau_s):
    warm_up = WarmUp(amplitude_V=3.0, tau_s=tau_s, slope_V_per_s=0.2)
    integral, _ = quad(lambda t: 3 * np.exp(-t / tau_s) + 0.2 * t, start_s, start_s + aperture_s)

    assert mean_over(warm_up, start_s, aperture_s) == pytest.approx(integral / aperture_s, rel=1e-9)


def test_a_pulse_is_in_an_aperture_by_the_part_that_is_within_it():
    pulse = PeriodicPulse(amplitude_V=2.0, period_s=1.0, width_s=0.1, start_s=0.25)
    before, touching, across, two, beside = 0.0, 0.2, 0.3, 0.25, 0.5

    assert mean_over(pulse, before, 0.2) == 0.0
    assert mean_over(pulse, touching, 0.1) == pytest.approx(1.0)
    assert mean_over(pulse, 7 + across, 0.1) == pytest.approx(1.0)
    assert mean_over(pulse, two, 1.1) == pytest.approx(2 * 0.2 / 1.1)
    assert mean_over(pulse, beside, 0.5) == 0.0


def test_a_pulse_longer_than_its_period_is_refused():
    with pytest.raises(ValueError, match=r"width_s = 2\.0: must be at most period_s = 1\.0"):
        PeriodicPulse(amplitude_V=1.0, period_s=1.0, width_s=2.0)
