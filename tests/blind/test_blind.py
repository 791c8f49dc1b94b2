"""A small blind bench for every change: hide an effect, require finding it; hide nothing, require silence.

Sizes are twice the amplitude at which a clairvoyant detects in 95 % (certificate.py), so a check that is switched off,
or that lost its power, shows here; false-alarm rates and power curves are the long run's, `python -m tests.blind`.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from aemd.diagnose import COVERED, diagnose
from aemd.diagnose.checks.residuals import check_each
from aemd.diagnose.fit import fit_base
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.series import Series
from tests.blind.envelope import draw_plant
from tests.blind.files import write_csv, write_mcap
from tests.blind.injector import make_record
from tests.blind.made import USUAL
from tests.blind.plant import Effect, Run

PLANT = replace(USUAL, n=3000, interval_s=0.0684, aperture_s=0.01)
SHORT = replace(PLANT, n=1500)
"""For what is seen by counting."""
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
    (replace(PLANT, level_V=-0.02), Effect("range_switching", 4.8e-4, {"part": 0.7})),
    (PLANT, Effect("nonlinearity", 97.1)),
    (SHORT, Effect("dead_band", 7e-4)),
    (PLANT, Effect("reading_pattern", 2.31e-4, {"period_readings": 2.0})),
    (SHORT, Effect("quantisation", 1e-3)),
    (SHORT, Effect("saturation", 0.02)),
    (SHORT, Effect("stuck_readings", 9.0, {"place": 0.26})),
    (SHORT, Effect("replayed_block", 56.0, {"place": 0.31})),
    (SHORT, Effect("missing_samples", 0.03)),
    (SHORT, Effect("timestamp_jitter", 0.01)),
    (SHORT, Effect("clock_error", 1000.0)),
)
NAMELESS = (
    (Effect("ooc_packet", 6.15e-4, {"frequency_hz": 3.3, "time_s": 100.0, "width_s": 10.26, "phase_rad": 1.0}), "tone"),
    (Effect("ooc_saw", 3.48e-3, {"time_s": 100.0, "width_s": 3.0, "teeth": 6.0}), "teeth"),
    (Effect("ooc_bump", 0.0185, {"time_s": 100.0, "width_s": 5.0}), "hump"),
    (Effect("ooc_echo", 0.205, {"lag_readings": 40.0}), "echo"),
    (Effect("ooc_breath", 0.335, {"turns": 4.0}), "course"),
)
"""Outside the catalogue, in PLANT, each with the word in the name of the check that must fire."""
CHECKS = {
    "mains_alias": ("strongest line",),
    "periodic_interference": ("strongest line",),
    "wandering_line": ("strongest sweeping line",),
    "periodic_glitch": ("strongest train of pulses",),
    "resonance": ("strongest band",),
    "difference_noise": ("noise that rises",),
    "smoothing": ("strongest band",),
    "popcorn_noise": ("a level that jumps",),
    "changing_noise": ("range of the summed squares",),
    "signal_dependent_noise": ("noise that grows with the reading",),
    "heavy_tails": ("kurtosis",),
    "ring_down": ("damped waves after the shocks",),
    "shock_law": ("excess of positive over negative shocks",),
    "step": ("strongest step",),
    "thermal_drift": ("readings on temperature, as it is",),
    "warmup_drift": ("decay from the first reading",),
    "supply_coupling": ("residuals against supply times the reading",),
    "latency": ("readings on temperature, late",),
    "range_switching": ("residuals and their squares against the reading's range",),
    "nonlinearity": ("residuals against a bent scale",),
    "dead_band": ("returns to one value",),
    "reading_pattern": ("pattern locked",),
    "quantisation": ("lattice step",),
    "saturation": ("readings at the extreme",),
    "stuck_readings": ("longest run",),
    "replayed_block": ("longest stretch",),
    "missing_samples": ("readings missing",),
    "timestamp_jitter": ("scatter of the time stamps",),
    "clock_error": ("interval over the nominal",),
}
"""The checks that must fire where a mechanism is hidden, by how they begin. A check that is switched off is missed
here, even where the name is found by way of another."""
RANGES = {1: "readings missing from a hole", -1: "readings that two ranges share"}
"""Where the offset of the wider range moves readings away from the other's, by the level's sign, and where towards."""
STATED = ("noise that falls", "slow noise beyond")
"""Checks that a refitted base leaves little to on such records; they are shown beside a stated one."""
ELSEWHERE = ("shocks that follow one another",)
"""In tests/diagnose/test_events.py: the injector's shocks come alone."""
INTEGRITY = tuple(
    CHECKS[cause][0]
    for cause in (
        "dead_band",
        "quantisation",
        "saturation",
        "stuck_readings",
        "replayed_block",
        "missing_samples",
        "timestamp_jitter",
        "clock_error",
    )
)
"""Checks of the readings themselves; each has one mechanism."""
BASE = """
[[terms]]
term = "gauss_markov"
rate_V_per_rt_s = 2e-3
tau_s = 0.5
[[terms]]
term = "gauss_markov"
role = "internal"
rate_V_per_rt_s = 1.826e-4
tau_s = 60.0
[[terms]]
term = "white_noise"
density_V_per_rt_hz = 1e-4
"""
"""PLANT as a model: of the white noise, sd = density / sqrt(2 aperture), the aperture of a table being 20 ms; what of
the signal changes within an aperture is not in it."""
NOT_HERE = {"flicker_noise", "random_walk", "extra_gauss_markov"}
"""A refitted base absorbs them on records of minutes; they need hours."""


