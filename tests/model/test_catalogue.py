from math import inf, nan, sqrt
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ConfigDict, TypeAdapter, ValidationError

from aemd.model import (
    FlickerNoise,
    GaussMarkov,
    Level,
    Model,
    PeriodicPulse,
    PopcornNoise,
    Resonance,
    Shocks,
    Sine,
    SquareBurst,
    Step,
    SupplyCoupling,
    Term,
    ThermalDrift,
    WanderingLine,
    WarmUp,
    WhiteNoise,
)

TERMS = (
    Level(level_V=0.5),
    Sine(amplitude_V=2e-3, frequency_hz=0.2),
    SquareBurst(amplitude_V=0.06, frequency_hz=18.0, start_s=0.3, duration_s=1.6),
    GaussMarkov.from_sd(sd_V=1e-3, tau_s=0.5),
    GaussMarkov(role="internal", rate_V_per_rt_s=1e-5),
    Shocks(rate_per_s=5.0, sd_V=0.02, decay_s=0.1),
    Shocks(rate_per_s=5.0, sd_V=0.02),
    Shocks(rate_per_s=5.0, sd_V=0.02, decay_s=0.1, second_fraction=0.3, second_decay_s=2.0, positive_fraction=0.9),
    Shocks(rate_per_s=2.0, sd_V=0.02, ring_fraction=0.5, ring_hz=7.0, after_shocks=3.0, after_s=0.5),
    Step(time_s=1.5, step_V=0.1),
    WarmUp(amplitude_V=0.1, tau_s=5.0, slope_V_per_s=1e-3),
    PeriodicPulse(amplitude_V=0.1, period_s=0.7, width_s=0.05, start_s=0.3),
    WanderingLine(amplitude_V=0.1, frequency_hz=3.0, chirp_hz_per_s=0.01, wander_hz_per_rt_s=0.1),
    FlickerNoise(amplitude_V=1e-3, low_hz=0.01, high_hz=10.0),
    PopcornNoise(step_V=1e-3, dwell_low_s=0.5, dwell_high_s=0.2),
    Resonance(frequency_hz=5.0, quality=30.0, sd_V=1e-3),
    ThermalDrift(coefficient_V_per_C=1e-3, lag_s=2.0, sd_C=0.5, tau_s=100.0),
    WhiteNoise.from_sd(sd_V=1e-4, aperture_s=0.02),
    WhiteNoise(density_V_per_rt_hz=1e-3, start_s=1.0, duration_s=2.0),
)


def test_every_term_of_the_catalogue_is_tried_here():
    union = get_args(get_args(Term)[0])

    assert {type(term) for term in TERMS} == set(union)


@settings(deadline=None)
@given(
    pauses_s=st.lists(st.sampled_from([0.0, 1e-3, 0.0466, 3.0]), min_size=1, max_size=60),
    cuts=st.lists(st.integers(0, 60), max_size=8),
    seed=st.integers(0, 2**32),
)
def test_a_history_does_not_depend_on_how_it_is_asked_for(pauses_s, cuts, seed):
    model, aperture_s = Model(TERMS, seed), 0.02
    start_s = np.cumsum(np.array(pauses_s) + aperture_s)
    whole = model.realise().average(start_s, aperture_s)
    source = model.realise()
    pieces = [
        source.average(piece, aperture_s) for piece in np.split(start_s, sorted(min(c, start_s.size) for c in cuts))
    ]

    for part in ("signal_V", "internal_V", "external_V", "noise_V", "total"):
        assert np.concatenate([getattr(piece, part) for piece in pieces]).tobytes() == getattr(whole, part).tobytes()


def test_the_truth_is_parted_by_role():
    truth = Model(
        (Level(level_V=1.0), Level(level_V=2.0, role="internal"), Level(level_V=4.0, role="external"))
    ).realise()
    parts = truth.average(np.zeros(1), 1.0)

    assert (parts.signal_V, parts.internal_V, parts.external_V, parts.noise_V) == (1, 2, 4, 0)
    assert parts.total == 7


def test_a_term_keeps_its_history_when_a_later_one_changes():
    start_s = np.arange(100) * 0.1
    one = Model((TERMS[3], WhiteNoise(density_V_per_rt_hz=1e-3)), seed=5).realise().average(start_s, 0.02)
    other = Model((TERMS[3], TERMS[5], TERMS[1]), seed=5).realise().average(start_s, 0.02)

    assert (other.signal_V - TERMS[1].average(start_s, 0.02)) == pytest.approx(one.signal_V, abs=1e-18)


