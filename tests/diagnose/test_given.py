"""A stated model under criticism: the true one stands, and a term taken out of it is named."""

from pathlib import Path

import pytest

from aemd.diagnose import diagnose
from aemd.diagnose.given import accept
from aemd.errors import ConfigError
from aemd.simulate import read_model, simulate

BASE = """
[[terms]]
term = "level"
level_V = 0.01
[[terms]]
term = "gauss_markov"
rate_V_per_rt_s = 2e-3
tau_s = 0.5
[[terms]]
term = "gauss_markov"
role = "internal"
rate_V_per_rt_s = 1.8e-4
tau_s = 60.0
[[terms]]
term = "white_noise"
density_V_per_rt_hz = 1e-4
[[terms]]
term = "shocks"
rate_per_s = 0.05
sd_V = 8e-3
decay_s = 0.3
"""
REMOVED = {
    "mains_alias": '[[terms]]\nterm = "sine"\nrole = "external"\namplitude_V = 4e-3\nfrequency_hz = 60.0\n',
    "periodic_interference": '[[terms]]\nterm = "sine"\nrole = "external"\namplitude_V = 2e-4\nfrequency_hz = 4.1\n',
    "wandering_line": '[[terms]]\nterm = "wandering_line"\namplitude_V = 3e-4\nfrequency_hz = 4.1\n'
    "chirp_hz_per_s = 1.5e-4\n",
    "resonance": '[[terms]]\nterm = "resonance"\nfrequency_hz = 4.0\nquality = 20.0\nsd_V = 2.5e-4\n',
    "step": '[[terms]]\nterm = "step"\ntime_s = 150.0\nstep_V = 5e-3\n',
    "difference_noise": '[[effects]]\neffect = "difference_noise"\nsd_V = 3e-4\n',
    "signal_dependent_noise": '[[effects]]\neffect = "signal_dependent_noise"\nfraction = 0.1\n',
    "reading_pattern": '[[effects]]\neffect = "reading_pattern"\noffsets_V = [1e-4, -1e-4]\n',
    "quantisation": '[[effects]]\neffect = "quantiser"\nstep_V = 1e-3\n',
}


def made(folder: Path, text: str) -> Path:
    (folder / "true.toml").write_text(text)
    simulate(folder / "true.toml", seconds=400, seed=3, out=folder / "a.mcap")
    return folder / "a.mcap"


@pytest.mark.parametrize("cause", REMOVED)
def test_the_true_model_stands_and_without_its_term_the_term_is_named(tmp_path, cause):
    path = made(tmp_path, BASE + REMOVED[cause])
    (tmp_path / "less.toml").write_text(BASE)

    assert diagnose(path, model=tmp_path / "true.toml").findings == ()
    assert cause in [finding.cause for finding in diagnose(path, model=tmp_path / "less.toml").findings]


def test_the_sign_of_the_shocks_is_named_where_the_stated_model_has_it_even(tmp_path):
    path = made(
        tmp_path, BASE.replace("decay_s = 0.3", "decay_s = 0.3\npositive_fraction = 0.98").replace("0.05", "0.2")
    )
    (tmp_path / "less.toml").write_text(BASE.replace("rate_per_s = 0.05", "rate_per_s = 0.2"))

    assert diagnose(path, model=tmp_path / "true.toml").findings == ()
    assert [finding.cause for finding in diagnose(path, model=tmp_path / "less.toml").findings] == ["shock_law"]


@pytest.mark.parametrize("key", ["second_fraction = 0.2", "ring_fraction = 0.1", "after_shocks = 0.3"])
def test_what_the_filter_does_not_know_of_shocks_is_refused_and_not_left_out(tmp_path, key):
    (tmp_path / "a.toml").write_text(BASE + key + "\n")
    with pytest.raises(ConfigError, match=key.split()[0]):
        accept(read_model(tmp_path / "a.toml"), "a.toml")


def test_a_model_that_the_filter_cannot_follow_is_refused_in_one_line(tmp_path):
    text = BASE + '[[terms]]\nterm = "popcorn_noise"\nstep_V = 1e-3\ndwell_low_s = 5.0\ndwell_high_s = 5.0\n'
    path = made(tmp_path, text)
    with pytest.raises(ConfigError, match="popcorn_noise: cannot be criticised yet"):
        diagnose(path, model=tmp_path / "true.toml")
