"""A model that is given to `tune` has its numbers refined: never for the worse, and never into another model."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aemd.block import Block
from aemd.config import load_estimator
from aemd.errors import ConfigError
from aemd.estimate.imm import Imm, ImmOptions
from aemd.estimate.refine import refine
from aemd.record.reader import Recording
from aemd.simulate import read_model, simulate
from tests.cli.asking import Run, refused

TERMS = """# Of a sensor beside a fan.
seed = 4
[[terms]]
term = "gauss_markov"
role = "signal"
rate_V_per_rt_s = 2.828e-3
tau_s = 1.0
[[terms]]
term = "sine"
role = "external"
amplitude_V = 3e-3
frequency_hz = 3.1
[[terms]]
term = "white_noise"
density_V_per_rt_hz = 2e-4
[[effects]]
effect = "quantiser"
step_V = 1e-6
"""
ESTIMATOR = """
[estimator]
name = "imm"
signal_V = [1e-3, 1e-3]
signal_tau_s = [3.0, 60.0]
signal_hz = [0.0, 3.097]
signal_is = ["input", "disturbance"]
slow_V = 1e-4
slow_tau_s = 150.0
origin_V = 2e-3
noise_V = 3e-3
disturbed_V = 0.05
quiet_s = 1000.0
disturbed_s = 0.1
lag = 2
"""
NOISE_V = 2e-4 / math.sqrt(2 * 0.02)  # of a one-sided density over an aperture of 20 ms


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a minute of the terms above."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "terms.toml").write_text(TERMS)
    simulate(folder / "terms.toml", seconds=60, seed=11, out=folder / "r.mcap")
    return folder / "r.mcap"


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "m.toml"
    path.write_text(TERMS + ESTIMATOR)
    return path


def readings_of(path: Path) -> tuple[Block, float]:
    with Recording(path) as recording:
        return np.concatenate([batch.readings for batch in recording.batches()]), recording.description.interval_s


def explained(options: ImmOptions, readings: Block, interval_s: float) -> float:
    """Return the log-likelihood per reading that the estimator itself gives with its estimates."""
    return float(Imm(replace(options, lag=0), interval_s).push(readings)["log_likelihood"].mean())


def test_a_model_that_is_far_off_is_refined_and_is_a_whole_model_again(
    aemd: Run, made: Path, model: Path, tmp_path: Path
) -> None:
    new = tmp_path / "new.toml"

    code, out, err = aemd("tune", made, "--model", model, "-o", new, "--json")

    told = json.loads(out)
    assert code == 0, err
    given, refined = load_estimator(model).options, load_estimator(new).options
    readings, interval_s = readings_of(made)
    assert told["log_likelihood_given"] == pytest.approx(explained(given, readings, interval_s), rel=1e-9)
    assert told["log_likelihood"] == pytest.approx(explained(refined, readings, interval_s), rel=1e-9)
    assert told["log_likelihood"] > told["log_likelihood_given"] + 0.1
    assert told["kind"] == "markov + disturbance swing + slow"
    assert refined.noise_V == pytest.approx(NOISE_V, rel=0.25)  # 890 readings, most of whose scatter is the signal's
    assert refined.signal_hz == (0.0, pytest.approx(3.1, abs=2e-3))  # an eighth of what 60 s tell apart
    assert refined.signal_V[1] == pytest.approx(3e-3 / math.sqrt(2), rel=0.1)  # likeliest for that one amplitude
    for kept in ("signal_is", "slow", "lag", "gate", "restart_after", "longest_disturbance_s", "variance_memory_s"):
        assert getattr(refined, kept) == getattr(given, kept)
    assert read_model(new) == read_model(model)
    assert aemd("simulate", "--model", new, "--seconds", 1, "-o", tmp_path / "s.mcap")[0] == 0
    assert aemd("replay", made, "--model", new, "--out", tmp_path / "imm.mcap")[0] == 0


def test_what_is_said_beside_a_model_is_taken_and_the_rest_is_the_models(
    aemd: Run, made: Path, model: Path, tmp_path: Path
) -> None:
    model.write_text(ESTIMATOR)
    words = ("tune", made, "--model", model, "--to", 20)

    assert aemd(*words, "--noise", 1.5e-3, "--lag", 5, "-o", tmp_path / "new.toml")[0] == 0

    refined = load_estimator(tmp_path / "new.toml").options
    assert (refined.noise_V, refined.lag) == (1.5e-3, 5)
    assert "terms" not in (tmp_path / "new.toml").read_text()


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"drive_V": (1e-3, 2e-3), "drive_rad": (0.0, 1.0), "signal_is": ("disturbance", "input"), "slow": "input"},
        {"signal_tau_s": (20.0, 60.0), "slow_tau_s": 25.0},  # the readings' own process forgets in 1 s
        {
            "signal_tau_s": (150.0, 60.0),
            "origin_V": None,
            "variance_memory_s": 10.0,
        },  # as slow as the slow part: which of the two is faster cannot be said
        {"origin_V": 10.0},
        {"gate": 3.0, "noise_V": 0.5},
    ],
    ids=str,
)
def test_whatever_is_given_is_never_less_likely_when_refined_and_its_parts_are_the_same(
    given: dict[str, object], made: Path, model: Path
) -> None:
    readings, interval_s = readings_of(made)
    readings = readings[:150]
    options = replace(load_estimator(model).options, **given)

    found = refine([readings], interval_s, options)

    refined = found.options
    assert found.log_likelihood >= found.given
    assert explained(replace(refined, gate=1e6), readings, interval_s) == pytest.approx(found.log_likelihood, rel=1e-9)
    assert explained(replace(options, gate=1e6), readings, interval_s) == pytest.approx(found.given, rel=1e-9)
    for kept in ("signal_is", "slow", "lag", "gate", "drive_rad"):
        assert getattr(refined, kept) == getattr(options, kept)
    assert (refined.origin_V is None) == (options.origin_V is None)
    assert refined.signal_hz[0] == 0
    assert 3.097 / 1.21 < refined.signal_hz[1] < 3.097 * 1.21
    assert refined.signal_tau_s[0] <= refined.slow_tau_s
    if options.drive_V:
        assert refined.signal_tau_s == options.signal_tau_s
        assert refined.drive_V[1] / refined.drive_V[0] == pytest.approx(2.0)


def test_a_model_refined_twice_stays(made: Path, model: Path) -> None:
    readings, interval_s = readings_of(made)
    once = refine([readings[:200]], interval_s, load_estimator(model).options)

    again = refine([readings[:200]], interval_s, once.options)

    assert again.given == once.log_likelihood
    assert again.log_likelihood == pytest.approx(once.log_likelihood, abs=1e-3)


def test_readings_that_tell_nothing_are_refused_beside_a_model_too(made: Path, model: Path) -> None:
    readings, interval_s = readings_of(made)
    still = readings.copy()
    still["value_V"] = 1.0

    for block in (readings[:99], still):
        with pytest.raises(ConfigError, match="tune by"):
            refine([block], interval_s, load_estimator(model).options)


@pytest.mark.parametrize(
    ("text", "words", "code", "says"),
    [
        (TERMS, (), 78, "m.toml: [estimator]: missing"),
        ('[estimator]\nname = "aem"\n', (), 78, "m.toml: [estimator] name = 'aem': must be 'imm'"),
        ("[estimator]\n", (), 78, "m.toml: [estimator] name = 'aem': must be 'imm'"),
        (ESTIMATOR.replace("3.097", "8.0"), (), 78, "m.toml: [estimator] signal_hz = 8: must be at most half"),
        (ESTIMATOR.replace("3e-3", "-1.0"), (), 78, "m.toml: [estimator] noise_V = -1.0: must be"),
        (TERMS.replace("tau_s = 1.0", "tau_s = 0.0") + ESTIMATOR, (), 78, "tau_s = 0.0: must be"),
        ("seed = [", (), 78, "m.toml: not TOML"),
        (None, (), 78, "m.toml: no such file"),
        (ESTIMATOR, ("--slow", "input"), 2, "--slow input: not with --model"),
        (ESTIMATOR, ("--slowest-signal", 10), 2, "--slowest-signal 10.0: not with --model"),
        (ESTIMATOR, ("--resonances", 3), 2, "--resonances 3: not with --model"),
        (ESTIMATOR, ("--noise", 0), 2, "--noise 0: must be from 1e-12 to 1000 V"),
        (ESTIMATOR, ("--to", 2), 2, "too few to tune by"),
    ],
)
def test_what_cannot_be_refined_is_refused_in_one_line_and_nothing_is_written(
    text: str | None, words: tuple[object, ...], code: int, says: str, aemd: Run, made: Path, tmp_path: Path
) -> None:
    if text is not None:
        (tmp_path / "m.toml").write_text(text)

    found, out, err = aemd("tune", made, "--model", tmp_path / "m.toml", "-o", tmp_path / "new.toml", *words)

    assert says in refused(found, err, out, code)
    assert not (tmp_path / "new.toml").exists()


def test_a_slowest_signal_without_a_band_is_refused(aemd: Run, made: Path, tmp_path: Path) -> None:
    found, out, err = aemd("tune", made, "--slowest-signal", 0.2, "-o", tmp_path / "new.toml")

    assert "--slowest-signal 0.2: must be at least 4 intervals of" in refused(found, err, out, 2)


def test_a_wrong_model_for_many_files_is_told_once(aemd: Run, made: Path, tmp_path: Path) -> None:
    found, out, err = aemd("tune", made.parent, "--model", tmp_path / "none.toml", "-o", tmp_path / "out")

    assert "none.toml: no such file" in refused(found, err, out, 78)


@pytest.mark.slow
def test_of_many_files_each_has_the_models_terms_in_its_own(aemd: Run, made: Path, model: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / "in").mkdir(exist_ok=True)
        (tmp_path / "in" / f"{name}.mcap").write_bytes(made.read_bytes())

    code, out, err = aemd("tune", tmp_path / "in", "--to", 10, "-o", tmp_path / "out", "--model", model, "--json")

    assert code == 0, err
    assert [row["file"] for row in json.loads(out)["files"]] == ["a.mcap", "b.mcap"]
    assert read_model(tmp_path / "out" / "b.toml") == read_model(model)


@pytest.mark.slow
def test_a_model_that_diagnose_extended_is_refined_on_the_next_recording(aemd: Run, made: Path, tmp_path: Path) -> None:
    extended, new = tmp_path / "extended.toml", tmp_path / "new.toml"
    (tmp_path / "terms.toml").write_text(TERMS)
    simulate(tmp_path / "terms.toml", seconds=120, seed=12, out=tmp_path / "first.mcap")

    assert aemd("diagnose", tmp_path / "first.mcap", "-o", extended)[0] == 0
    code, out, err = aemd("tune", made, "--model", extended, "-o", new, "--json")

    assert code == 0, err
    assert json.loads(out)["log_likelihood"] >= json.loads(out)["log_likelihood_given"]
    assert load_estimator(new).options.signal_is == ("input", "disturbance")
    assert read_model(new) == read_model(extended)
