"""A third party's driver, installed as its own distribution, is found by its entry point and used by `aemd acquire`."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from aemd.record.reader import Recording

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder into which the example is installed, without network and without touching this environment."""
    if importlib.util.find_spec("hatchling") is None:
        pytest.skip("no hatchling to build the example with")
    folder = tmp_path_factory.mktemp("site")
    # The wheel by the back end itself, because an environment may be without pip; a wheel is a zip that is unpacked.
    build = "import hatchling.build as b, sys; print(b.build_wheel(sys.argv[1]))"
    made = subprocess.run([sys.executable, "-c", build, folder], cwd=HERE, capture_output=True, text=True, check=True)
    wheel = folder / made.stdout.split()[-1]
    subprocess.run([sys.executable, "-m", "zipfile", "-e", wheel, folder], check=True)
    wheel.unlink()
    return folder


def run(installed: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(installed), *sys.path[1:]])
    return subprocess.run(
        [sys.executable, "-m", "aemd", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )


def test_it_acquires_into_a_recording_of_its_values(installed: Path, tmp_path: Path) -> None:
    config = tmp_path / "counter.toml"
    config.write_text('[instrument]\ndriver = "example-counter"\nresource = "COUNTER::one"\ninterval_s = 0.005\n')

    done = run(installed, "acquire", config, "--seconds", "1", "--out", tmp_path, "--json")

    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["readings"], found["lost"]) == (200, 0)
    with Recording(Path(found["file"])) as recording:
        values_V = np.concatenate([batch.readings["value_V"] for batch in recording.batches()])
    assert np.array_equal(values_V, 1e-6 * np.arange(200))


def test_its_own_options_and_errors_are_told_as_ours_are(installed: Path, tmp_path: Path) -> None:
    config = tmp_path / "counter.toml"
    config.write_text('[instrument]\ndriver = "example-counter"\nresource = "GPIB0::1"\n')
    wrong = tmp_path / "wrong.toml"
    wrong.write_text('[instrument]\ndriver = "example-counter"\nresource = "COUNTER::one"\nintervall_s = 1.0\n')

    refused, unknown = run(installed, "acquire", config), run(installed, "check-config", wrong)

    assert refused.returncode == 1
    assert "the resource must be COUNTER::name" in refused.stderr
    assert unknown.returncode == 78
    assert "did you mean 'interval_s'" in unknown.stderr


def test_where_it_is_not_installed_the_installed_drivers_are_listed(tmp_path: Path) -> None:
    config = tmp_path / "counter.toml"
    config.write_text('[instrument]\ndriver = "example-counter"\nresource = "COUNTER::one"\n')
    done = run(tmp_path, "check-config", config)

    assert done.returncode == 78
    assert "there are: agilent34410" in done.stderr
