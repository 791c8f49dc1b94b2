"""The extended model's file is what simulate, acquire and replay take, and on fresh readings it keeps its promise."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest

from aemd import model
from aemd.config import load_config, load_estimator
from aemd.diagnose import diagnose, write_extended
from aemd.diagnose.estimator import estimator_for
from aemd.diagnose.report import format_promise
from aemd.replay import replay
from aemd.simulate import read_model, simulate
from tests.diagnose.promised import compared, made
from tests.diagnose.removed import BASE

INTERVAL_S, APERTURE_S = 0.06712, 0.02
LINE = '[[terms]]\nterm = "sine"\nrole = "external"\namplitude_V = 2e-3\nfrequency_hz = 3.3\n'
SIGNAL = model.GaussMarkov(role="signal", rate_V_per_rt_s=2e-3, tau_s=0.5)
NOISE = model.WhiteNoise.from_sd(3e-4, APERTURE_S)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """A record with a line, its diagnosis, and the files of base and extended model."""
    place = tmp_path_factory.mktemp("round")
    return place, made(place, BASE + LINE, seed=4)


def test_the_extended_estimator_errs_on_fresh_readings_by_as_much_less_as_was_promised(found):
    place, diagnosis = found
    told = diagnosis.promise

    assert diagnosis.findings[0].gain.low > 0
    assert told.ratio.low < told.ratio.value < told.ratio.high < 1
    for seed in (11, 12, 13):
        assert compared(place, seed, told.readings).keeps(told)


def test_the_file_says_what_was_promised(found):
    place, diagnosis = found

    assert f"# {format_promise(diagnosis.promise)}" in (place / "extended.toml").read_text()
    assert "should err" not in (place / "base.toml").read_text()


def test_of_readings_that_the_extended_model_makes_it_lacks_nothing(found):
    place, _ = found
    simulate(place / "extended.toml", seconds=150, seed=21, out=place / "b.mcap")

    assert diagnose(place / "b.mcap", model=place / "extended.toml").findings == ()
    assert diagnose(place / "b.mcap", model=place / "base.toml").findings != ()


def test_replay_takes_the_extended_estimator(found):
    place, _ = found
    replay(place / "4.mcap", model=place / "extended.toml", out=place / "c.mcap")

    assert (place / "c.mcap").stat().st_size > 0


def test_acquire_takes_the_extended_estimator(found):
    place, _ = found
    settings = load_config(None).with_estimator(load_estimator(place / "extended.toml"))

    assert settings.estimator.name == "imm"
    assert settings.estimator.options.signal_tau_s[:1] == (
        next(term.tau_s for term in read_model(place / "extended.toml").terms if isinstance(term, model.GaussMarkov)),
    )


def test_the_line_is_a_part_that_the_estimator_follows_and_leaves_out(found):
    place, diagnosis = found
    options = load_estimator(place / "extended.toml").options

    assert options.signal_is == ("input", "disturbance")
    assert options.signal_hz[1] == pytest.approx(3.3, abs=2e-3)
    assert options.signal_V[1] == pytest.approx(
        diagnosis.findings[0].parameters["amplitude_V"].value / 2**0.5, rel=0.01
    )


def test_the_gain_in_nats_that_was_promised_is_delivered_on_fresh_readings(found):
    place, diagnosis = found
    promised = diagnosis.findings[0].gain.nats_per_reading
    delivered = np.mean([compared(place, seed).nats_per_reading for seed in (11, 12, 13)])

    assert delivered == pytest.approx(promised, rel=0.1)


def test_the_file_says_what_the_estimator_does_not_model():
    _, notes = estimator_for(
        model.Model((SIGNAL, NOISE, model.PeriodicPulse(amplitude_V=1e-3, period_s=7.0, width_s=0.3))),
        interval_s=0.1,
        aperture_s=APERTURE_S,
        span_s=1000.0,
    )

    assert notes == ("met as white noise or drift of its variance, not by its own law: periodic_pulse",)


def test_where_the_estimator_has_no_place_for_what_was_found_the_file_has_that_of_the_base_and_says_so(found, tmp_path):
    place, diagnosis = found
    nothing = replace(diagnosis.promise, taken=False)
    write_extended(replace(diagnosis, promise=nothing), tmp_path / "extended.toml")

    assert load_estimator(tmp_path / "extended.toml") == load_estimator(place / "base.toml")
    assert read_model(tmp_path / "extended.toml") == read_model(place / "extended.toml")
    assert "No estimator here has a place" in (tmp_path / "extended.toml").read_text()


def options_of(*parts, effects=()):
    choice, _ = estimator_for(model.Model(parts, effects=effects), interval_s=0.1, aperture_s=APERTURE_S, span_s=1000.0)
    return choice.options


def test_processes_go_where_their_role_says():
    drift = model.GaussMarkov.from_sd(1e-3, 60.0, role="internal")
    options = options_of(SIGNAL, drift, NOISE, model.Level(level_V=0.5))

    assert options.signal_V == pytest.approx((2e-3 * np.sqrt(0.25),))
    assert (options.slow_V, options.slow_tau_s) == pytest.approx((1e-3, 60.0))
    assert options.noise_V == pytest.approx(3e-4)
    assert options.origin_V == 0.5


def test_a_random_walk_becomes_a_drift_of_its_rate():
    options = options_of(SIGNAL, NOISE, model.GaussMarkov(role="internal", rate_V_per_rt_s=1e-4, tau_s=inf))

    assert options.slow_V * np.sqrt(2 / options.slow_tau_s) == pytest.approx(1e-4)


def test_two_drifts_become_one_of_their_variance_and_rate():
    slow = [model.GaussMarkov.from_sd(sd, tau, role="internal") for sd, tau in ((1e-3, 10.0), (2e-3, 100.0))]
    options = options_of(SIGNAL, NOISE, *slow)

    assert options.slow_V**2 == pytest.approx(5e-6)
    assert options.slow_V**2 / options.slow_tau_s == pytest.approx(1e-6 / 10 + 4e-6 / 100)


def test_shocks_become_the_disturbed_mode_and_without_them_it_never_comes():
    shocks = model.Shocks(rate_per_s=0.1, sd_V=0.1, decay_s=0.5)

    assert options_of(SIGNAL, NOISE, shocks).quiet_s == pytest.approx(10.0)
    assert 0.5 < options_of(SIGNAL, NOISE, shocks).disturbed_s < 5.0
    assert 0.01 < options_of(SIGNAL, NOISE, shocks).disturbed_V < 0.1
    assert options_of(SIGNAL, NOISE).quiet_s == 100 * 1000.0


def test_a_line_above_half_the_rate_is_followed_at_its_alias_with_what_the_aperture_lets_through():
    options = options_of(SIGNAL, NOISE, model.Sine(role="external", amplitude_V=1e-3, frequency_hz=13.0))

    assert options.signal_hz == pytest.approx((0.0, 3.0))
    assert options.signal_V[1] == pytest.approx(1e-3 / 2**0.5 * np.sinc(13.0 * APERTURE_S))


def test_a_resonance_a_sweep_and_an_alternation_are_followed_and_what_is_of_the_input_is_not_left_out():
    resonance = model.Resonance(frequency_hz=2.0, quality=30.0, sd_V=1e-3)
    sweep = model.WanderingLine(amplitude_V=1e-3, frequency_hz=2.0, chirp_hz_per_s=1e-3)
    pattern = model.ReadingPattern(offsets_V=(1e-4, -1e-4))
    options = options_of(SIGNAL, NOISE, resonance, sweep, effects=(pattern,))

    assert options.signal_is == ("input", "disturbance", "disturbance", "disturbance")
    assert options.signal_tau_s[1:] == pytest.approx((30 / (2 * np.pi), 1 / np.pi, 1000.0))
    assert options.signal_hz[1:] == pytest.approx((2.0, 2.5, 5.0), rel=1e-3)
    assert options.signal_V[3] == pytest.approx(1e-4)
    assert options_of(SIGNAL, NOISE, model.Sine(role="signal", amplitude_V=1e-3, frequency_hz=2.0)).signal_is == ()


def test_a_model_without_an_input_has_no_estimator():
    choice, notes = estimator_for(model.Model((NOISE,)), interval_s=0.1, aperture_s=APERTURE_S, span_s=10.0)

    assert choice is None
    assert "no input to estimate" in notes[0]


def test_heavy_tails_beside_shocks_are_noise_of_their_variance():
    """One mode is disturbed, and that is the shocks'."""
    tails = model.HeavyTails(sd_V=4e-4, dof=6.0)
    shocks = model.Shocks(rate_per_s=0.1, sd_V=0.1, decay_s=0.5)

    assert options_of(SIGNAL, NOISE, shocks, effects=(tails,)).noise_V == pytest.approx(5e-4)
    assert options_of(SIGNAL, NOISE, effects=(tails,)).noise_V == pytest.approx(3e-4)
