"""What all tests share: how hypothesis draws, and where measured logs are found."""

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("aemd", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("aemd")

# What started us may ignore these (nohup, a job in the background), and every process that a test starts would, too.
for _number, _usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _usual)


@pytest.fixture(scope="session")
def measured(pytestconfig: pytest.Config) -> Path:
    """Folder of measured logs (not part of the project): $AEMD_MEASURED, else shared/measured beside the checkout."""
    stated = os.environ.get("AEMD_MEASURED")
    folder = Path(stated) if stated else pytestconfig.rootpath.parent / "shared" / "measured"
    if not folder.is_dir():
        pytest.skip("no measured logs: set AEMD_MEASURED to their folder")
    return folder


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 8 MiB of its own."""
    if os.geteuid() != 0:
        pytest.skip("needs root: mounts a small tmpfs")
    folder = tmp_path / "disk"
    folder.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(folder)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"cannot mount a small tmpfs here: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)
