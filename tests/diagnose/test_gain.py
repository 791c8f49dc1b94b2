"""A single event is worth on held-out readings what it is worth, where one block would have nobody to learn from."""

import numpy as np
import pytest

from aemd.diagnose.checks.shapes import step_scores
from aemd.diagnose.checks.tails import gain_of_tails
from aemd.diagnose.fit import fit_base, refit
from aemd.diagnose.gain import HeldOut, block_of, measure_gain
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.terms.shapes import Step
from tests.diagnose.plant import clean, series, times

N = 1_500


def best_step(seed, step_V):
    """Return the base's fit, one with the step that its residuals show best, and what that is worth."""
    less = fit_base(make_data(series(clean(seed, N, white=0.2) + step_V * (times(N) > 50.0))))
    scores, size = step_scores(less)
    at = int(np.argmax(np.abs(scores)))
    step = Step(float(less.data.t_s[at]), scores[at] / size[at], 0.0)
    more = refit([*less.terms, step], less.data, np.append(less.theta, step.size))
    held = HeldOut(less.data, block_of(less.data, [step]), more.each)
    before, after = (held.score(of.terms, of.theta, forward=False) for of in (less, more))
    return less, more, measure_gain(before, after, N)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_step_is_worth_its_log_likelihood_less_what_its_size_costs(seed):
    """Of a log ratio with mean D the deviation is the root of 2 D; here it is of the same residuals, in other folds."""
    less, more, gain = best_step(seed, 4e-3)
    fitted = more.log_likelihood - less.log_likelihood

    assert fitted > 30
    assert abs(gain.nats_total - fitted) < np.sqrt(2 * fitted)
    assert 0 < gain.low < gain.nats_total
    assert gain.high - gain.low == pytest.approx(2 * 1.96 * np.sqrt(2 * gain.nats_total))


def test_the_largest_step_of_records_without_one_is_worth_little_on_other_readings():
    """It fits some nats because it is the largest of all, and among three quarters of them another often is."""
    found = [best_step(seed, 0.0) for seed in range(11, 17)]
    fitted = [more.log_likelihood - less.log_likelihood for less, more, _ in found]
    gained = [gain.nats_total for _, _, gain in found]

    assert np.mean(fitted) > 4
    assert np.mean(gained) < 0.4 * np.mean(fitted)
    assert min(gained) < 0


def test_a_step_that_the_base_takes_for_a_shock_is_worth_much_on_other_readings():
    """Without it the filter follows in a reading; where the residuals then show a step best is not where it is."""
    there = times(N) > 50.0
    less = fit_base(make_data(series(clean(3, N, white=0.2, shocks_per_s=0.05, shock_sd=15.0) + 25e-3 * there)))
    step = Step(float(times(N)[np.argmax(there)]), 25e-3 / less.data.unit_V, 0.0)
    more = refit([*less.terms, step], less.data, np.append(less.theta, step.size))
    held = HeldOut(less.data, block_of(less.data, [step]), more.each)
    before, after = (held.score(of.terms, of.theta, forward=False) for of in (less, more))

    assert less.base.shocks
    assert measure_gain(before, after, N).nats_total > 0.5 * (more.log_likelihood - less.log_likelihood)


def test_tails_beside_a_handful_of_shocks_are_worth_on_other_readings_what_they_add():
    """The base has both as many faint shocks, which each block knows; of the few real ones no half tells the law."""
    rng, n = np.random.default_rng(16), 3_000
    y = clean(16, n, white=0.0, shocks_per_s=0.02, shock_sd=6.0, decay_s=0.6)
    less = fit_base(make_data(series(y + 0.8e-3 * rng.standard_t(3.0, n) / np.sqrt(3))))
    _, tails = gain_of_tails(less)
    more = refit([*less.terms, tails], less.data, np.array([*tails.beside, *tails.start]))
    held = HeldOut(less.data, block_of(less.data, [tails]), more.each)
    before, after = (held.score(of.terms, of.theta, forward=False) for of in (less, more))
    fitted = more.log_likelihood - less.log_likelihood

    assert less.base.shocks
    assert abs(measure_gain(before, after, n).nats_total - fitted) < np.sqrt(2 * fitted)
