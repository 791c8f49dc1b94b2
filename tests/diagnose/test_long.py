"""Long records: first steps on some blocks, the last ones on all readings, and the same answer."""

import numpy as np
import pytest

from aemd.diagnose.climb import Climb, densities, race
from aemd.diagnose.hypothesis import Base, Data, base_box, make_data
from aemd.diagnose.terms.noise import ChangingNoise
from tests.diagnose.counted import Counted
from tests.diagnose.plant import series

N = 60_000


@pytest.fixture(scope="module")
def data() -> Data:
    """White noise, and a drift of which a fifth of an hour holds a few turns."""
    rng = np.random.default_rng(11)
    drift = np.zeros(N)
    for k in range(1, N):
        drift[k] = 0.9995 * drift[k - 1] + 0.02 * rng.standard_normal()
    return make_data(series(1.0 + 1e-3 * (rng.standard_normal(N) + drift)))


def base(data: Data) -> Base:
    start = np.array([np.log(0.1), np.log(0.01), np.log(20.0), np.log(0.3), 0.5, 0.0])
    return Base(start, shocks=False, box=base_box(data))


def test_some_blocks_have_the_likelihood_of_a_record_with_gaps(data):
    """Independent way: the same filter over all readings, those between the blocks missing."""
    few = data.sampled(20, 500)
    term = base(data)
    missing = np.zeros(N, bool)
    missing[few.sample] = True

    assert few.n == 10_000
    assert few.sample is not None
    assert few.sample[-1] == N - 1
    assert few.span_s == data.span_s
    expected = densities([term], term.start, data.only(missing)).sum()
    assert densities([term], term.start, few).sum() == pytest.approx(expected, abs=1e-4)


def test_a_race_over_a_long_record_ends_no_lower_than_a_climb_over_all_readings(data):
    term = base(data)
    alone = Climb([term], term.start, data)
    while not alone.done:
        alone.step()
    (led,) = race([Climb([term], term.start, data)], 15)

    assert led.value > alone.value - 0.5
    assert led.value > Climb([term], term.start, data).value + 100


def test_what_happens_between_the_blocks_is_climbed_to_all_the_same(data):
    """Noise twice as large for 500 readings that no block holds: ln 2 an octave, some 400 nats."""
    sample = data.sampled(20, 500).sample
    begin = int(sample[np.argmax(np.diff(sample))]) + 200
    louder = np.arange(N) // 500 == begin // 500 + 1
    rng = np.random.default_rng(12)
    noisy = make_data(series(1.0 + 1e-3 * rng.standard_normal(N) * np.where(louder, 2.0, 1.0)))
    term = ChangingNoise(float(noisy.t_s[louder][0]), float(noisy.t_s[louder][-1]), 1.1, 0.0)
    known = base(noisy)
    rivals = [Climb([known, term], np.concatenate((known.start, term.start)), noisy)]
    rivals += [Climb([known, kind], np.append(known.start, 0.1), noisy) for kind in (Counted(0.0, "idle"),)]
    best = race(rivals, 15)[0]

    assert best.terms[-1].cause == "changing_noise"
    assert best.theta[-1] == pytest.approx(np.log(2), abs=0.15)


def test_over_all_of_a_long_record_a_start_without_hope_has_two_steps_at_most(data):
    known = base(data)
    kinds = [Counted(0.0, "likely"), *(Counted(1e6, f"hopeless {k}") for k in range(6))]
    race([Climb([known, kind], np.append(known.start, 0.1), data, kind.cost_nats) for kind in kinds], 15)

    passes = known.start.size + 3
    for kind in kinds[1:]:
        assert kind.asked.count(N) <= 2 * (passes + 9) + 3
