"""The USB path through real libusb: listed, opened, streamed, timed out, cleared, unplugged, plugged in again."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
PRELOAD = "libumockdev-preload.so.0"
IDENTITY = "Agilent Technologies,34410A,MY47006594,2.35-2.35-0.09-46-09"


def why_not() -> str:
    """Return what is missing; empty when nothing is."""
    if shutil.which("umockdev-wrapper") is None:
        return "umockdev is not installed (Debian: umockdev, gir1.2-umockdev-1.0, python3-gi)"
    look = (
        "import sys; sys.path.append('/usr/lib/python3/dist-packages'); import gi;"
        "gi.require_version('UMockdev', '1.0'); from gi.repository import UMockdev"
    )
    tried = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, timeout=60, check=False)
    if tried.returncode:
        return f"this Python cannot use umockdev: {tried.stderr.strip().splitlines()[-1]}"
    look = "import usb.backend.libusb1 as one; assert one.get_backend()"
    if subprocess.run([sys.executable, "-c", look], capture_output=True, timeout=60, check=False).returncode:
        return "libusb is not installed (Debian: libusb-1.0-0)"
    return ""


@pytest.fixture(scope="module")
def found() -> dict[str, object]:
    if why := why_not():
        pytest.skip(why)
    # The bus is preloaded as well: without it, umockdev looks for the device that it announces in the real /sys.
    done = subprocess.run(
        [sys.executable, HERE / "usb_bus.py", HERE / "usb_client.py"],
        env={**os.environ, "LD_PRELOAD": PRELOAD},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_it_is_listed_and_identified(found):
    assert found["listed"] == ["USB0::2391::1543::MY47006594::0::INSTR"]
    assert found["identity"] == IDENTITY


def test_a_timeout_costs_its_own_length_and_leaves_question_and_answer_in_step(found):
    assert found["timeout"]
    assert 0.9 < found["timeout_s"] < 3.0  # 1 s; 5 s more if the abort of the transfer were not answered
    assert found["after the timeout"] == f'-420,"Query UNTERMINATED";{IDENTITY}'


def test_it_streams_more_than_a_memory_without_a_loss(found):
    assert found["readings"] > 5 * 20_000 > 50_000
    assert found["overflow or violation"] == "+0"
    assert found["finite"]


def test_a_clear_throws_an_unread_answer_away(found):
    assert found["after the clear"] == "1994.0"


def test_unplugged_it_is_one_clear_error_and_plugged_in_again_it_opens(found):
    assert "no such device" in found["unplugged"]
    assert "No device found" in found["while it is gone"]
    assert found["listed again"] == found["listed"]
    assert found["plugged in again"] == IDENTITY
