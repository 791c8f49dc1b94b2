from math import inf, nextafter

import numpy as np
import pytest

from aemd.errors import ConfigError, RecordingError, UsageError
from aemd.model import GaussMarkov, MissingSamples, Model, Quantiser, ReadingPattern, Sine, WhiteNoise
from aemd.record.reader import Recording
from aemd.simulate import read_model, simulate, write_model

MODEL = Model(
    (GaussMarkov.from_sd(sd_V=1e-3, tau_s=0.5), WhiteNoise.from_sd(sd_V=1e-4, aperture_s=0.02)),
    seed=9,
    effects=(ReadingPattern(offsets_V=(1e-4, -1e-4)), MissingSamples(fraction=0.1), Quantiser(step_V=1e-6)),
)


@pytest.fixture
def model_file(tmp_path):
    path = tmp_path / "model.toml"
    write_model(MODEL, path)
    return path


def recorded(path):
    with Recording(path) as recording:
        return np.concatenate([batch.readings for batch in recording.batches()]), recording.description


def test_a_model_survives_its_file_to_the_last_bit(tmp_path):
    model = Model(
        (GaussMarkov(rate_V_per_rt_s=nextafter(0.1, 1), tau_s=inf), Sine(amplitude_V=1e-300, frequency_hz=1 / 3)),
        seed=2**60,
        effects=(MissingSamples(fraction=0.1, counted=False), ReadingPattern(offsets_V=(-0.1, 1e22, 3.0))),
    )

    write_model(model, tmp_path / "m.toml")

    assert read_model(tmp_path / "m.toml") == model


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sed = 1", "sed: unknown key; did you mean 'seed'? there are: effects, seed, terms"),
        ("seed = -1", "seed = -1: must be a whole number, at least 0"),
        ("seed = true", "seed = True: must be a whole number, at least 0"),
        ("terms = 3", "terms: must be a list of tables, each written [[terms]]"),
        ("[[terms]]\nrole = 'noise'", "[terms 1] term: missing; there are: "),
        ("[[terms]]\nterm = 'sin'", "[terms 1] term = 'sin': unknown; did you mean 'sine'? there are: "),
        ("[[terms]]\nterm = 'level'\nlevel_V = '1'", '[terms 1: level] level_V = "1": must be a valid number'),
        (
            "[[terms]]\nterm = 'level'\nlevel_V = 1\n[[terms]]\nterm = 'sine'\namplitude_V = 1\nfrequency_hz = -1",
            "[terms 2: sine] frequency_hz = -1: must be greater than 0",
        ),
        (
            "[[effects]]\neffect = 'saturation'\nlow_V = 2.0\nhigh_V = 1.0",
            "[effects 1: saturation] low_V = 2.0: must be below high_V = 1.0",
        ),
        ("seed = ", "not TOML: invalid value"),
    ],
)
def test_a_mistake_in_a_model_file_is_one_line_with_its_place(tmp_path, text, message):
    path = tmp_path / "m.toml"
    path.write_text(text)

    with pytest.raises(ConfigError) as caught:
        read_model(path)

    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value)


def test_a_model_file_that_is_not_there_is_one_line(tmp_path):
    with pytest.raises(ConfigError, match=r"m.toml: no such file or directory; name a readable model file"):
        read_model(tmp_path / "m.toml")


def test_the_recording_holds_the_readings_of_the_model(tmp_path, model_file):
    summary = simulate(model_file, seconds=10.0, out=tmp_path / "a.mcap", interval_s=0.1, aperture_s=0.05)
    expected = MODEL.realise().read(np.arange(100) * 0.1, 0.05)
    readings, description = recorded(tmp_path / "a.mcap")

    assert readings["value_V"].tolist() == expected.value_V.tolist()
    assert readings["index"].tolist() == expected.index.tolist()
    assert (readings["t_ns"] - 10**18).tolist() == (expected.index * 10**8 + 25 * 10**6).tolist()
    assert (summary.readings, summary.lost) == (expected.index.size, 100 - expected.index.size)
    assert description.interval_s == 0.1
    assert description.session["model"] == model_file.read_text()


def test_the_same_seed_makes_the_same_file_and_another_one_another(tmp_path, model_file):
    for name, seed in (("a", 9), ("b", None), ("c", 10)):
        simulate(model_file, seconds=5.0, seed=seed, out=tmp_path / name)

    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert not np.array_equal(recorded(tmp_path / "a")[0]["value_V"], recorded(tmp_path / "c")[0]["value_V"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seconds": 0.0}, "--seconds 0.0: must be from the interval of 0.06712"),
        ({"seconds": inf}, "--seconds inf"),
        ({"seconds": 1.0, "aperture_s": 0.1}, "--aperture 0.1: must be above 0 and at most the interval"),
        ({"seconds": 1.0, "seed": -1}, "--seed -1: must be at least 0"),
    ],
)
def test_times_that_do_not_fit_are_refused(tmp_path, model_file, options, message):
    with pytest.raises(UsageError, match=message):
        simulate(model_file, out=tmp_path / "a.mcap", **options)


def test_an_existing_recording_is_not_overwritten(tmp_path, model_file):
    simulate(model_file, seconds=1.0, out=tmp_path / "a.mcap")

    with pytest.raises(RecordingError, match=r"a\.mcap"):
        simulate(model_file, seconds=1.0, out=tmp_path / "a.mcap")
