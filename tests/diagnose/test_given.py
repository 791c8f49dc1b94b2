"""A stated model under criticism: the true one stands, and a term taken out of it is named first."""

from pathlib import Path

import numpy as np
import pytest

from aemd import model
from aemd.diagnose import COVERED, diagnose
from aemd.diagnose.fit import densities
from aemd.diagnose.given import Given, accept
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.series import load_series
from aemd.diagnose.terms.stated import other_figures
from aemd.errors import ConfigError
from aemd.simulate import read_model, simulate
from tests.diagnose.removed import BASE, CALM, CASES, FAST, run_case


def made(folder: Path, text: str) -> Path:
    (folder / "true.toml").write_text(text)
    simulate(folder / "true.toml", seconds=400, seed=3, out=folder / "a.mcap")
    return folder / "a.mcap"


@pytest.mark.parametrize(
    "cause", [cause if cause in FAST else pytest.param(cause, marks=pytest.mark.slow) for cause in CASES]
)
def test_the_true_model_stands_and_without_its_part_the_part_is_named_first(tmp_path, cause):
    found = run_case(cause, CASES[cause], tmp_path)

    assert found.true == "nothing_found"
    assert found.names[0] == cause


def test_every_mechanism_of_the_catalogue_is_removed_once():
    assert set(CASES) == set(COVERED)


def test_the_sign_of_the_shocks_is_named_where_the_stated_model_has_it_even(tmp_path):
    path = made(
        tmp_path, BASE.replace("decay_s = 0.3", "decay_s = 0.3\npositive_fraction = 0.98").replace("0.05", "0.2")
    )
    (tmp_path / "less.toml").write_text(BASE.replace("rate_per_s = 0.05", "rate_per_s = 0.2"))

    assert diagnose(path, model=tmp_path / "true.toml").findings == ()
    assert [finding.cause for finding in diagnose(path, model=tmp_path / "less.toml").findings] == ["shock_law"]


REFUSED = {
    "after_shocks": BASE + "after_shocks = 0.3\n",
    "wander_hz_per_rt_s": CALM
    + '[[terms]]\nterm = "wandering_line"\namplitude_V = 1e-3\nfrequency_hz = 4.0\nwander_hz_per_rt_s = 0.01\n',
    "popcorn_noise": BASE + '[[terms]]\nterm = "popcorn_noise"\nstep_V = 1e-3\ndwell_low_s = 5.0\ndwell_high_s = 5.0\n',
    "dead_band": CALM + '[[effects]]\neffect = "dead_band"\nwidth_V = 1e-3\n'
    '[[effects]]\neffect = "heavy_tails"\nsd_V = 1e-3\ndof = 3.0\n',
    "offset_V": CALM + '[[effects]]\neffect = "range_switching"\nthreshold_V = 1e-2\noffset_V = -1e-3\n',
}


@pytest.mark.parametrize("part", REFUSED)
def test_what_the_likelihood_does_not_carry_is_refused_in_one_line_that_says_what(tmp_path, part):
    (tmp_path / "a.toml").write_text(REFUSED[part])
    with pytest.raises(ConfigError, match=part) as refusal:
        accept(read_model(tmp_path / "a.toml"), "a.toml")

    assert "\n" not in str(refusal.value)
    assert "likelihood" in str(refusal.value)


@pytest.mark.parametrize("cause", ["heavy_tails", "ring_down", "flicker_noise", "difference_noise", "resonance"])
def test_a_part_with_other_figures_is_the_model_that_states_them(tmp_path, cause):
    """Each figure of each part times 1.3: the density of every reading is that under the model so written."""
    (tmp_path / "a.toml").write_text(CASES[cause].true)
    simulate(tmp_path / "a.toml", seconds=60, seed=3, out=tmp_path / "a.mcap")
    given, _ = accept(read_model(tmp_path / "a.toml"), "a.toml")
    data = make_data(load_series(tmp_path / "a.mcap"))

    for figures in other_figures(given, data.n):
        theta = np.full(figures.start.size, np.log(1.3))
        parts = [*given.stated.terms, *given.stated.effects]
        parts[figures.number] = figures.made(theta, data)
        first = len(given.stated.terms)
        stated = Given(model.Model(tuple(parts[:first]), effects=tuple(parts[first:])))

        np.testing.assert_allclose(
            densities([given, figures], theta, data), densities([stated], np.empty(0), data), rtol=1e-9, atol=1e-9
        )
