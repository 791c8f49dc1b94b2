"""Resonances: the parts of an autoregression sum to it, and tuning finds a body that is shaken."""

import numpy as np
import pytest
from scipy.signal import lfilter

from aemd.block import make_block
from aemd.estimate import make_estimator
from aemd.estimate.resonance import find_resonances
from aemd.estimate.tune import Kind, tune

T = 1e-3
POLES = np.array([0.98 * np.exp(0.3j), 0.95 * np.exp(1.9j)])
WEIGHTS = np.poly(np.concatenate([POLES, POLES.conj()])).real  # 1, -a_1, ..., -a_4
N = 20_000


def shaken(seed: int) -> np.ndarray:
    return lfilter([1.0], WEIGHTS, np.random.default_rng(seed).normal(0, 1e-3, N))


def test_the_parts_respond_together_as_the_autoregression_does() -> None:
    readings = shaken(1)
    found = find_resonances([readings], 4)
    k = np.arange(60)
    poles = np.exp(-1 / found.tau + 2j * np.pi * found.frequency)

    response = (found.gain * poles ** k[:, None]).real.sum(axis=1)

    impulse = np.zeros(60)
    impulse[0] = 1.0
    np.testing.assert_allclose(response, lfilter([1.0], WEIGHTS, impulse), atol=0.1)  # 20,000 readings tell it so far
    assert sorted(found.frequency) == pytest.approx([0.3 / 2 / np.pi, 1.9 / 2 / np.pi], abs=1e-3)
    assert found.error == pytest.approx(1e-3, rel=0.03)


def test_shocks_do_not_bend_the_resonances() -> None:
    readings = shaken(2)
    readings[::500] += 1.0

    found = find_resonances([readings], 4)

    assert sorted(found.frequency) == pytest.approx([0.3 / 2 / np.pi, 1.9 / 2 / np.pi], abs=3e-3)


def test_tuned_on_what_is_shaken_it_foresees_nearly_all_that_can_be_foreseen() -> None:
    known, unseen = shaken(3)[:3000], shaken(4)

    options = tune([make_block(known)], T, origin_V=0.0, slow="input", kinds=[Kind((), slow=True, order=4)]).options

    estimates = make_estimator("imm", options, T).push(make_block(unseen))
    best = -0.5 * np.log(2 * np.pi * np.e) - np.log(1e-3)  # nats a reading: the entropy of what drives it
    assert estimates["log_likelihood"][100:].mean() == pytest.approx(best, abs=0.02)
