"""A small blind bench for every change: hide an effect, require finding it; hide nothing, require silence.

Sizes are twice the amplitude at which a clairvoyant detects in 95 % (certificate.py), so a check that is switched off,
or that lost its power, shows here; false-alarm rates and power curves are the long run's, `python -m tests.blind`.
"""

from dataclasses import replace
from math import sqrt

import numpy as np
import pytest

from aemd.diagnose import COVERED, diagnose
from tests.blind.envelope import draw_plant
from tests.blind.files import write_csv, write_mcap
from tests.blind.injector import make_record
from tests.blind.plant import Effect, Plant, Run

PLANT = Plant(
    n=3000,
    interval_s=0.0684,
    aperture_s=0.01,
    signal_sd_V=1e-3,
    signal_tau_s=0.5,
    drift_rate_V_per_rt_s=1e-3 * sqrt(2 / 60),
    drift_tau_s=60.0,
    white_sd_V=5e-4,
)
SHAKEN = replace(PLANT, shocks_per_s=0.3, shock_sd_V=0.02, shock_decay_s=0.2)
SEED = 7

HIDDEN = (
    (PLANT, Effect("mains_alias", 6.31e-4, {"frequency_hz": 59.9955, "phase_rad": 0.54})),
    (PLANT, Effect("periodic_interference", 2.29e-4, {"frequency_hz": 5.77, "phase_rad": 1.0})),
    (PLANT, Effect("wandering_line", 2.48e-4, {"frequency_hz": 5.6, "sweep_hz_per_s": 5.95e-4, "phase_rad": 1.0})),
    (PLANT, Effect("periodic_glitch", 2.45e-3, {"period_s": 15.83, "width_s": 0.244, "start_s": 0.8})),
    (PLANT, Effect("resonance", 2.38e-4, {"frequency_hz": 5.716, "quality": 46.7})),
    (PLANT, Effect("difference_noise", 6.44e-4)),
    (PLANT, Effect("smoothing", 0.583)),
    (PLANT, Effect("popcorn_noise", 2.76e-3, {"dwell_s": 4.93})),
    (PLANT, Effect("changing_noise", 1.64, {"begin": 0.317, "end": 0.855})),
    (PLANT, Effect("signal_dependent_noise", 0.309)),
    (replace(PLANT, n=9000, white_sd_V=2e-3), Effect("heavy_tails", 0.99)),
    (SHAKEN, Effect("ring_down", 0.0291, {"frequency_hz": 6.557, "decay_s": 1.21})),
    (replace(SHAKEN, n=9000), Effect("shock_law", 0.85)),
    (PLANT, Effect("step", 8.67e-3, {"time_s": 91.2})),
    (replace(PLANT, witness=True), Effect("thermal_drift", 0.0819, {"lag_s": 19.8})),
    (PLANT, Effect("warmup_drift", 0.0507, {"tau_s": 31.4})),
    (replace(PLANT, witness=True, level_V=0.05), Effect("supply_coupling", 2.04)),
    (replace(PLANT, witness=True), Effect("latency", 0.06, {"lag_s": 15.0})),
    (replace(PLANT, level_V=0.02), Effect("range_switching", 5.2e-4, {"part": 0.7})),
    (PLANT, Effect("nonlinearity", 97.1)),
    (PLANT, Effect("dead_band", 7e-4)),
    (PLANT, Effect("reading_pattern", 2.31e-4, {"period_readings": 2.0})),
    (PLANT, Effect("quantisation", 1e-3)),
    (PLANT, Effect("saturation", 0.02)),
    (PLANT, Effect("stuck_readings", 9.0, {"place": 0.26})),
    (PLANT, Effect("replayed_block", 56.0, {"place": 0.31})),
    (PLANT, Effect("missing_samples", 0.03)),
    (PLANT, Effect("timestamp_jitter", 0.01)),
    (PLANT, Effect("clock_error", 1000.0)),
)
NOT_HERE = {"flicker_noise", "random_walk", "extra_gauss_markov"}
"""A refitted base absorbs them on records of minutes; they need hours."""


@pytest.mark.parametrize(("plant", "effect"), HIDDEN, ids=[effect.cause for _, effect in HIDDEN])
def test_what_is_hidden_is_found_and_named(plant, effect, tmp_path):
    record = make_record(Run(plant, SEED, (effect,)))
    if effect.cause == "clock_error":  # a table does not say how long its interval should be
        write_mcap(record, path := tmp_path / "a.mcap", plant.interval_s)
    else:
        write_csv(record, path := tmp_path / "a.csv")

    assert effect.cause in [finding.cause for finding in diagnose(path).findings]


def test_losses_that_the_numbers_hide_are_seen_in_the_stamps(tmp_path):
    record = make_record(Run(PLANT, SEED, (Effect("missing_samples", 0.03),)))
    write_mcap(record, tmp_path / "a.mcap", PLANT.interval_s)

    assert "missing_samples" in [finding.cause for finding in diagnose(tmp_path / "a.mcap").findings]


def test_everything_that_the_critic_looks_for_is_hidden_here():
    assert set(COVERED) - NOT_HERE <= {effect.cause for _, effect in HIDDEN}


@pytest.mark.parametrize("seed", range(8))
def test_on_clean_readings_the_critic_is_silent(seed, tmp_path):
    plant = draw_plant(np.random.default_rng(seed), provocative=seed % 2 == 1)
    plant = replace(plant, n=min(plant.n, 3000), lost_fraction=0.0)
    write_csv(make_record(Run(plant, seed)), tmp_path / "a.csv")

    diagnosis = diagnose(tmp_path / "a.csv")

    assert (diagnosis.verdict, diagnosis.findings) == ("nothing_found", ())
