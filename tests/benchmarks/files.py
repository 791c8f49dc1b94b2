"""Writing and reading recordings: ours beside the mcap package's own writer and reader, on the same readings."""

import tempfile
import time
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

from aemd.block import ESTIMATE, Batch, make_block
from aemd.record.description import Description
from aemd.record.reader import Recording
from aemd.record.writer import Recorder

READINGS = 2_000_000
LIBRARY_READINGS = 100_000
BLOCK = 8192


def main() -> None:
    values_V = np.round(np.random.default_rng(1).standard_normal(READINGS), 8)
    block = make_block(values_V, interval_ns=1e5)
    estimates = np.zeros(READINGS, ESTIMATE)
    for name in ("index", "t_ns", "value_V"):
        estimates[name] = block[name]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ours.mcap"
        start = time.perf_counter()
        recorder = Recorder(path, Description(interval_s=1e-4, estimator={"name": "kalman"}))
        for begin in range(0, READINGS, BLOCK):
            recorder.write(Batch(block[begin : begin + BLOCK]), estimates[begin : begin + BLOCK])
        recorder.close()
        write = READINGS / (time.perf_counter() - start)
        start = time.perf_counter()
        with Recording(path) as recording:
            count = sum(batch.readings.size for batch, _ in recording.batches_with_estimates())
        read = READINGS / (time.perf_counter() - start)
        assert count == READINGS
        library_write, library_read = library(Path(folder) / "library.mcap", block)
        size = path.stat().st_size / READINGS
    print(f"files: readings with estimates, two channels, {size:.1f} bytes each")
    print(f"  write  {write / 1e6:7.3f} M readings/s   {write / library_write:6.1f} x the mcap package's writer")
    print(f"  read   {read / 1e6:7.3f} M readings/s   {read / library_read:6.1f} x the mcap package's reader")


def library(path: Path, block: np.ndarray) -> tuple[float, float]:
    """Return readings/s, two messages each, of the mcap package's writer and reader."""
    start = time.perf_counter()
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = [writer.register_channel(topic, "", 0) for topic in ("raw", "filtered")]
        for at, value in zip(block["t_ns"][:LIBRARY_READINGS].tolist(), block["value_V"].tolist(), strict=False):
            for channel in channels:
                writer.add_message(channel, at, np.float64(value).tobytes(), at)
        writer.finish()
    write = LIBRARY_READINGS / (time.perf_counter() - start)
    start = time.perf_counter()
    with path.open("rb") as file:
        count = sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())
    assert count == 2 * LIBRARY_READINGS
    return write, LIBRARY_READINGS / (time.perf_counter() - start)
