"""The fit of the base ends at the top: never far below the likelihood at the parameters that made the record."""

from math import log, sqrt

import numpy as np
import pytest
from scipy.signal import lfilter

from aemd.diagnose.climb import Climb, race, score_log_likelihood
from aemd.diagnose.fit import fit_base
from aemd.diagnose.hypothesis import Base, Data, base_box, make_data
from tests.diagnose.plant import INTERVAL_S, markov, series

FAST_SEEDS = range(200, 216)
SLOW_SEEDS = range(120)
NO_SHOCKS_NATS = 7.0
"""Log-likelihood that shocks must bring, or a step in their place cost, before the fit claims them."""


def drawn(seed: int, longest: int) -> tuple[Data, np.ndarray]:
    """Return a record of the base model and the free numbers that made it; four kinds in turn.

    Without shocks; with some; with loud and frequent ones; and few readings with extreme time constants and noise, a
    twentieth of them lost.
    """
    rng = np.random.default_rng([77, seed])
    kind = seed % 4
    n = int(rng.choice([size for size in (500, 1000, 2000, 5000, 10_000, 20_000) if size <= longest]))
    tau_s, drift_tau_s = 10 ** rng.uniform(-1, 0.7), 10 ** rng.uniform(1.5, 3.0)
    drift_rate = 10 ** rng.uniform(-0.5, 0.5) * sqrt(2 / drift_tau_s)
    white, decay_s, lost = 10 ** rng.uniform(-1, 0.5), 10 ** rng.uniform(-1.3, 0), 0.0
    per_s, size = 0.0, 0.0
    if kind == 1:
        per_s, size = rng.uniform(0.3, 3) / 60, rng.uniform(4, 12)
    elif kind == 2:
        per_s, size = rng.uniform(3, 30) / 60, rng.uniform(5, 30)
    elif kind == 3:
        per_s, size, n, lost = 0.1, 20.0, int(rng.choice([500, 1000, 2000])), 0.05
        tau_s, white = float(rng.choice([0.1, 5.0])), float(rng.choice([0.1, 3.0]))
    y = markov(rng, n, tau_s, 1.0) + markov(rng, n, drift_tau_s, drift_rate * sqrt(drift_tau_s / 2))
    y += white * rng.standard_normal(n)
    jumps = (rng.random(n) < 1 - np.exp(-per_s * INTERVAL_S)) * size * rng.standard_normal(n)
    jumps[0] = 0.0
    y += lfilter([1], [1, -np.exp(-INTERVAL_S / decay_s)], jumps)
    level = rng.uniform(-100, 100)
    kept = np.flatnonzero(np.concatenate(([True], rng.random(n - 1) >= lost)))
    data = make_data(
        series(1e-3 * (y[kept] + level), time_s=kept * INTERVAL_S, index=kept, status=np.zeros(kept.size, np.uint32))
    )
    unit = data.unit_V * 1e3
    true = [
        *(log(tau_s), log(sqrt(2 / tau_s) / unit), log(drift_tau_s), log(drift_rate / unit), log(white / unit)),
        (1e-3 * level - data.origin_V) / data.unit_V,
    ]
    return data, np.array(true + ([log(per_s), log(size / unit), log(decay_s)] if per_s else []))


def assert_at_the_top(seed: int, longest: int) -> None:
    data, true = drawn(seed, longest)
    at_truth = score_log_likelihood([Base(true, shocks=true.size > 6, box=base_box(data))], true, data)
    fit = fit_base(data)
    missed = NO_SHOCKS_NATS if true.size > 6 and not fit.base.shocks else 1.0

    assert fit.log_likelihood > at_truth - missed


@pytest.mark.parametrize("seed", FAST_SEEDS)
def test_a_fit_is_as_likely_as_the_truth_also_with_loud_frequent_shocks_and_gaps(seed):
    assert_at_the_top(seed, 2_000)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SLOW_SEEDS)
def test_a_fit_is_as_likely_as_the_truth_at_every_length(seed):
    assert_at_the_top(seed, 20_000)


def test_a_record_whose_first_readings_hide_its_drift_is_fitted_to_the_top_all_the_same():
    """Seeds of long records whose first 5,000 readings are explained without one of the processes."""
    for seed in (162, 306):
        assert_at_the_top(seed, 20_000)


def test_a_weak_drift_beside_a_strong_signal_is_not_left_out():
    """The signal alone explains such a record nearly as well, and a climb that has lost the drift finds it no more."""
    n, white = 6_000, 0.4
    for seed in (33, 86):
        rng = np.random.default_rng(seed)
        y = markov(rng, n, 0.5, 1.0) + markov(rng, n, 400.0, 0.3) + white * rng.standard_normal(n)
        data = make_data(series(1e-3 * y))
        unit = data.unit_V * 1e3
        true = np.array([log(0.5), log(2 / unit), log(400), log(0.3 * sqrt(2 / 400) / unit), log(white / unit), 0.0])
        true[5] = -data.origin_V / data.unit_V
        at_truth = score_log_likelihood([Base(true, shocks=False, box=base_box(data))], true, data)

        assert fit_base(data).log_likelihood > at_truth


def test_shocks_that_all_come_late_are_in_the_base():
    """A record is fitted to its first 5,000 readings first, and among these is none."""
    n, rng = 6_000, np.random.default_rng(28)
    y = markov(rng, n, 0.74, 1.0) + 0.94 * rng.standard_normal(n)
    for at, size in ((5_340, -7.3), (5_950, -10.0)):
        y[at:] += size * np.exp(-np.arange(n - at))

    assert fit_base(make_data(series(1.0 + 1e-3 * y))).base.shocks


def test_climbs_that_meet_go_on_as_one_and_the_best_comes_first():
    data, true = drawn(1, 1_000)
    term = Base(true, shocks=True, box=(*fit_base(data).base.box[:6], (-9.0, 2.0), (-1.0, 9.0), (-5.0, 2.0)))
    aside = true + 0.1 * np.random.default_rng(3).standard_normal((3, true.size))
    ranked = race([Climb([term], theta, data) for theta in (true, *aside)], 40)

    assert len(ranked) == 1
    assert ranked[0].value >= score_log_likelihood([term], true, data)


@pytest.mark.parametrize("times_the_signal", [5.0, 20.0, 50.0])
def test_a_step_of_any_size_is_no_shock_that_never_fades(times_the_signal):
    """The base without shocks is kept, for the search of steps to find it."""
    rng = np.random.default_rng(1)
    y = markov(rng, 1_500, 1.0, 1.0) + markov(rng, 1_500, 100.0, 1.0) + 0.5 * rng.standard_normal(1_500)
    y[700:] += times_the_signal

    assert not fit_base(make_data(series(1e-2 * y))).base.shocks


def test_a_step_among_quick_shocks_does_not_draw_their_decay_out():
    """As if all of them hardly faded; the search of steps has it to find then."""
    n, rng = 6_000, np.random.default_rng(9)
    y = markov(rng, n, 0.3, 0.7) + markov(rng, n, 130.0, 0.3) + 0.8 * rng.standard_normal(n)
    y += np.where(rng.random(n) < 7 / n, 4.0 * rng.standard_normal(n), 0.0)
    y[2_700:] += 4.6
    base = fit_base(make_data(series(1e-2 * y))).base

    assert base.shocks
    assert base.start[8] < np.log(0.5)
