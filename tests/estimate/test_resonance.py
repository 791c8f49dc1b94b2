"""Resonances: the parts of an autoregression sum to it, and tuning finds a body that is shaken."""

import numpy as np
import pytest
from scipy.signal import lfilter

from aemd.block import make_block
from aemd.estimate import make_estimator
from aemd.estimate.imm import Imm, ImmOptions
from aemd.estimate.resonance import Resonances, find_resonances
from aemd.estimate.tune import tune

T = 1e-3
POLES = np.array([0.98 * np.exp(0.3j), 0.95 * np.exp(1.9j)])
WEIGHTS = np.poly(np.concatenate([POLES, POLES.conj()])).real  # 1, -a_1, ..., -a_4
N = 20_000


def shaken(seed: int, weights: np.ndarray = WEIGHTS) -> np.ndarray:
    return lfilter([1.0], weights, np.random.default_rng(seed).normal(0, 1e-3, N))


def found_in(readings: np.ndarray, most: int) -> Resonances:
    found = find_resonances([(np.arange(readings.size), readings)], most)
    assert found is not None
    return found


def test_the_order_is_found_not_given() -> None:
    found = found_in(shaken(5), 10)

    # Schwarz's criterion takes a needless weight in a case of hundreds: a Gaussian beyond sqrt(log 20,000) = 3.1
    assert found.order == 4
    assert found.tau.size == 2


def test_the_parts_respond_together_as_the_autoregression_does() -> None:
    readings = shaken(1)
    found = found_in(readings, 2)
    k = np.arange(60)
    poles = np.exp(-1 / found.tau + 2j * np.pi * found.frequency)

    response = (found.gain * poles ** k[:, None]).real.sum(axis=1)

    impulse = np.zeros(60)
    impulse[0] = 1.0
    np.testing.assert_allclose(response, lfilter([1.0], WEIGHTS, impulse), atol=0.1)  # 20,000 readings tell it so far
    assert sorted(found.frequency) == pytest.approx([0.3 / 2 / np.pi, 1.9 / 2 / np.pi], abs=1e-3)
    assert found.error_V == pytest.approx(1e-3, rel=0.03)


def test_shocks_do_not_bend_the_resonances() -> None:
    readings = shaken(2)
    readings[::500] += 1.0

    found = found_in(readings, 2)

    assert sorted(found.frequency) == pytest.approx([0.3 / 2 / np.pi, 1.9 / 2 / np.pi], abs=3e-3)


def test_tuned_on_what_is_shaken_it_foresees_nearly_all_that_can_be_foreseen() -> None:
    known, unseen = shaken(3)[:3000], shaken(4)

    options = tune([make_block(known)], T, origin_V=0.0, slow="input", resonances=8).options

    estimates = make_estimator("imm", options, T).push(make_block(unseen))
    best = -0.5 * np.log(2 * np.pi * np.e) - np.log(1e-3)  # nats a reading: the entropy of what drives it
    assert estimates["log_likelihood"][100:].mean() == pytest.approx(best, abs=0.02)


def test_lost_readings_leave_no_trace() -> None:
    readings, index = shaken(6), np.arange(N)
    there = np.random.default_rng(7).uniform(size=N) > 0.05

    found = find_resonances([(index[there], readings[there])], 2)

    assert found is not None
    assert sorted(found.frequency) == pytest.approx([0.3 / 2 / np.pi, 1.9 / 2 / np.pi], abs=2e-3)
    assert found.error_V == pytest.approx(1e-3, rel=0.03)


def test_too_few_readings_in_a_row_have_none() -> None:
    assert find_resonances([], 4) is None
    assert find_resonances([(np.arange(0, 2000, 2), shaken(8)[:1000])], 4) is None


def as_parts(found: Resonances, noise_V: float) -> ImmOptions:
    """The options that leave nothing but the resonances and a small noise of each reading."""
    return ImmOptions(
        signal_V=(1e-3 * noise_V,) * found.tau.size,
        signal_tau_s=tuple(found.tau.tolist()),
        signal_hz=tuple(found.frequency.tolist()),
        drive_V=tuple(np.abs(found.gain * found.error_V).tolist()),
        drive_rad=tuple(np.angle(found.gain).tolist()),
        slow_V=1e-3 * noise_V,
        origin_V=0.0,
        noise_V=noise_V,
        quiet_s=1e15,
    )


@pytest.mark.parametrize(
    "poles",
    [
        0.97 * np.exp(1j * np.linspace(0.05, 3.0, 20)),  # order 40, all over the band
        0.97 * np.exp(1j * np.array([1.0, 1.01, 1.02])),  # one on the flank of the next
        np.array([0.999, 0.99, -0.95, 0.5, 0.0]),  # real ones: drift, and one that swings from reading to reading
        np.array([0.9, 0.9, 0.3]),  # the same twice, as nearly as the readings tell it
    ],
)
def test_the_parts_foresee_each_reading_as_the_autoregression_does(poles: np.ndarray) -> None:
    weights = np.poly(np.concatenate([poles, poles[poles.imag > 0].conj()])).real
    readings = shaken(9, weights)
    found = found_in(readings[: N // 2], 20)
    half = np.exp(-1 / found.tau + 2j * np.pi * found.frequency)
    both = np.concatenate([half, half[(found.frequency > 0) & (found.frequency < 0.5)].conj()])

    ours = Imm(as_parts(found, 1e-3 * found.error_V), 1.0).push(make_block(readings[N // 2 :]))

    error = lfilter(np.poly(both).real, [1.0], readings)[N // 2 :]
    direct = -0.5 * np.log(2 * np.pi * found.error_V**2) - error**2 / (2 * found.error_V**2)
    # From the 2,000th on, where the slowest part has forgotten how it began; the noise adds a millionth of the variance
    np.testing.assert_allclose(ours["log_likelihood"][2000:], direct[2000:], atol=2e-2)
    assert ours["log_likelihood"][2000:].mean() == pytest.approx(direct[2000:].mean(), abs=1e-4)


def test_poles_that_cannot_be_told_apart_are_not_split() -> None:
    twice = shaken(10, np.poly([1 - 1e-5, 1 - 1e-5, 1 - 1e-5]))

    assert np.abs(found_in(twice, 4).gain).max() < 1e3
