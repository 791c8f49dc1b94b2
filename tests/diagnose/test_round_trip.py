"""The extended model's file is what simulate, acquire and replay take, and on fresh readings it keeps its promise."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest

from aemd import model
from aemd.block import READING
from aemd.config import load_config, load_estimator
from aemd.diagnose import diagnose, write_extended
from aemd.diagnose.estimator import estimator_for
from aemd.estimate.imm import Imm
from aemd.replay import replay
from aemd.simulate import read_model, simulate
from tests.diagnose.removed import BASE

INTERVAL_S, APERTURE_S = 0.06712, 0.02
LINE = '[[terms]]\nterm = "sine"\nrole = "external"\namplitude_V = 2e-3\nfrequency_hz = 3.3\n'
SIGNAL = model.GaussMarkov(role="signal", rate_V_per_rt_s=2e-3, tau_s=0.5)
NOISE = model.WhiteNoise.from_sd(3e-4, APERTURE_S)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """A record with a line, its diagnosis, and the files of base and extended model."""
    place = tmp_path_factory.mktemp("round")
    (place / "true.toml").write_text(BASE + LINE)
    simulate(place / "true.toml", seconds=300, seed=3, out=place / "a.mcap")
    diagnosis = diagnose(place / "a.mcap")
    write_extended(diagnosis, place / "extended.toml")
    write_extended(diagnosis, place / "base.toml", extended=False)
    return place, diagnosis


def error_of(place, estimator, seed):
    """Root mean square of estimate less true input, on a history that the diagnosis never saw."""
    true = replace(read_model(place / "true.toml"), seed=seed)
    start_s = np.arange(5000) * INTERVAL_S
    block = np.zeros(start_s.size, READING)
    block["index"] = np.arange(start_s.size)
    block["value_V"] = true.realise().read(start_s, APERTURE_S).value_V
    estimate_V = Imm(load_estimator(place / estimator).options, INTERVAL_S).push(block)["value_V"]
    left_V = estimate_V - true.realise().average(start_s, APERTURE_S).signal_V
    return float(np.sqrt(np.mean(left_V[300:] ** 2)))


def test_the_extended_estimator_errs_less_on_fresh_readings_where_a_gain_was_promised(found):
    place, diagnosis = found
    (line,) = diagnosis.findings

    assert line.gain.low > 0
    for seed in (11, 12, 13):
        assert error_of(place, "extended.toml", seed) < 0.8 * error_of(place, "base.toml", seed)


def test_of_readings_that_the_extended_model_makes_it_lacks_nothing(found):
    place, _ = found
    simulate(place / "extended.toml", seconds=150, seed=21, out=place / "b.mcap")

    assert diagnose(place / "b.mcap", model=place / "extended.toml").findings == ()
    assert diagnose(place / "b.mcap", model=place / "base.toml").findings != ()


def test_replay_takes_the_extended_estimator(found):
    place, _ = found
    replay(place / "a.mcap", model=place / "extended.toml", out=place / "c.mcap")

    assert (place / "c.mcap").stat().st_size > 0


def test_acquire_takes_the_extended_estimator(found):
    place, _ = found
    settings = load_config(None).with_estimator(load_estimator(place / "extended.toml"))

    assert settings.estimator.name == "imm"
    assert settings.estimator.options.signal_tau_s == (
        next(term.tau_s for term in read_model(place / "extended.toml").terms if isinstance(term, model.GaussMarkov)),
    )


def test_the_file_says_what_the_estimator_does_not_model(found):
    place, _ = found

    assert "# Met as white noise or drift of its variance, not by its own law: sine." in (
        (place / "extended.toml").read_text().splitlines()
    )


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


def test_a_fast_line_is_met_as_noise_and_a_slow_one_as_drift():
    line = model.Sine(role="external", amplitude_V=1e-3, frequency_hz=3.0)
    assert options_of(SIGNAL, NOISE, line).noise_V ** 2 == pytest.approx(3e-4**2 + 1e-6 / 2)

    slow = model.Sine(role="external", amplitude_V=1e-3, frequency_hz=0.01)
    assert options_of(SIGNAL, NOISE, slow).slow_V ** 2 == pytest.approx(1e-6 / 2)


def test_a_model_without_an_input_has_no_estimator():
    choice, notes = estimator_for(model.Model((NOISE,)), interval_s=0.1, aperture_s=APERTURE_S, span_s=10.0)

    assert choice is None
    assert "no input to estimate" in notes[0]
