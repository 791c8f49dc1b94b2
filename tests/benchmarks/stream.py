"""10,000 readings/s through the socket: loss, CPU share, memory, latency from the block's receipt to its estimates.

The simulated meter runs in a process of its own, as `aemd sim` does for anyone.
"""

import gc
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
from rich.console import Console

from aemd.block import Batch, Estimates
from aemd.config import load_config
from aemd.session import acquire

SECONDS = 60
METER = """
[instrument]
resource = "{resource}"
range_V = 10.0
aperture_s = 100e-6
autozero = "off"
trigger_delay_s = 0.0
interval_s = 0.0001
display = false
{rest}
"""
SIMULATOR = "[simulator]\nseed = 1\n"
WARM_UP_S = 10.0
"""Not in the memory's growth: by then every buffer has been used once."""


class Watch:
    """A sink right after the estimator: how long ago the batch was received, and what the process uses."""

    def __init__(self) -> None:
        self.latency_ns: list[int] = []
        self.sizes: list[int] = []
        self.memory_bytes: list[tuple[float, int]] = []
        self._process = psutil.Process()
        self._start_s = time.monotonic()
        self.cpu_start = self._process.cpu_times()

    def write(self, batch: Batch, estimates: Estimates) -> None:
        if batch.readings.size:
            self.latency_ns.append(time.monotonic_ns() - batch.received_ns)
            self.sizes.append(batch.readings.size)
        now_s = time.monotonic() - self._start_s
        if not self.memory_bytes or now_s - self.memory_bytes[-1][0] > 1:
            self.memory_bytes.append((now_s, self._process.memory_info().rss))


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        simulator = Path(folder) / "sim.toml"
        simulator.write_text(METER.format(resource="sim", rest=SIMULATOR))
        server = subprocess.Popen(
            [sys.executable, "-m", "aemd", "sim", simulator, "--port", "0"], stdout=subprocess.PIPE, text=True
        )
        try:
            assert server.stdout is not None
            client = Path(folder) / "client.toml"
            client.write_text(METER.format(resource=server.stdout.readline().strip(), rest=""))
            gc.collect()
            watch = Watch()
            started = time.monotonic()
            found = acquire(
                load_config(client),
                seconds=SECONDS,
                directory=Path(folder),
                console=Console(stderr=True),
                watchers=[watch],
            )
            elapsed_s = time.monotonic() - started
            used, served = psutil.Process().cpu_times(), psutil.Process(server.pid).cpu_times()
        finally:
            server.send_signal(signal.SIGINT)
            server.wait()

    share = (used.user + used.system - watch.cpu_start.user - watch.cpu_start.system) / elapsed_s
    simulated = (served.user + served.system) / elapsed_s
    p50, p99, p999 = np.percentile(np.array(watch.latency_ns) * 1e-6, [50, 99, 99.9])
    settled = np.array([size for at, size in watch.memory_bytes if at > WARM_UP_S]) / 2**20
    print(f"stream: {found.readings} readings in {elapsed_s:.1f} s, {found.lost} lost, {found.gaps} gaps")
    print(f"  CPU       {100 * share:.1f} % of a core; the simulated meter {100 * simulated:.1f} %")
    growth = settled[-1] - settled[0]
    print(f"  memory    {settled[-1]:.0f} MB, {growth:+.1f} MB since {WARM_UP_S:.0f} s")
    print(
        f"  latency   p50 {p50:.2f} ms, p99 {p99:.2f} ms, p99.9 {p999:.2f} ms, max {max(watch.latency_ns) * 1e-6:.2f}"
    )
    print(f"  blocks    {len(watch.sizes)}, of {np.median(watch.sizes):.0f} readings in the middle")
