"""The live page's price: 8 viewers at 10,000 readings/s beside none; the idle process at 15 Hz; the start.

The simulated meter and the viewers run in processes of their own, as a bench's meter and a user's browser do. Viewers
read the page's stream, which is all that a browser asks for while the page is open. What they take of the processors
themselves is no fault of the page: so a third case has as many of them read as much from another program.
"""

import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

import numpy as np
import psutil
from rich.console import Console

from aemd.config import load_config
from aemd.live.access import Address
from aemd.live.options import LiveOptions
from aemd.live.view import Page
from aemd.session import AcquireSummary, acquire
from tests.benchmarks.stream import METER, SIMULATOR, Watch

VIEWERS = 8
ROUND_S = 15.0
ROUNDS = 3
"""Of each, in turns, so that what else the machine does falls on both."""
SETTLE_S = 5.0
IDLE_S = 30.0
BENCH_METER = '[instrument]\nresource = "{resource}"\nnplc = 1.0\nautozero = "on"\ninterval_s = 0.06712\n'

VIEWER = """
import sys, threading, urllib.request
def read(number):
    span = (5, 60, 600, 3600)[number % 4]
    with urllib.request.urlopen(sys.argv[1] + f"stream?span_s={span}&columns=1300") as stream:
        while stream.readline():
            pass
threads = [threading.Thread(target=read, args=(number,)) for number in range(int(sys.argv[2]))]
[thread.start() for thread in threads]
"""

FRAME_BYTES = {5: 5900, 60: 1200, 600: 900, 3600: 900}
"""What the page sends ten times a second, by the span that is shown."""
OTHER = """
import re, socket, sys, threading, time
sizes = dict(zip((5, 60, 600, 3600), map(int, sys.argv[1:])))
listening, viewers = socket.create_server(("127.0.0.1", 0)), []
print(f"http://127.0.0.1:{listening.getsockname()[1]}/", flush=True)
def welcome():
    while True:
        viewer = listening.accept()[0]
        span_s = int(re.search(rb"span_s=([0-9]+)", viewer.recv(4096))[1])
        viewer.sendall(b"HTTP/1.1 200 OK\\r\\nContent-Type: text/event-stream\\r\\nConnection: close\\r\\n\\r\\n")
        viewers.append((viewer, b"data: " + b"1" * sizes[span_s] + b"\\n\\n"))
threading.Thread(target=welcome, daemon=True).start()
while True:
    time.sleep(0.1)
    for viewer, frame in viewers:
        viewer.sendall(frame)
"""

FIRST_READING = """
import sys, time
from pathlib import Path
from rich.console import Console
import agilent34410, aemd.session
from aemd.config import load_config
class First:
    def write(self, batch, estimates):
        if batch.readings.size and not seen:
            seen.append(time.monotonic())
seen, config, began = [], load_config(Path(sys.argv[1])), time.monotonic()
aemd.session.acquire(config, seconds=0.5, directory=Path(sys.argv[2]), console=Console(stderr=True), watchers=[First()])
print(seen[0] - began)
"""


