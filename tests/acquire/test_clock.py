"""The clock against a simulated instrument whose finishes are known exactly."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from aemd.acquire.clock import DeviceClock

UPTIME_NS = 3_000_000_000_000_000  # a host that has been up for a month
DELAY_S = 0.03


@dataclass
class Instrument:
    """Finishes of readings, and looks at them over a link with random latencies."""

    interval_s: float
    rate: float
    readings: int
    rng: np.random.Generator
    epoch_readings: int = 0
    epoch_pause_s: float = 0.0
    latency_s: float = 200e-6
    spikes_s: float = 5e-3
    finish_ns: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        index = np.arange(self.readings)
        pauses = index // self.epoch_readings if self.epoch_readings else 0
        finish_s = 0.1 + (index + 1) * self.interval_s * (1 + self.rate) + pauses * self.epoch_pause_s
        self.finish_ns = UPTIME_NS + np.rint(finish_s * 1e9).astype(np.int64)

    def looks(self, poll_s: float) -> Iterator[tuple[int, int, int]]:
        """Yield count, asked_ns, answered_ns; one way in a hundred takes a spike more."""
        asked_ns = UPTIME_NS
        while asked_ns < self.finish_ns[-1] - 1_000_000_000:
            there, back = self.rng.exponential(self.latency_s, 2) + self.latency_s / 2
            there += self.spikes_s * (self.rng.random() < 0.01)
            back += self.spikes_s * (self.rng.random() < 0.01)
            counted_ns = asked_ns + int(there * 1e9)
            answered_ns = counted_ns + int(back * 1e9)
            yield int(np.searchsorted(self.finish_ns, counted_ns, side="right")), asked_ns, answered_ns
            asked_ns = max(answered_ns, asked_ns + int(poll_s * 1e9))

    def run(self, clock: DeviceClock, poll_s: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the stamps and the uncertainty that was claimed of each, shape (readings seen,), ns."""
        stamps, uncertainties = [], []
        drained = 0
        for count, asked_ns, answered_ns in self.looks(poll_s):
            clock.observe(count, asked_ns, answered_ns)
            if count > drained:
                stamps.append(clock.stamp(drained, count - drained))
                uncertainties.append(np.full(count - drained, clock.stamped_within_ns))
                drained = count
        return np.concatenate(stamps), np.concatenate(uncertainties)

    def errors_ns(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return stamp minus truth, the truth being the middle of the aperture."""
        return stamps_ns - (self.finish_ns[: stamps_ns.size] - int(DELAY_S * 1e9))


@pytest.mark.parametrize("rate", [-100e-6, 0.0, 100e-6])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_stamps_at_15_hz_are_within_two_milliseconds_and_within_the_claimed_uncertainty(rate: float, seed: int) -> None:
    instrument = Instrument(0.0636401, rate, 6000, np.random.default_rng(seed))
    clock = DeviceClock(0.0636401, DELAY_S)
    stamps_ns, uncertainty_ns = instrument.run(clock, poll_s=0.618 * 0.0636401)
    errors_ns = instrument.errors_ns(stamps_ns)

    assert np.all(np.abs(errors_ns) <= uncertainty_ns + 1)
    assert np.abs(errors_ns[100:]).max() <= 2_000_000
    assert abs(clock.rate - rate) <= clock.rate_uncertainty <= 20e-6
    assert clock.restarts == 0


@pytest.mark.parametrize("rate", [-900e-6, 500e-6])
def test_a_rate_beyond_what_was_assumed_is_noticed_and_then_followed(rate: float) -> None:
    instrument = Instrument(0.0636401, rate, 3000, np.random.default_rng(4))
    clock = DeviceClock(0.0636401, DELAY_S)
    stamps_ns, uncertainty_ns = instrument.run(clock, poll_s=0.618 * 0.0636401)
    errors_ns = instrument.errors_ns(stamps_ns)

    assert 1 <= clock.restarts <= 3  # 200 ppm doubled thrice is more than 900 ppm
    assert abs(clock.rate - rate) <= clock.rate_uncertainty <= 30e-6
    assert np.abs(errors_ns[1500:]).max() <= 2_000_000
    assert np.all(np.abs(errors_ns[1500:]) <= uncertainty_ns[1500:] + 1)


@given(
    interval_s=st.floats(1e-4, 0.5),
    rate=st.floats(-190e-6, 190e-6),
    latency_s=st.floats(1e-6, 0.02),
    poll_s=st.floats(1e-3, 0.3),
    epochs=st.booleans(),
    epoch_pause_s=st.floats(0.0, 0.2),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=100, deadline=None, derandomize=True)
def test_truth_is_within_the_claimed_uncertainty_whatever_the_latencies_and_epochs(
    interval_s: float, rate: float, latency_s: float, poll_s: float, epochs: bool, epoch_pause_s: float, seed: int
) -> None:
    # No look may skip an epoch: an instrument's memory holds no more than one.
    epoch_readings = int((2 * poll_s + 50 * latency_s + 20e-3) / interval_s) + 2
    readings = 4 * epoch_readings + int(1 / interval_s)
    clock = DeviceClock(interval_s, DELAY_S, epoch_readings if epochs else 0)
    instrument = Instrument(
        interval_s,
        rate,
        readings,
        np.random.default_rng(seed),
        epoch_readings if epochs else 0,
        epoch_pause_s,
        latency_s,
    )
    stamps_ns, uncertainty_ns = instrument.run(clock, poll_s)

    assert clock.restarts == 0
    assert np.all(np.diff(stamps_ns) > 0)
    assert np.all(np.abs(instrument.errors_ns(stamps_ns)) <= uncertainty_ns + 2)


@pytest.mark.parametrize("rate", [-100e-6, 100e-6])
def test_looks_aimed_at_the_finish_of_a_reading_find_the_offset_by_halves(rate: float) -> None:
    instrument = Instrument(0.0672, rate, 3000, np.random.default_rng(7), latency_s=200e-6, spikes_s=0.0)
    clock = DeviceClock(instrument.interval_s, DELAY_S)
    asked_ns, looks, unknown_ns = UPTIME_NS, 0, np.inf
    while unknown_ns > 1_000_000:
        count = int(np.searchsorted(instrument.finish_ns, asked_ns + 300_000, side="right"))
        clock.observe(count, asked_ns, asked_ns + 600_000)
        unknown_ns, looks = clock.uncertainty_ns, looks + 1
        asked_ns = clock.next_finish(asked_ns + 1_000_000_000) - 300_000

    # One for the first reading, one for each halving of half an interval down to 1 ms, and one for the rate's drift.
    assert looks <= 2 + np.ceil(np.log2(33.6)) + 1


def test_the_next_finish_is_the_first_one_from_then_on_to_within_the_uncertainty() -> None:
    instrument = Instrument(0.0672, 50e-6, 3000, np.random.default_rng(8))
    clock = DeviceClock(instrument.interval_s, DELAY_S)
    assert clock.next_finish(UPTIME_NS) == UPTIME_NS
    instrument.run(clock, 0.0415)
    last_ns = int(instrument.finish_ns[-20])

    for after_ns in range(last_ns + 2_000_000, last_ns + 67_000_000, 5_000_000):
        error_ns = abs(clock.next_finish(after_ns) - instrument.finish_ns[-19])
        assert error_ns <= clock.uncertainty_ns + 1.4e9 * clock.rate_uncertainty
