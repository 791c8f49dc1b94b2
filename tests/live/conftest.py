"""A feed that a test fills by hand, on a clock that the test moves."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aemd.block import ESTIMATE, Batch, make_block
from aemd.live.feed import About, Feed
from aemd.live.health import Sources
from aemd.live.inbox import Inbox
from aemd.record.counts import Counts

T0_NS = 1_795_345_851_596_318_191
INTERVAL_NS = 67_120_000


class Bench:
    """Readings in, frames out."""

    def __init__(self, file: Path) -> None:
        self.now_ns = 10**12
        self.inbox = Inbox()
        self.counts = Counts(0)
        self.unwritten = self.not_written = 0
        self.trouble = ""
        about = About("34410A MY1", "sim", "aem", INTERVAL_NS * 1e-9, resolution_V=1e-6)
        sources = Sources(
            self.counts, lambda: self.unwritten, lambda: file, lambda: self.not_written, lambda: self.trouble
        )
        self.feed = Feed(self.inbox, about, sources, clock=lambda: self.now_ns, utc=lambda: T0_NS)

    def read(self, values: list[float], *, tick: bool = True) -> None:
        """Let these readings come, one interval after the other, with estimates equal to half of them."""
        first = self.counts.next_index
        block = make_block(values, first_index=first, t0_ns=T0_NS + first * INTERVAL_NS, interval_ns=float(INTERVAL_NS))
        estimates = np.zeros(block.size, ESTIMATE)
        estimates["index"], estimates["t_ns"] = block["index"], block["t_ns"]
        estimates["value_V"], estimates["sigma_V"] = 0.5 * block["value_V"], 1e-3
        estimates["window"] = 15
        self.counts.add(Batch(block), estimates)
        self.inbox.write(Batch(block), estimates)
        self.now_ns += block.size * INTERVAL_NS
        if tick:
            self.feed.tick()


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    file = tmp_path / "aemd.mcap.active"
    file.write_bytes(b"x" * 123)
    return Bench(file)


@pytest.fixture
def make_bench(tmp_path: Path) -> Callable[[], Bench]:
    return lambda: Bench(tmp_path / "aemd.mcap.active")