@contextmanager
def served(config: str, folder: Path) -> Iterator[str]:
    """Serve the simulated meter from a process of its own."""
    path = folder / "sim.toml"
    path.write_text(config)
    command = [sys.executable, "-m", "aemd", "sim", path, "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        try:
            yield server.stdout.readline().strip()
        finally:
            server.send_signal(signal.SIGINT)


@contextmanager
def viewed(url: str, viewers: int) -> Iterator[None]:
    """Let so many viewers read the stream."""
    if not viewers:
        yield
        return
    with subprocess.Popen([sys.executable, "-c", VIEWER, url, str(viewers)], stderr=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.kill()


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        compare_viewers(folder)
        measure_start(folder)
        measure_idle(folder)


@contextmanager
def viewed_elsewhere(viewers: int) -> Iterator[None]:
    """Let so many viewers read as much from another program as they would from the page."""
    command = [sys.executable, "-c", OTHER, *map(str, FRAME_BYTES.values())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        try:
            with viewed(other.stdout.readline().strip(), viewers):
                yield
        finally:
            other.kill()


def compare_viewers(folder: Path) -> None:
    """Acquire 10,000 readings/s without viewers, with them, and beside as many of another program, in turns."""
    cases = ("no viewers", f"{VIEWERS} viewers", f"{VIEWERS} of another program")
    latency_ms: dict[str, list[float]] = {case: [] for case in cases}
    lost, cpu = dict.fromkeys(cases, 0), dict.fromkeys(cases, 0.0)
    with served(METER.format(resource="sim", rest=SIMULATOR), folder) as resource:
        client = folder / "client.toml"
        client.write_text(METER.format(resource=resource, rest=""))
        for case in ROUNDS * cases:
            with viewed_elsewhere(VIEWERS) if case == cases[2] else nullcontext():
                found, watch, used_s = acquire_viewed(client, folder, VIEWERS if case == cases[1] else 0)
            latency_ms[case] += [ns * 1e-6 for ns in watch.latency_ns]
            lost[case] += found.lost
            cpu[case] += used_s
    print(f"live: {ROUNDS} x {ROUND_S:.0f} s of each at 10,000 readings/s, in turns")
    p999 = {}
    for case, values in latency_ms.items():
        p50, p99, p999[case] = np.percentile(values, [50, 99, 99.9])
        share = 100 * cpu[case] / (ROUNDS * ROUND_S)
        print(
            f"  {case:20} lost {lost[case]}, latency p50 {p50:.2f} ms, p99 {p99:.2f} ms,"
            f" p99.9 {p999[case]:.2f} ms, CPU {share:.1f} % of a core"
        )
    without, viewed_here, viewed_there = p999.values()
    print(
        f"  p99.9 with / without viewers: {viewed_here / without:.2f}; of another program: {viewed_there / without:.2f}"
    )


def acquire_viewed(config: Path, folder: Path, viewers: int) -> tuple[AcquireSummary, Watch, float]:
    """Acquire for a round; return what was found, the latencies, and the processor time used, s."""
    pages = [Page(Address(port=0), LiveOptions())] if viewers else []
    with viewed(pages[0].url if pages else "", viewers):
        watch, before = Watch(), time.process_time()
        found = acquire(
            load_config(config),
            seconds=ROUND_S,
            directory=folder,
            console=Console(stderr=True),
            watchers=[watch],
            views=pages,
        )
    return found, watch, time.process_time() - before


def measure_start(folder: Path) -> None:
    """Say how long it takes from the imports to the first reading at the recorder, without and with a compiler."""
    with served(METER.format(resource="sim", rest=SIMULATOR), folder) as resource:
        client = folder / "first.toml"
        for rate, config in (
            ("15", BENCH_METER.format(resource=resource)),
            ("10,000", METER.format(resource=resource, rest="")),
        ):
            client.write_text(config)
            command = [sys.executable, "-c", FIRST_READING, str(client), str(folder)]
            took_s = [
                float(subprocess.run(command, check=True, capture_output=True, text=True).stdout) for _ in range(ROUNDS)
            ]
            took = ", ".join(f"{s:.2f}" for s in took_s)
            print(f"start to the first of {rate} readings/s, imports not counted: {took} s")


def measure_idle(folder: Path) -> None:
    """Say what the process costs at 15 Hz, without a page, and with the page open."""
    with served('[instrument]\nresource = "sim"\n' + SIMULATOR, folder) as resource:
        client = folder / "idle.toml"
        client.write_text(BENCH_METER.format(resource=resource))
        for viewers in (0, 1):
            command = [sys.executable, "-m", "aemd", "acquire", client, "--out", folder, "--live", "127.0.0.1:0"]
            with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
                assert process.stderr is not None
                url = next(line for line in process.stderr if line.startswith("live=")).removeprefix("live=").strip()
                with viewed(url, viewers):
                    report_idle(psutil.Process(process.pid), viewers)
                process.send_signal(signal.SIGINT)
                process.stderr.read()


def report_idle(process: psutil.Process, viewers: int) -> None:
    """Print processor and memory of a process over some time."""
    time.sleep(SETTLE_S)
    before, began = process.cpu_times(), time.monotonic()
    time.sleep(IDLE_S)
    after = process.cpu_times()
    share = 100 * (after.user + after.system - before.user - before.system) / (time.monotonic() - began)
    memory = process.memory_full_info()
    compiler_kB = 0
    with suppress(OSError):
        text = Path(f"/proc/{process.pid}/smaps").read_text()
        compiler_kB = sum(map(int, re.findall(r"libllvmlite[^\n]*\n(?:[A-Z][^\n]*\n)*?Rss: +(\d+) kB", text)))
    print(
        f"idle at 15 Hz, page open in {viewers} browsers: CPU {share:.2f} % of a core, memory"
        f" {memory.rss / 2**20:.0f} MB resident, {memory.uss / 2**20:.0f} MB of it private,"
        f" {compiler_kB / 1024:.0f} MB the compiler's file"
    )
