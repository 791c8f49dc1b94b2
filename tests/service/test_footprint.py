"""What a service that runs for months takes of the machine: no compiler and no plotting, 150 MB with the page open."""

import json
import subprocess
import sys
from pathlib import Path

from aemd.config import load_config
from aemd.session import simulated

ACQUIRE = r"""
import json, re, sys, threading, urllib.request
from pathlib import Path
from rich.console import Console
from aemd import session
from aemd.config import load_config
from aemd.live.access import Address
from aemd.live.options import LiveOptions
from aemd.live.view import Page

def look():
    with urllib.request.urlopen(page.url + "stream?span_s=60&columns=1300", timeout=60) as stream:
        while line := stream.readline():
            seen.append(line[:5])

seen = []
page = Page(Address(port=0), LiveOptions())
threading.Thread(target=look, daemon=True).start()
found = session.acquire(
    load_config(Path(sys.argv[1])), seconds=2.0, directory=Path(sys.argv[2]), console=Console(stderr=True), views=[page]
)
heavy = [name for name in ("numba", "llvmlite", "scipy", "matplotlib", "pandas", "plotly") if name in sys.modules]
most_kB = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())[1]
print(json.dumps([found.readings, heavy, int(most_kB) / 1024, b"data:" in seen]))
"""


def test_an_acquisition_at_fifteen_a_second_takes_no_compiler_and_less_than_150_mb(tmp_path: Path) -> None:
    config = tmp_path / "meter.toml"
    settings = "nplc = 1.0\nautozero = 'on'\ninterval_s = 0.06712\n"
    config.write_text(f"[instrument]\nresource = 'sim'\n{settings}")
    with simulated(load_config(config)) as resource:
        config.write_text(f"[instrument]\nresource = '{resource}'\n{settings}")
        command = [sys.executable, "-c", ACQUIRE, str(config), str(tmp_path)]
        printed = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout

    readings, heavy, most_MB, is_looked_at = json.loads(printed)

    assert is_looked_at
    assert readings == 30
    assert heavy == []
    assert most_MB < 150
