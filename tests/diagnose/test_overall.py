"""A stated model that expects too much noise, or too little, does not stand, and no mechanism is invented for it."""

from dataclasses import replace

import numpy as np
import pytest

from aemd import model
from aemd.diagnose import criticise, diagnose
from aemd.diagnose.given import Given
from aemd.diagnose.report import format_diagnosis
from aemd.simulate import simulate
from tests.diagnose.plant import series
from tests.diagnose.test_given import BASE

WHITE = model.Model((model.Level(level_V=1.0), model.WhiteNoise.from_sd(1e-3, 0.02)))
N = 4000


def white_noise(times: float):
    """Return the diagnosis of white noise of so many times the stated size."""
    y = 1.0 + times * 1e-3 * np.random.default_rng(5).standard_normal(N)
    return criticise(replace(series(y), aperture_s=0.02), stated=(Given(WHITE), frozenset()))


def test_white_noise_of_the_stated_size_stands():
    found = white_noise(1.0)

    assert (found.verdict, found.findings, found.discrepancies) == ("nothing_found", (), ())


@pytest.mark.parametrize("times", [0.7, 0.92, 1.08, 1.3])
def test_white_noise_of_another_size_than_stated_is_told_as_that_and_as_nothing_else(times):
    """Of 4,000 readings the deviation is known to 1/sqrt(8000) = 1.1 %, so 8 % are 7 deviations."""
    found = white_noise(times)
    (finding,) = found.findings
    (figure,) = [item for item in found.discrepancies if item.check.startswith("white noise of the stated model")]

    assert (found.verdict, finding.names) == ("unexplained", ("unexplained",))
    assert "The white noise has other figures than the stated model has: sd" in format_diagnosis(found)
    assert finding.parameters["sd_V"].value == pytest.approx(times * 1e-3, rel=4 / np.sqrt(2 * N))
    assert figure.observed == finding.parameters["sd_V"].value
    assert figure.simulated_high == pytest.approx(1e-3 * (1 + 1.96 / np.sqrt(2 * N)), rel=2e-3)
    assert figure.simulated_low == pytest.approx(1e-3 * (1 - 1.96 / np.sqrt(2 * N)), rel=2e-3)
    assert any(item.check.startswith("variance of the residuals") for item in found.discrepancies)
    assert found.extended_model["terms"][1]["density_V_per_rt_hz"] == pytest.approx(times * 2e-4, rel=0.05)


@pytest.mark.parametrize(
    ("stated", "true", "what"),
    [
        ("density_V_per_rt_hz = 1e-4", "density_V_per_rt_hz = 1.2e-4", "white noise"),
        ("density_V_per_rt_hz = 1e-4", "density_V_per_rt_hz = 0.7e-4", "white noise"),
        ("tau_s = 0.5", "tau_s = 0.15", "signal"),
        ("decay_s = 0.3", "decay_s = 0.9", "shocks"),
    ],
)
def test_a_figure_that_is_wrong_among_all_the_others_is_the_one_that_is_told(tmp_path, stated, true, what):
    (tmp_path / "true.toml").write_text(BASE.replace(stated, true))
    (tmp_path / "stated.toml").write_text(BASE)
    simulate(tmp_path / "true.toml", seconds=400, seed=4, out=tmp_path / "a.mcap")
    found = diagnose(tmp_path / "a.mcap", model=tmp_path / "stated.toml")

    assert found.verdict == "unexplained"
    assert [finding.cause for finding in found.findings] == ["unexplained"]
    assert found.findings[0].remark == f"The {what} has other figures than the stated model has"
    key, number = (text := true.split(" = "))[0], float(text[1])
    if key in found.findings[0].parameters:
        value = found.findings[0].parameters[key]
        assert value.low < number < value.high or value.value == pytest.approx(number, rel=0.3)
