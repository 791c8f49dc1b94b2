"""A tuned model goes from a recording into a file, and from the file into the next replay, to the bit."""

import json
from pathlib import Path

import numpy as np
import pytest

from aemd.config import EstimatorChoice, load_estimator
from aemd.errors import ConfigError, RecordingError, UsageError
from aemd.estimate.imm import ImmOptions
from aemd.replay import replay
from aemd.report import as_toml
from aemd.simulate import simulate
from aemd.tune import tune_recording

MODEL = """
[[terms]]
term = "gauss_markov"
role = "signal"
rate_V_per_rt_s = 2.828e-3
tau_s = 1.0
[[terms]]
term = "white_noise"
density_V_per_rt_hz = 2e-4
"""
SD_V = 2.828e-3 * np.sqrt(1.0 / 2)  # of a first-order Markov process: rate times the root of half its time constant
NOISE_V = 2e-4 / np.sqrt(2 * 0.02)  # of a one-sided density over an aperture of 20 ms


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tune")
    (folder / "model.toml").write_text(MODEL)
    simulate(folder / "model.toml", seconds=300, seed=5, out=folder / "r.mcap")
    return folder / "r.mcap"


def test_tuning_finds_the_parameters_that_made_the_readings(recording: Path, tmp_path: Path) -> None:
    found = tune_recording(recording, tmp_path / "m.toml", lag=3)

    options = load_estimator(tmp_path / "m.toml").options
    assert found.kind.startswith("markov")
    assert options.lag == 3
    assert options.noise_V == pytest.approx(NOISE_V, rel=0.2)  # 4,500 readings tell it to some per cent
    assert options.signal_V[0] == pytest.approx(SD_V, rel=0.3)  # 300 time constants tell it to a tenth
    assert options.signal_tau_s[0] == pytest.approx(1.0, rel=0.5)


def test_a_replay_with_the_file_is_one_with_its_options_and_repeats_to_the_bit(recording: Path, tmp_path: Path) -> None:
    tune_recording(recording, tmp_path / "m.toml")

    made = replay(recording, model=tmp_path / "m.toml", out=tmp_path / "imm.mcap")
    again = replay(tmp_path / "imm.mcap", check=True)

    assert made.estimator == again.estimator == "imm"
    assert again.identical is True
    assert made.raw_variance_V2 is not None
    assert json.dumps(again.estimate_variance_V2) == json.dumps(made.estimate_variance_V2)


def test_a_model_file_gives_back_every_bit(tmp_path: Path) -> None:
    options = ImmOptions(
        signal_V=(1 / 3, 0.1), signal_tau_s=(0.7, 2.0), signal_hz=(0.0, 0.1), origin_V=-1e-7, slow="input", lag=3
    )
    for choice in (EstimatorChoice("imm", options), EstimatorChoice("imm", ImmOptions())):
        (tmp_path / "m.toml").write_text(as_toml(choice.as_table()))

        assert load_estimator(tmp_path / "m.toml") == choice


def test_too_short_a_stretch_is_refused_in_one_line(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"r\.mcap: 30 readings with a value: too few .* --from and --to"):
        tune_recording(recording, tmp_path / "m.toml", to_s=2.0)


def test_a_model_file_is_never_overwritten(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text("mine")

    with pytest.raises(RecordingError, match="exists"):
        tune_recording(recording, tmp_path / "m.toml")

    assert (tmp_path / "m.toml").read_text() == "mine"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "[estimator]: missing"),
        ('[estimator]\nname = "imm"\nlag = -1\n', "[estimator] lag = -1: must be greater than or equal to 0"),
        ('[estimator]\nname = "imm"\nsignal_hz = [0.1, 0.2]\n', "signal_V, signal_tau_s, signal_hz have 1, 1 and 2"),
    ],
)
def test_a_broken_model_file_is_refused_with_its_place(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_text(text)

    with pytest.raises(ConfigError) as caught:
        load_estimator(path)

    assert str(path) in str(caught.value)
    assert says in str(caught.value)
