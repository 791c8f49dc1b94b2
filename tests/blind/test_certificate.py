"""The certificates of a changed mean: what shocks and losses take of it, against the dense covariance."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.optimize import minimize

from tests.blind.certificate import clairvoyant_d95, d_nats, edge_of_range
from tests.blind.envelope import beside_each_other
from tests.blind.gaussian import disturbances, energy, numbers
from tests.blind.injector import calm, template
from tests.blind.instants import cost_of_instants, ringing, wave
from tests.blind.jumps import log_density
from tests.blind.made import USUAL
from tests.blind.plant import Effect, Run, add_shock, make_world
from tests.blind.tails import GRID, Law, energy_taken, seen_marks, tails_laws, tails_nats

PLANT = replace(USUAL, n=300)


def test_shocks_at_known_instants_and_lost_readings_are_part_of_the_covariance():
    plant = replace(PLANT, shocks_per_s=0.3, shock_sd_V=3e-3, shock_decay_s=0.2, lost_fraction=0.1)
    run = Run(plant, seed=11)
    world, theta = make_world(run), numbers(plant)
    lag = np.abs(np.subtract.outer(np.arange(plant.n), np.arange(plant.n))) * plant.interval_s
    covariance = np.exp(theta[0] - lag / np.exp(theta[1])) + np.exp(theta[2] - lag / np.exp(theta[3]))
    covariance += np.exp(theta[4]) * np.eye(plant.n)
    for at_s, _ in world.shocks:
        shock = np.zeros(world.t.size)
        add_shock(world, shock, at_s, plant.shock_sd_V)
        column = world.read(shock)
        covariance += np.outer(column, column)
    kept = ~(world.rng("lost").random(plant.n) < plant.lost_fraction)
    mean = np.cos(2.0 * np.arange(plant.n)) + (np.arange(plant.n) > 150)
    inverse = np.linalg.inv(covariance[np.ix_(kept, kept)])
    a, b = mean[kept], np.ones(int(kept.sum()))

    expected = a @ inverse @ a - (a @ inverse @ b) ** 2 / (b @ inverse @ b)
    assert len(world.shocks) > 3
    assert kept.sum() < plant.n
    assert energy(theta, plant, mean, disturbances(run)) == pytest.approx(expected, rel=5e-3)
    assert energy(theta, plant, mean) > 1.05 * expected


def test_without_shocks_and_losses_nothing_else_happens():
    beside, theta = disturbances(Run(PLANT, seed=3)), numbers(PLANT)
    mean = np.sin(0.7 * np.arange(PLANT.n))

    assert beside.kept.all()
    assert not beside.mark_var.any()
    assert energy(theta, PLANT, mean, beside) == pytest.approx(energy(theta, PLANT, mean), rel=1e-12)


def test_a_bend_of_white_readings_is_known_by_their_skewness():
    """6 b s of skewness, whose score has the variance 6/n: a D of 3 n b^2 s^2, a third of it in the mean of x^2."""
    plant = replace(PLANT, n=3000, signal_sd_V=1e-9, drift_rate_V_per_rt_s=1e-12, level_V=0.0)
    bend = 0.05 / plant.white_sd_V

    expected = 3 * plant.n * 0.05**2
    assert d_nats(Run(plant, seed=2), Effect("nonlinearity", bend)) == pytest.approx(expected, rel=0.1)


def test_a_slow_decay_is_taken_by_a_drift_that_becomes_a_random_walk():
    plant = replace(
        PLANT,
        n=5000,
        interval_s=0.06712,
        signal_sd_V=1e-3,
        signal_tau_s=1.98,
        drift_tau_s=68.0,
        drift_rate_V_per_rt_s=0.82e-3 / np.sqrt(34.0),
        white_sd_V=0.32e-3,
    )
    run, effect = Run(plant, seed=5), Effect("warmup_drift", 6e-3, {"tau_s": 100.0})
    plain = energy(numbers(plant), plant, effect.size * template(run, effect)) / 2
    wandering = numbers(plant) + np.array([0.0, 0.0, 4.0, 4.0, 0.0])  # of the same speed, forgotten 55 times later
    left = energy(wandering, plant, effect.size * template(run, effect)) / 2

    assert left < 0.6 * plain
    assert d_nats(run, effect) < left + 3


def test_who_does_not_know_when_shocks_came_knows_less_of_a_fast_wave_after_them():
    plant = replace(PLANT, n=600, shocks_per_s=0.3, shock_sd_V=9e-3, shock_decay_s=0.3)
    run = Run(plant, seed=11)
    fast, slow = (Effect("ring_down", 1.0, {"frequency_hz": hz, "decay_s": 1.0}) for hz in (6.0, 1.0))
    beside = disturbances(run)
    own = ringing(run, fast, beside)[0]
    waves = sum(wave(plant, fast, time_s, size_V) for time_s, size_V in make_world(run).shocks)

    assert waves == pytest.approx(template(run, fast), abs=2e-2 * np.abs(template(run, fast)).max())
    assert own.size > 5
    assert cost_of_instants(own, np.tile(own[:, None], 8), np.tile(own[:, None], 8), 0.1) == pytest.approx(0, abs=1e-9)
    costs = [cost_of_instants(*ringing(run, effect, beside), 0.1) for effect in (slow, fast)]
    assert 0 < costs[0] < costs[1] < 0.1**2 * own.sum() / 2


WHITE = replace(PLANT, n=2000, signal_sd_V=1e-9, drift_rate_V_per_rt_s=1e-12)


@pytest.mark.parametrize("d", [1.5, 12.0, 24.0])
def test_of_a_gaussian_ratio_the_d_that_is_found_as_often_is_its_own(d):
    """A shift by a of each of n normal readings x has the ratio a x - a^2/2, and a D of n a^2/2."""
    shift = np.sqrt(2 * d / 5000)
    share = np.exp(-((GRID - shift) ** 2) / 2) * np.gradient(GRID)
    law = Law(shift * GRID - shift**2 / 2, share / share.sum(), 5000, 0.0)

    assert law.nats(1e-4) == pytest.approx(d, rel=0.03)


def test_the_laws_of_tails_and_of_what_imitates_them_are_both_laws():
    """Where both densities are whole, the mean of one over the other is 1."""
    shaken = replace(WHITE, n=9000, shocks_per_s=0.05, shock_sd_V=20 * WHITE.white_sd_V, shock_decay_s=0.3)
    calm, shaken, effect = Run(replace(WHITE, n=9000), 4), Run(shaken, 4), Effect("heavy_tails", 0.5)

    for law in (*tails_laws(calm, effect), *tails_laws(shaken, effect)):
        assert law.share @ np.exp(-law.each) == pytest.approx(1, abs=1e-2)  # by nine nodes
    # one law of shocks cannot be both
    assert tails_nats(shaken, effect, 1e-4) > 2 * tails_nats(calm, effect, 1e-4)


def test_a_slow_shock_is_met_by_fast_ones_in_succession():
    """In white noise, of a mark that fades by f each reading, k readings hold the sum of the first k powers of f^2."""
    w = 2 * np.pi * np.arange(1, 5000) / 10_000
    slow = 1 / (1 - 0.8 * np.exp(-1j * w))
    steps = 0.64 ** np.arange(4)

    assert energy_taken(np.ones_like(slow), slow, np.ones(w.size), w) == pytest.approx(np.cumsum(steps), rel=2e-3)
    assert energy_taken(slow, slow, np.ones(w.size), w) == pytest.approx(np.full(4, 1 / 0.36), rel=2e-3)


def test_a_shock_has_faded_by_the_time_a_reading_sees_it():
    plant = replace(PLANT, n=9000, shocks_per_s=0.5, shock_sd_V=1.0, shock_decay_s=0.5 * PLANT.interval_s)
    run = Run(plant, 4)

    drawn = np.array([mark_V for _, mark_V in make_world(run).shocks])
    left = np.abs(seen_marks(run)).sum() / np.abs(drawn).sum()
    inside = plant.inside * plant.step_s / plant.interval_s  # the aperture's part, in which it has not

    assert left == pytest.approx(inside + 0.5 * -np.expm1(-2 * (1 - inside)), rel=0.1)


@pytest.mark.parametrize(("jump", "struck"), [(0.15, 0.0), (0.0, 0.2)])
def test_all_histories_together_are_as_likely_as_their_sum(jump, struck):
    n, mark_sd, fade = 7, 2.0, 0.7
    theta, rng = numbers(PLANT), np.random.default_rng(8)
    theta[[0, 2, 4]] -= 2 * np.log(PLANT.signal_sd_V)
    lag = np.subtract.outer(np.arange(n), np.arange(n))
    late = np.abs(lag) * PLANT.interval_s
    covariance = np.exp(theta[0] - late / np.exp(theta[1])) + np.exp(theta[2] - late / np.exp(theta[3]))
    covariance += np.exp(theta[4]) * np.eye(n)
    size = 1.3 * np.sqrt(covariance[0, 0]) if jump else 0.0
    y = 1.5 * np.array([0, 0, 0, 1, 1, 0, 0]) + np.linalg.cholesky(covariance) @ rng.standard_normal(n)

    def density(history):
        marks = mark_sd * np.where(lag >= 0, fade ** np.maximum(lag, 0), 0.0) * history
        changes = np.count_nonzero(np.diff(history))
        whole = covariance + (marks @ marks.T if struck else 0.0)
        left = y - size * history
        prior = 0.5 * jump**changes * (1 - jump) ** (n - 1 - changes)
        if struck:
            prior = struck ** history.sum() * (1 - struck) ** (n - history.sum())
        return prior * np.exp(-left @ np.linalg.solve(whole, left) / 2) / np.sqrt(np.linalg.det(whole))

    total = sum(density(np.array(history)) for history in product((0, 1), repeat=n))
    keeps = np.append(np.exp(-PLANT.interval_s / np.exp(theta[[1, 3]])), fade)
    found = log_density(y, np.ones(n, bool), size, jump, struck, mark_sd**2, keeps, np.exp(theta[[0, 2, 4]]), n)

    assert found == pytest.approx(np.log(total), abs=0.02)


def test_of_lost_readings_nothing_is_looked_at():
    y, kept = np.random.default_rng(3).standard_normal(6), np.array([True, True, False, False, True, True])
    y[~kept] = 1e3

    def nats(part):  # nothing lasts from one reading to the next
        return log_density(y[part], kept[part], 2.0, 0.5, 0.0, 1.0, np.zeros(3), np.array([1.0, 0.5, 0.3]), 6)

    assert nats(slice(6)) == pytest.approx(nats(slice(2)) + nats(slice(4, 6)))


def test_an_offset_of_the_wider_range_leaves_a_hole_that_counts():
    """Of white readings the log ratio is known for each record; its mean has the hole beside the offset's energy."""
    plant = replace(WHITE, level_V=3 * WHITE.white_sd_V)
    sd, size, effect = plant.white_sd_V, 0.1 * plant.white_sd_V, Effect("range_switching", 1.0, {"part": 0.6})
    told, expected = [], []
    for seed in range(12):
        run = Run(plant, seed)
        value = calm(run)
        wide = np.abs(value) >= np.quantile(np.abs(value), 0.6)
        x = value - plant.level_V
        told.append(float(np.sum((x + size * wide) ** 2 - x**2)) / (2 * sd**2))
        expected.append(size * edge_of_range(run, effect) + size**2 * np.count_nonzero(wide) / (2 * sd**2))

    assert np.mean(told) == pytest.approx(np.mean(expected), rel=0.08)
    assert size * edge_of_range(run, effect) > 0.9 * np.mean(told)


