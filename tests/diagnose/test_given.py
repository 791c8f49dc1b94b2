"""A stated model under criticism: the true one stands, and a term taken out of it is named first."""

from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

from aemd import model
from aemd.diagnose import COVERED, diagnose
from aemd.diagnose.fit import densities
from aemd.diagnose.given import Given, accept
from aemd.diagnose.hypothesis import Data, make_data
from aemd.diagnose.kernels import predict
from aemd.diagnose.series import load_series
from aemd.diagnose.terms.shapes import Nonlinearity
from aemd.diagnose.terms.stated import other_figures
from aemd.diagnose.undone import taken_in
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


@pytest.mark.parametrize(("offset_V", "hysteresis_V"), [(0.4, 0.0), (-0.4, 0.0), (0.3, 0.1), (-0.2, 0.5)])
def test_a_reading_of_either_range_is_known_to_within_the_offset_and_any_other_exactly(offset_V, hysteresis_V):
    """What the ranges were is known here, as there was no other noise."""
    rng = np.random.default_rng(5)
    x = np.cumsum(0.3 * rng.standard_normal(4_000)) % 6 - 3
    switching = model.RangeSwitching(threshold_V=1.5, hysteresis_V=hysteresis_V, offset_V=offset_V)
    read = model.Readings(np.arange(4_000), np.arange(4_000) * 0.1, x)
    y = switching.realise(rng).apply(read).value_V
    wide, least, most = taken_in(y, np.ones(y.size, np.bool_), 1.5, hysteresis_V, offset_V)
    either = most > least

    assert 0.01 < either.mean() < 0.3
    np.testing.assert_allclose((y - offset_V * wide)[~either], x[~either])
    assert np.all((least - 1e-9 <= x) & (x <= most + 1e-9) | ~either)


@pytest.mark.parametrize(("fraction", "level"), [(0.2, 0.0), (0.2, 4.0), (0.05, 60.0), (0.5, 1.0)])
def test_a_gain_that_flickers_has_the_density_of_the_product(fraction, level):
    """Of x (1 + f n), x and n normal: the integral over n, by the trapezium rule."""
    y = level + np.linspace(-2.8, 3.5, 12) * np.hypot(1.0, fraction * np.hypot(level, 1.0))
    n = np.linspace(-9, 9, 100_001)
    gain = 1 + fraction * n
    each = [np.exp(-0.5 * ((at - level * gain) / gain) ** 2 - 0.5 * n**2) / (2 * np.pi * np.abs(gain)) for at in y]
    exact = np.trapezoid(each, n)
    used, ones = np.ones(y.size, np.bool_), np.ones(y.size)
    extras = np.array([-(fraction**2), 0.0, 0.0, 0.0, 0.0, 0.0])
    none = np.array([0.0, 0.0, -1.0])
    arguments = (y, used, ones, level * ones, ones, ones, np.empty((0, 6)), none, extras)
    density, z, *_ = predict(*arguments)

    np.testing.assert_allclose(density, np.log(exact), atol=0.15)
    below = np.array([np.trapezoid(ndtr((at / gain - level) * np.sign(gain)) * np.exp(-0.5 * n**2), n) for at in y])
    np.testing.assert_allclose(z, ndtri(below / np.sqrt(2 * np.pi)), atol=0.05)


def test_a_bend_does_not_free_what_was_clipped():
    """However slight: a reading at the range's end is one that may have been anywhere beyond."""
    y = np.clip(np.random.default_rng(1).normal(0.0, 2.0, 500), -2.0, 3.0)
    data = Data(
        y=y,
        used=np.ones(500, np.bool_),
        step_s=np.ones(500),
        t_s=np.arange(500.0),
        slot=np.arange(500),
        interval_s=1.0,
        origin_V=0.0,
        unit_V=1.0,
    )
    given = Given(
        model.Model(
            (model.WhiteNoise(density_V_per_rt_hz=2.0 * np.sqrt(2)),),
            1,
            (model.Saturation(low_V=-2.0, high_V=3.0),),
        ),
        aperture_s=1.0,
    )
    bent = densities([given, Nonlinearity(0.0, 0.0)], np.array([1e-4]), data)

    np.testing.assert_allclose(bent, densities([given], np.empty(0), data), atol=0.01)


def test_a_range_that_noise_hides_is_refused(tmp_path):
    effect = '[[effects]]\neffect = "range_switching"\nthreshold_V = 1e-2\noffset_V = 1e-3\nsd_V = 5e-4\n'
    with pytest.raises(ConfigError, match="range_switching: sd_V"):
        diagnose(made(tmp_path, CALM + effect), model=tmp_path / "true.toml")
