"""AEM against loops written from the equations, and the identities that its closed form rests on."""

import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from aemd.block import Block, Estimates, Status, make_block
from aemd.estimate import make_estimator
from aemd.estimate.aem import AemOptions
from aemd.estimate.options import discrete_phi
from tests.estimate import plain

INTERVAL_S = 1 / 15
MILLI = 1e-3


def assert_equal(ours: Estimates, theirs: Estimates, scale_V: float, options: AemOptions) -> None:
    """Every field within 1e-12 of the readings' size, the whole numbers exactly."""
    for name in ("index", "t_ns", "window", "passes", "status"):
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
    near = 1e-12 * scale_V
    for name, atol in (
        ("value_V", near),
        ("sigma_V", 0.0),
        ("u_V", near),
        ("spread", near / options.slope_unit_V),
        ("log_likelihood", 1e-12 + near / options.sigma_R_V),
    ):
        np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-12, atol=atol, err_msg=name)


def disturbed(seed: int, n: int = 120) -> Block:
    """A drifting input with noise, a shock and a step, mV."""
    random = np.random.default_rng(seed)
    value_V = np.cumsum(random.normal(0, 0.3, n)) + random.normal(0, 1.0, n)
    value_V[random.integers(0, n, 4)] += random.normal(0, 30, 4)
    value_V[n // 2 :] += random.normal(0, 8)
    return make_block(value_V * MILLI, first_index=40, interval_ns=1e9 * INTERVAL_S)


def with_holes(block: Block, seed: int) -> Block:
    """Flag some readings, lose some, once more than fifteen of each."""
    random = np.random.default_rng(seed)
    holed = block.copy()
    for place in random.integers(1, block.size, 4):
        holed["status"][place : place + random.choice([1, 2, 3, 20])] = int(Status.OVERLOAD_HIGH)
    for place in random.integers(1, block.size, 3):
        holed["index"][place:] += random.choice([1, 4, 15, 16, 400])
        holed["status"][place] |= int(Status.GAP)
    holed["value_V"][random.integers(1, block.size)] = 1e30
    holed["value_V"][holed["status"] & int(Status.OVERLOAD_HIGH) != 0] = np.nan
    return holed


OPTIONS = st.fixed_dictionaries(
    {},
    optional={
        "tau_s": st.floats(0.2, 50.0),
        "sigma_Q_V": st.floats(1e-5, 1e-2),
        "e_step": st.just("smoothed"),
        "stop_rule": st.just("disturbance"),
        "delta": st.sampled_from([0.0, 1e-4, 0.3]),
        "r_max": st.integers(1, 25),
        "gate": st.sampled_from([3.0, 10.0]),
        "prior": st.just("process"),
        "holes": st.just("kalman"),
        "windows": st.sampled_from([(12, 7), (9, 4, 2, 1), (8,)]),
        "fit_order": st.sampled_from([3, 4]),
        "fit_history": st.sampled_from([6, 20]),
    },
).map(lambda o: o | ({"thresholds": (0.6, 1.2, 1.8)[: len(o["windows"]) - 1]} if "windows" in o else {}))


@given(chosen=OPTIONS, seed=st.integers(0, 10**6), holes=st.booleans())
@hypothesis_settings(max_examples=60)
def test_the_closed_form_equals_the_loop_written_from_the_equations(
    chosen: dict[str, Any], seed: int, holes: bool
) -> None:
    options = AemOptions(**chosen)
    block = with_holes(disturbed(seed), seed) if holes else disturbed(seed)

    ours = make_estimator("aem", options, INTERVAL_S).push(block)
    theirs = plain.aem(block, options, discrete_phi(options.tau_s, INTERVAL_S))

    assert_equal(ours, theirs, 0.1, options)


@pytest.mark.parametrize("e_step", ["filtered", "smoothed"])
@pytest.mark.parametrize("name", ["adc24_7hz_reference", "dmm6d_calibrator_warmup", "dmm6d_lm399_3hz"])
def test_the_closed_form_equals_the_loop_on_a_measured_log(measured: Path, name: str, e_step: Any) -> None:
    with gzip.open(measured / f"{name}.csv.gz", "rt") as lines:
        value_V = np.loadtxt(lines, delimiter=",", skiprows=1, usecols=1, max_rows=600)
    noise_V = float(np.std(np.diff(value_V)) / np.sqrt(2))
    options = AemOptions(
        sigma_Q_V=noise_V, sigma_R_V=noise_V, slope_unit_V=noise_V, likelihood_unit_V=noise_V, e_step=e_step, delta=1e-4
    )

    ours = make_estimator("aem", options, INTERVAL_S).push(make_block(value_V))
    theirs = plain.aem(make_block(value_V), options, 1.0)

    assert_equal(ours, theirs, float(np.abs(value_V).max()), options)
    assert {0, 10, 15} <= set(np.unique(ours["window"]))


@pytest.mark.parametrize("trial", range(7))
def test_the_closed_form_equals_the_loop_on_measured_shocks(measured: Path, trial: int) -> None:
    with np.load(measured / "shaker_vibration_shock.npz") as arrays:
        board = arrays["accel_board"][trial].astype(float)
    around_the_largest = slice(max(int(np.abs(board).argmax()) - 100, 0), None)
    value_V = board[around_the_largest][:200] * MILLI
    options = AemOptions(e_step="smoothed", delta=1e-3, slope_unit_V=1e-4)

    ours = make_estimator("aem", options, INTERVAL_S).push(make_block(value_V))
    theirs = plain.aem(make_block(value_V), options, 1.0)

    assert_equal(ours, theirs, float(np.abs(value_V).max()), options)


def window_of(seed: int, v: int) -> list[float]:
    return (np.random.default_rng(seed).normal(0, 3, v) * MILLI).tolist()


@given(seed=st.integers(0, 10**6), v=st.integers(2, 15), smoothed=st.booleans(), phi=st.floats(0.3, 1.0))
def test_a_pass_is_an_affine_map_of_the_disturbance(seed: int, v: int, smoothed: bool, phi: float) -> None:
    options = AemOptions(delta=0.0, r_max=6, e_step="smoothed" if smoothed else "filtered")

    u = np.array(plain.maximise(window_of(seed, v), 2 * MILLI, 0.5e-6, phi, options).u)
    rho = (u[2] - u[1]) / (u[1] - u[0])
    limit = u[1] / (1 - rho)

    np.testing.assert_allclose(u, limit * (1 - rho ** np.arange(7)), rtol=1e-9, atol=1e-15)


@given(seed=st.integers(0, 10**6), v=st.integers(2, 15), phi=st.floats(0.3, 1.0), P0=st.floats(1e-8, 1e-4))
def test_the_expected_likelihood_never_falls_with_the_smoother(seed: int, v: int, phi: float, P0: float) -> None:
    options = AemOptions(delta=0.0, r_max=12, e_step="smoothed")

    Q = plain.maximise(window_of(seed, v), 2 * MILLI, P0, phi, options).Q

    assert np.all(np.diff(Q) >= -1e-12 * np.abs(Q[0]))


def test_the_expected_likelihood_can_fall_with_the_filter() -> None:
    options = AemOptions(delta=0.0, r_max=1)

    rises = [np.diff(plain.maximise(window_of(seed, 10), 0.0, 0.6e-6, 1.0, options).Q)[0] for seed in range(200)]

    assert min(rises) < 0 < max(rises)


@given(seed=st.integers(0, 10**6), v=st.integers(2, 15))
@hypothesis_settings(max_examples=30)
def test_at_the_fixed_point_each_estimate_repeats_that_of_a_window_ago(seed: int, v: int) -> None:
    rem = make_estimator("rem", {"window": v, "delta": 0.0, "r_max": 20_000}, INTERVAL_S)
    block = disturbed(seed, 300)

    value_V = rem.push(block)["value_V"]
    steady = value_V[60:]  # by then the gain has settled

    np.testing.assert_allclose(steady[v:], steady[:-v], rtol=0, atol=1e-9)
    assert np.ptp(block["value_V"][60:]) > 1e-3


def test_passes_end_where_the_printed_likelihood_says_and_not_later() -> None:
    block = disturbed(3)
    few = make_estimator("aem", {"delta": 0.3, "r_max": 50}, INTERVAL_S).push(block)["passes"]
    many = make_estimator("aem", {"delta": 1e-6, "r_max": 50}, INTERVAL_S).push(block)["passes"]
    all_of_them = make_estimator("aem", {"delta": 0.0, "r_max": 50}, INTERVAL_S).push(block)["passes"]

    assert np.all(few <= many)
    assert many.max() > few.max()
    assert set(np.unique(all_of_them)) == {0, 50}


def test_the_first_window_starts_from_an_estimate_not_from_the_prior() -> None:
    """From a prior that knows nothing, rho is 1 and each of the passes would move the disturbance by as much again."""
    estimates = make_estimator("rem", {"window": 10, "delta": 0.0, "r_max": 1000}, INTERVAL_S).push(disturbed(5, 60))

    assert estimates["window"].tolist() == [0] * 10 + [10] * 50
    assert np.abs(estimates["value_V"]).max() < 2 * np.abs(disturbed(5, 60)["value_V"]).max()


def test_rem_is_aem_with_one_window() -> None:
    block = with_holes(disturbed(7), 7)
    aem = make_estimator("aem", {"windows": (10,), "thresholds": (), "fit_history": 10}, INTERVAL_S).push(block)
    rem = make_estimator("rem", {"window": 10}, INTERVAL_S).push(block)

    for name in rem.dtype.names:
        if name != "spread":
            np.testing.assert_array_equal(aem[name], rem[name], err_msg=name)
