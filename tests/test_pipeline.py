"""The one loop delivers everything in order, and its tally counts what came."""

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from aemd.block import ESTIMATE, READING, Batch, Block, Estimates, Status, make_block
from aemd.errors import InstrumentError
from aemd.estimate.registry import make_estimator
from aemd.pipeline import Spread, Tally, run


class Trailing:
    """An estimator that echoes each reading a fixed number of readings later."""

    name = "trailing"

    def __init__(self, lag: int) -> None:
        self.lag = lag
        self._held = np.empty(0, READING)

    def push(self, block: Block) -> Estimates:
        self._held = np.concatenate([self._held, block])
        count = max(0, self._held.size - self.lag)
        ready, self._held = self._held[:count], self._held[count:]
        return self._echo(ready)

    def flush(self) -> Estimates:
        return self._echo(self._held)

    @staticmethod
    def _echo(readings: Block) -> Estimates:
        estimates = np.zeros(readings.size, ESTIMATE)
        for name in ("index", "t_ns", "value_V"):
            estimates[name] = readings[name]
        return estimates


class Keeping:
    def __init__(self) -> None:
        self.readings: list[Block] = []
        self.estimates: list[Estimates] = []

    def write(self, batch: Batch, estimates: Estimates) -> None:
        self.readings.append(batch.readings)
        self.estimates.append(estimates)


def blocks(count: int, size: int) -> Iterator[Batch]:
    whole = make_block(np.arange(count, dtype=np.float64), interval_ns=1e7)
    for start in range(0, count, size):
        yield Batch(whole[start : start + size])


@pytest.mark.parametrize("lag", [0, 1, 7, 100])
def test_every_reading_gets_its_estimate_whatever_the_lag(lag: int) -> None:
    sink = Keeping()

    run(blocks(50, 8), Trailing(lag), [sink])

    assert np.concatenate(sink.readings)["index"].tolist() == list(range(50))
    assert np.concatenate(sink.estimates)["index"].tolist() == list(range(50))


def test_an_instrument_that_fails_loses_nothing_of_what_came_before() -> None:
    def failing() -> Iterator[Batch]:
        yield from blocks(20, 8)
        raise InstrumentError("the cable is out")

    sink = Keeping()

    with pytest.raises(InstrumentError, match="the cable is out"):
        run(failing(), Trailing(5), [sink])

    assert np.concatenate(sink.estimates)["index"].tolist() == list(range(20))


@pytest.mark.parametrize("name", ["aem", "kalman"])
def test_a_real_estimator_gives_the_same_bits_however_the_stream_is_cut(name: str) -> None:
    outputs = []
    for size in (1, 7, 500):
        sink = Keeping()
        run(blocks(500, size), make_estimator(name, {}, 0.01), [sink])
        outputs.append(np.concatenate(sink.estimates).tobytes())

    assert outputs[0] == outputs[1] == outputs[2]


@given(st.lists(hnp.arrays(np.float64, st.integers(0, 20), elements=st.floats(-1e3, 1e3)), max_size=8))
def test_the_spread_of_parts_is_the_spread_of_the_whole(parts: list[np.ndarray]) -> None:
    spread = Spread()
    for part in parts:
        spread.add(part)

    whole = np.concatenate([*parts, np.empty(0)])
    assert spread.count == whole.size
    if whole.size:
        assert spread.variance == pytest.approx(np.var(whole), rel=1e-9, abs=1e-9)
    else:
        assert spread.variance is None


def test_the_tally_counts_gaps_and_leaves_out_what_is_no_value() -> None:
    block = make_block([1.0, 2.0, np.nan, 3.0], interval_ns=1e9)
    block["index"] = [0, 1, 5, 6]
    block["status"][2] = Status.OVERLOAD_HIGH
    tally = Tally()

    tally.write(Batch(block), np.empty(0, ESTIMATE))

    assert (tally.counts.readings, tally.counts.gaps, tally.counts.lost) == (4, 1, 3)
    assert tally.raw.variance == pytest.approx(2 / 3)  # of 1, 2, 3


@pytest.mark.parametrize("length", [1, 3, 100])
def test_a_gap_takes_nothing_from_the_rate_at_which_was_read(length: int) -> None:
    block = make_block(np.zeros(100), interval_ns=1e9)
    block["index"][50:] += 1000
    block["t_ns"][50:] += 5_000_000_000_000  # a loss that was counted wrong, on top
    tally = Tally()
    for at in range(0, 100, length):
        tally.write(Batch(block[at : at + length]), np.empty(0, ESTIMATE))

    assert tally.rate_hz == pytest.approx(1.0)
    assert tally.duration_s == pytest.approx(99 + 5000)