@pytest.mark.parametrize(("plant", "effect"), HIDDEN, ids=[f"{item.cause}-{at.level_V:g}" for at, item in HIDDEN])
def test_what_is_hidden_is_found_and_named(plant, effect, tmp_path):
    record = make_record(Run(plant, SEED, (effect,)))
    if effect.cause == "clock_error":  # a table does not say how long its interval should be
        write_mcap(record, path := tmp_path / "a.mcap", plant.interval_s)
    else:
        write_csv(record, path := tmp_path / "a.csv")

    diagnosis = diagnose(path)
    fired = [item.check for item in diagnosis.discrepancies]

    assert effect.cause in [finding.cause for finding in diagnosis.findings]
    by_level = (RANGES[int(np.sign(plant.level_V))],) if effect.cause == "range_switching" else ()
    for check in (*CHECKS[effect.cause], *by_level):
        assert [name for name in fired if name.startswith(check)], fired


@pytest.mark.parametrize(("effect", "word"), NAMELESS, ids=[word for _, word in NAMELESS])
def test_what_is_outside_the_catalogue_is_found_and_gets_no_name(effect, word, tmp_path):
    write_csv(make_record(Run(PLANT, SEED, (effect,))), tmp_path / "a.csv")

    diagnosis = diagnose(tmp_path / "a.csv")

    assert {finding.cause for finding in diagnosis.findings} == {"unexplained"}
    assert [item.check for item in diagnosis.discrepancies if word in item.check.split(" ")]


def test_beside_a_stated_base_slow_noise_and_smoothing_are_seen(tmp_path):
    (tmp_path / "m.toml").write_text(BASE)
    rng = np.random.default_rng(SEED)
    slow = 6e-3 * lfilter([1], [1, -np.exp(-PLANT.interval_s / 8.0)], rng.standard_normal(PLANT.n)) / 10
    record = make_record(Run(PLANT, SEED))
    write_csv(replace(record, value_V=record.value_V + slow), tmp_path / "a.csv")
    write_csv(make_record(Run(PLANT, SEED, (Effect("smoothing", 0.3),))), tmp_path / "b.csv")
    fired = [
        item.check
        for name in ("a.csv", "b.csv")
        for item in diagnose(tmp_path / name, model=tmp_path / "m.toml").discrepancies
    ]

    for check in STATED:
        assert [name for name in fired if name.startswith(check)], fired


def test_every_check_has_something_hidden_that_needs_it():
    """What is judged here once, with shocks and witnesses: the list of all checks there are."""
    plant = replace(SHAKEN, witness=True)
    record = make_record(Run(plant, SEED))
    names = [f"residuals against {name}" for name in record.witnesses] + [f"readings on {n}" for n in record.witnesses]
    series = Series(
        path="made",
        time_s=record.time_s - record.time_s[0],
        value_V=record.value_V,
        index=record.index,
        status=np.zeros(plant.n, np.uint32),
        interval_s=plant.interval_s,
        witnesses={name: column for name, (_, column) in record.witnesses.items()},
    )
    ran = [evidence.check for evidence, _ in check_each(fit_base(make_data(series)), None)]
    known = [check for checks in CHECKS.values() for check in checks] + [*STATED, *ELSEWHERE, *RANGES.values()]
    words = {word for _, word in NAMELESS}

    assert [check for check in ran if not check.startswith((*known, *names)) and not words & {*check.split(" ")}] == []
    assert words <= {word for check in ran for word in check.split(" ")}
    assert [
        check for check in known if not check.startswith(INTEGRITY) and not any(r.startswith(check) for r in ran)
    ] == []


def test_losses_that_the_numbers_hide_are_seen_in_the_stamps(tmp_path):
    record = make_record(Run(SHORT, SEED, (Effect("missing_samples", 0.03),)))
    write_mcap(record, tmp_path / "a.mcap", SHORT.interval_s)

    assert "missing_samples" in [finding.cause for finding in diagnose(tmp_path / "a.mcap").findings]


def test_everything_that_the_critic_looks_for_is_hidden_here():
    assert set(COVERED) - NOT_HERE <= {effect.cause for _, effect in HIDDEN}


@pytest.mark.parametrize("seed", range(5))
def test_on_clean_readings_the_critic_is_silent(seed, tmp_path):
    plant = draw_plant(np.random.default_rng(seed), provocative=seed % 2 == 1)
    plant = replace(plant, n=min(plant.n, 2000), lost_fraction=0.0)
    write_csv(make_record(Run(plant, seed)), tmp_path / "a.csv")

    diagnosis = diagnose(tmp_path / "a.csv")

    assert (diagnosis.verdict, diagnosis.findings) == ("nothing_found", ())
