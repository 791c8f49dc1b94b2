"""The plant that the bench's own tests vary."""

from math import sqrt

from tests.blind.plant import Plant

__all__ = ["USUAL"]

USUAL = Plant(
    n=1000,
    interval_s=0.06712,
    aperture_s=0.02,
    signal_sd_V=1e-3,
    signal_tau_s=0.5,
    drift_rate_V_per_rt_s=1e-3 * sqrt(2 / 60),
    drift_tau_s=60.0,
    white_sd_V=5e-4,
)