def test_an_offset_towards_the_other_range_is_shared_ground_and_tells_less():
    away, towards = (
        edge_of_range(
            Run(replace(WHITE, level_V=sign * 8 * WHITE.white_sd_V), 3), Effect("range_switching", 1.0, {"part": 0.6})
        )
        for sign in (1, -1)
    )

    density = WHITE.n * 0.3863 / WHITE.white_sd_V  # of a normal law at its quantile of 0.6
    assert away == pytest.approx(density, rel=0.15)
    assert towards == pytest.approx((2 * np.log(2) - 1) * density, rel=0.15)


RESONANCE = Effect("resonance", 1.2e-3, {"frequency_hz": 4.0, "quality": 10.0})
DIFFERENCED = Effect("difference_noise", 1e-3)
LINE = Effect("periodic_interference", 6e-4, {"frequency_hz": 5.2, "phase_rad": 0.3})
CHANGING = Effect("changing_noise", 2.5, {"begin": 0.4, "end": 0.9})


@pytest.mark.parametrize(
    ("effect", "other"),
    [(RESONANCE, DIFFERENCED), (LINE, CHANGING)],
    ids=["resonance-differenced", "line-changing"],
)
def test_d_of_one_beside_another_is_what_the_dense_covariances_lose(effect, other):
    plant = replace(USUAL, n=128, drift_tau_s=20.0)
    lag = np.abs(np.subtract.outer(np.arange(plant.n), np.arange(plant.n)))
    t_s, part = lag * plant.interval_s, np.arange(plant.n) / plant.n
    seen = np.sinc(4.0 * plant.inside * plant.step_s)
    added = {
        "resonance": (RESONANCE.size * seen) ** 2 * np.exp(-np.pi * 4.0 / 10 * t_s) * np.cos(2 * np.pi * 4.0 * t_s),
        "difference_noise": DIFFERENCED.size**2 * (2.0 * (lag == 0) - 1.0 * (lag == 1)),
        "changing_noise": np.diag(((part >= 0.4) & (part < 0.9)) * (2.5**2 - 1) * plant.white_sd_V**2),
    }

    def covariance(theta):
        slow = sum(np.exp(theta[j] - t_s / np.exp(theta[j + 1])) for j in (0, 2))
        return slow + np.exp(theta[4]) * np.eye(plant.n) + added[other.cause]

    run, theta = Run(plant, seed=4), numbers(plant)
    true = covariance(theta) + added.get(effect.cause, 0.0)
    mean = template(run, LINE) * LINE.size if effect is LINE else np.zeros(plant.n)
    scatter, log_det = true + np.outer(mean, mean), np.linalg.slogdet(true)[1]

    def lost(free):
        wrong = covariance(free)
        return (np.trace(np.linalg.solve(wrong, scatter)) - plant.n + np.linalg.slogdet(wrong)[1] - log_det) / 2

    expected = minimize(lost, theta, method="L-BFGS-B", bounds=[(value - 6, value + 6) for value in theta]).fun
    assert d_nats(run, effect, beside=(other,)) == pytest.approx(expected, rel=0.12)
    assert d_nats(run, effect) > 1.3 * expected


def test_of_a_mean_that_is_known_nothing_is_left_in_the_way():
    run, pattern = Run(replace(USUAL, n=400), seed=4), Effect("reading_pattern", 4e-4, {"period_readings": 3.0})

    assert d_nats(run, LINE, beside=(pattern,)) == d_nats(run, LINE)


def test_two_at_once_have_their_sizes_beside_each_other():
    run = Run(replace(USUAL, n=600), seed=4)

    sized = beside_each_other(run, (LINE, DIFFERENCED), 2.0)

    assert sized is not None
    for effect, other in (sized, sized[::-1]):
        target = 4 * clairvoyant_d95(effect.cause, run.plant.n)
        assert d_nats(run, effect, beside=(other,)) == pytest.approx(target, rel=0.05)
    assert d_nats(run, sized[0]) > 1.2 * d_nats(run, sized[0], beside=sized[1:])
