"""The certificate of noise that grows with the reading, in the two cases that have a formula."""

from dataclasses import replace

import numpy as np
import pytest

from tests.blind.injector import calm
from tests.blind.innovations import louder_kl
from tests.blind.made import USUAL
from tests.blind.plant import Effect, Run

PLANT = replace(USUAL, n=9000, drift_rate_V_per_rt_s=1e-9)


def test_noise_that_grows_with_a_fast_input_is_told_by_the_skewness_of_single_readings():
    """By the first term of Gram and Charlier's series, of third moment k and variance S, it is k^2/(12 S^3)."""
    plant = replace(PLANT, signal_tau_s=0.02, white_sd_V=1e-3)
    plant = replace(plant, level_V=20 * plant.signal_sd_V)
    part = 0.03**2
    x = calm(Run(replace(plant, white_sd_V=0.0), 6))
    own = plant.white_sd_V**2 + part * np.mean(x**2)
    third = 3 * 2 * part * x.mean() * np.var(x)

    told = louder_kl(Run(plant, 6), Effect("signal_dependent_noise", part**0.5))
    assert told == pytest.approx(plant.n * third**2 / (12 * (own + np.var(x)) ** 3), rel=0.1)


def test_noise_that_grows_with_a_slow_input_is_told_as_if_that_were_known():
    plant = replace(PLANT, signal_tau_s=300.0)
    plant = replace(plant, level_V=5 * plant.signal_sd_V)
    part = 0.03**2
    power = calm(Run(replace(plant, white_sd_V=0.0), 6)) ** 2
    own = plant.white_sd_V**2 + part * power.mean()

    told = louder_kl(Run(plant, 6), Effect("signal_dependent_noise", part**0.5))
    assert told == pytest.approx(part**2 * plant.n * np.var(power) / (4 * own**2), rel=0.1)