def test_the_seed_makes_the_history():
    start_s = np.arange(50) * 0.1
    one, same, other = (Model(TERMS, seed).realise().average(start_s, 0.02).total for seed in (1, 1, 2))

    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


@pytest.mark.parametrize("aperture_s", [1e-4, 0.02])
def test_white_noise_averages_out_with_the_root_of_the_aperture(aperture_s):
    noise = WhiteNoise(density_V_per_rt_hz=1e-3)
    readings = Model((noise,), seed=3).realise().average(np.arange(50_000) * 0.1, aperture_s).noise_V

    assert readings.std() == pytest.approx(1e-3 / sqrt(2 * aperture_s), rel=5 / sqrt(2 * 50_000))


def test_a_burst_of_white_noise_begins_and_ends_within_apertures():
    n, aperture_s = 50_000, 0.02
    noise = WhiteNoise(density_V_per_rt_hz=1e-3, start_s=100 * aperture_s, duration_s=(n + 0.25) * aperture_s)
    readings = Model((noise,)).realise().average(np.arange(n + 300) * aperture_s, aperture_s).noise_V

    assert np.count_nonzero(readings[:100]) == 0
    assert readings[100 : n + 100].std() == pytest.approx(noise.sd(aperture_s), rel=5 / sqrt(2 * n))
    ends = [
        Model((noise,), seed).realise().average(np.array([(n + 100) * aperture_s]), aperture_s).noise_V[0]
        for seed in range(2000)
    ]
    assert np.std(ends) == pytest.approx(noise.sd(aperture_s) / 2, rel=5 / sqrt(2 * 2000))


def test_white_noise_is_made_from_the_scatter_of_readings():
    assert WhiteNoise.from_sd(sd_V=1e-4, aperture_s=0.02).sd(0.02) == pytest.approx(1e-4)
    assert WhiteNoise.from_sd(sd_V=1e-4, aperture_s=0.02).sd(0.08) == pytest.approx(0.5e-4)


def validate(table):
    return TypeAdapter(tuple[Model], config=ConfigDict(extra="forbid")).validate_python([table])[0]


def test_tables_of_a_toml_file_become_terms():
    model = validate(
        {
            "seed": 4,
            "terms": [
                {"term": "gauss_markov", "role": "internal", "rate_V_per_rt_s": 1e-5, "tau_s": inf},
                {"term": "sine", "amplitude_V": 2e-3, "frequency_hz": 0.2},
            ],
        }
    )

    assert model == Model(
        (GaussMarkov(role="internal", rate_V_per_rt_s=1e-5), Sine(amplitude_V=2e-3, frequency_hz=0.2)), seed=4
    )


@pytest.mark.parametrize(
    ("term", "place"),
    [
        ({"term": "sine", "amplitude_V": 1.0, "frequency_hz": -2.0}, ("sine", "frequency_hz")),
        ({"term": "sine", "amplitude_V": 1.0}, ("sine", "frequency_hz")),
        ({"term": "level", "level_V": nan}, ("level", "level_V")),
        ({"term": "level", "level_V": inf}, ("level", "level_V")),
        ({"term": "level", "level_V": 1.0, "levle": 2.0}, ("level", "levle")),
        ({"term": "level", "level_V": 1.0, "role": "sginal"}, ("level", "role")),
        ({"term": "gauss_markov", "rate_V_per_rt_s": 1e-3, "tau_s": 0.0}, ("gauss_markov", "tau_s")),
        ({"term": "shocks", "rate_per_s": 1.0, "sd_V": 1.0, "decay_s": -1.0}, ("shocks", "decay_s")),
        ({"term": "sin"}, ()),
        ({"level_V": 1.0}, ()),
    ],
)
def test_a_mistake_in_a_term_is_reported_once_and_at_its_place(term, place):
    with pytest.raises(ValidationError) as caught:
        validate({"terms": [term]})

    assert [fault["loc"] for fault in caught.value.errors()] == [(0, "terms", 0, *place)]


@pytest.mark.parametrize(
    ("terms", "effects"),
    [
        ((ThermalDrift(coefficient_V_per_C=1.0, sd_C=1.0, tau_s=9.0),) * 2, ()),
        ((), (SupplyCoupling(coefficient_per_V=1.0, sd_V=1.0, tau_s=9.0),) * 2),
    ],
)
def test_two_of_one_witness_are_refused(terms, effects):
    with pytest.raises(ValueError, match="at most one"):
        Model(terms, 1, effects)
