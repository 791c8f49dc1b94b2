"""A config says what it means, or is refused in one line that names file, key, value and rule."""

import dataclasses
import re
import tomllib
from pathlib import Path

import pytest

from aemd.config import (
    AcquisitionOptions,
    EstimatorChoice,
    RecordingOptions,
    Scale,
    load_config,
    name_estimator,
    recorded_estimator,
)
from aemd.errors import ConfigError, UsageError
from aemd.estimate.aem import AemOptions
from aemd.record.description import Description

CONFIGS = Path(__file__).parent.parent / "config"

SIM = '[instrument]\nresource = "sim"\n'
BROKEN = {
    "": "[instrument] resource: missing",
    "x = 1": "x: unknown key",
    "instrument = 3": "instrument = 3: must be a table",
    "[instrument": "not TOML",
    '[instrument]\nresource = ""': '[instrument] resource = "": must be text',
    "[instrument]\nresource = 5": "[instrument] resource = 5: must be text",
    SIM + 'driver = "agilent3441"': "did you mean 'agilent34410'?",
    SIM + "nplc = 3": "nplc = 3: must be one of",
    SIM + 'nplc = "1"': '[instrument] nplc = "1": must be a valid number',
    SIM + "nplc = true": "[instrument] nplc = true: must be a valid number",
    SIM + "range = 10": "range: unknown key; did you mean 'range_V'?",
    SIM + "interval_s = -1": "[instrument] interval_s = -1: must be greater than 0",
    SIM + 'autozero = "maybe"': "autozero = \"maybe\": must be 'on', 'off' or 'once'",
    '[instrument]\nresource = "TCPIP0::h::1::SOCKET"\n[simulator]\nseed = 1': "[simulator]: only with [instrument]",
    SIM + "[simulator]\nseed = -1": "[simulator] seed = -1: must be greater than or equal to 0",
    SIM + '[[simulator.terms]]\nterm = "sinus"': "[simulator] terms.0",
    SIM + '[estimator]\nname = "aen"': "[estimator] name = 'aen': did you mean 'aem'?",
    SIM + "[estimator]\nwindow = 3": "window: unknown key; did you mean 'windows'?",
    SIM + "[estimator]\nwindows = [5, 10, 15]": "windows = [5, 10, 15]: must fall",
    SIM + "[estimator]\nsigma_R_V = 0": "[estimator] sigma_R_V = 0: must be greater than or equal to 1e-30",
    SIM + "[estimator]\nsigma_R_V = nan": "[estimator] sigma_R_V",
    SIM + "[scale]\nfactor = 0": "[scale] factor = 0.0: must be finite and not zero",
    SIM + "[recording]\nflush_interval_s = 0": "[recording] flush_interval_s = 0: must be greater",
    SIM + '[recording]\ncompression = "lz5"': '[recording] compression = "lz5": must be',
}


@pytest.mark.parametrize(("text", "says"), BROKEN.items(), ids=lambda value: re.sub(r"\W+", "-", value)[-50:])
def test_a_broken_config_is_refused_in_one_line_that_says_where_and_why(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(text)

    with pytest.raises(ConfigError) as caught:
        load_config(path)

    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert says in message
    assert "\n" not in message


@pytest.mark.parametrize("content", [b"\xff\xfe", None])
def test_a_config_that_is_no_text_or_not_there_is_refused(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    if content is not None:
        path.write_bytes(content)

    with pytest.raises(ConfigError, match=r"bench\.toml: "):
        load_config(path)


@pytest.mark.parametrize("name", ["simulated.toml", "bench.toml"])
def test_the_shipped_configs_load(name: str) -> None:
    config = load_config(CONFIGS / name)

    assert config.driver == "agilent34410"
    assert 1 / config.instrument.interval_s == pytest.approx(14.9, abs=0.01)


def test_the_bench_config_shows_every_key_with_its_default() -> None:
    """Each key of each options class stands in bench.toml, set, or commented out with the default of the class."""
    shown: dict[str, dict[str, object]] = {}
    section = ""
    for line in (CONFIGS / "bench.toml").read_text().splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif re.match(r"#?\w+ = ", line):
            shown.setdefault(section, {}).setdefault(line.lstrip("#").split(" = ")[0], []).append(line)  # type: ignore[attr-defined]
    config = load_config(CONFIGS / "bench.toml")
    options = {
        "instrument": config.instrument,
        "estimator": AemOptions(),
        "scale": Scale(),
        "acquisition": AcquisitionOptions(),
        "recording": RecordingOptions(),
    }

    for name, holder in options.items():
        keys = {field.name: field for field in dataclasses.fields(holder)}
        assert set(keys) == set(shown[name]) - {"driver", "resource", "name"}
        for key, field in keys.items():
            lines = shown[name][key]
            if field.default is not None and lines[0].startswith("#"):  # type: ignore[index]
                value = tomllib.loads(lines[0].lstrip("#"))[key]  # type: ignore[index]
                default = list(field.default) if isinstance(field.default, tuple) else field.default
                assert value == default, key


def test_a_named_estimator_keeps_the_configs_options_if_it_is_that_one() -> None:
    known = EstimatorChoice("aem", AemOptions(delta=0.5))

    assert name_estimator("aem", known) is known
    assert name_estimator("aem").options == AemOptions()
    with pytest.raises(UsageError, match="no such estimator"):
        name_estimator("aen")


def test_an_estimator_reads_back_from_its_text_to_the_same_bits() -> None:
    choice = EstimatorChoice("aem", AemOptions(sigma_R_V=0.1 + 0.2, delta=1 / 3, windows=(30, 20, 10)))

    assert recorded_estimator(Description(estimator=choice.as_text()), "file.mcap") == choice
