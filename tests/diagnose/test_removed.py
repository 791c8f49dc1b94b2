"""Each of the catalogue's mechanisms, strong, in a simulation: the true model stands, and without it, it is named.

Those that test_given.py does not already ask about; minutes in all, so `make test-slow` asks these. Left out are strong
heavy tails, flicker noise, a bent scale and a dead band: the filter follows these by approximations, which a record as
loud as here shows, so that their true model does not stand.
"""

import pytest

from aemd.diagnose import diagnose
from aemd.simulate import simulate
from tests.diagnose.test_given import BASE

TERM = '[[terms]]\nterm = "{}"\n{}\n'
EFFECT = '[[effects]]\neffect = "{}"\n{}\n'
REMOVED = {
    "extra_gauss_markov": TERM.format("gauss_markov", 'role = "internal"\nrate_V_per_rt_s = 1e-3\ntau_s = 6.0'),
    "random_walk": TERM.format("gauss_markov", 'role = "internal"\nrate_V_per_rt_s = 5e-4'),
    "thermal_drift": TERM.format("thermal_drift", "coefficient_V_per_C = 3e-3\nlag_s = 5.0\nsd_C = 1.0\ntau_s = 60.0"),
    "warmup_drift": TERM.format("warm_up", "amplitude_V = 2e-2\ntau_s = 20.0"),
    "changing_noise": TERM.format("white_noise", "density_V_per_rt_hz = 2e-4\nstart_s = 100.0\nduration_s = 120.0"),
    "periodic_glitch": TERM.format("periodic_pulse", "amplitude_V = 4e-3\nperiod_s = 7.3\nwidth_s = 0.3"),
    "smoothing": EFFECT.format("smoothing", "kept = 0.5"),
    "supply_coupling": EFFECT.format(
        "supply_coupling", "coefficient_per_V = 3.0\nsd_V = 0.1\ntau_s = 30.0\nmean_V = 5.0"
    ),
    "saturation": EFFECT.format("saturation", "low_V = -1.0\nhigh_V = 0.0125"),
    "stuck_readings": EFFECT.format("stuck_readings", "fraction = 0.02\nmean_readings = 10.0"),
    "replayed_block": EFFECT.format("replayed_block", "first_index = 2000\nreadings = 50"),
    "missing_samples": EFFECT.format("missing_samples", "fraction = 0.01\ncounted = false"),
    "timestamp_jitter": EFFECT.format("timestamp_jitter", "sd_s = 0.003"),
    "clock_error": EFFECT.format("clock_error", "error_ppm = 500.0"),
}


@pytest.mark.slow
@pytest.mark.parametrize("cause", REMOVED)
def test_the_true_model_stands_and_without_its_part_the_part_is_named(tmp_path, cause):
    (tmp_path / "true.toml").write_text(BASE + REMOVED[cause])
    (tmp_path / "less.toml").write_text(BASE)
    simulate(tmp_path / "true.toml", seconds=400, seed=3, out=tmp_path / "a.mcap")

    assert diagnose(tmp_path / "a.mcap", model=tmp_path / "true.toml").findings == ()
    assert cause in [finding.cause for finding in diagnose(tmp_path / "a.mcap", model=tmp_path / "less.toml").findings]
