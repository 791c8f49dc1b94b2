"""IMM: against plain matrices, against filterpy's filter and smoother, and its promises."""

import math
from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter, rts_smoother
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.stats import norm

from aemd.block import Block, Estimates, Status, make_block
from aemd.errors import ConfigError
from aemd.estimate import make_estimator, options_of
from aemd.estimate.imm import Imm, ImmOptions
from aemd.estimate.imm_kernels import merge
from tests.estimate.plain_imm import PlainImm

T = 1 / 15
FIELDS = ("value_V", "sigma_V", "u_V", "log_likelihood")

ABOUT_ZERO = ImmOptions(origin_V=0.0)
TWO_PARTS = ImmOptions(
    signal_V=(1.4e-3, 0.5e-3),
    signal_tau_s=(1.0, 20.0),
    signal_hz=(0.0, 1.3),
    slow_V=2e-3,
    slow_tau_s=30.0,
    slow="input",
    variance_memory_s=5.0,
)

DRIVEN = {"drive_V": (0.3e-3, 0.2e-3), "drive_rad": (0.4, -2.0)}


def estimates_of(options: ImmOptions, block: Block, interval_s: float = T) -> Estimates:
    imm = Imm(options, interval_s)
    return np.concatenate([imm.push(block), imm.flush()])


def drawn(options: ImmOptions, seed: int, n: int = 400) -> tuple[Block, np.ndarray, np.ndarray]:
    """Readings drawn from the model itself with one part, their input and mode."""
    rng = np.random.default_rng(seed)
    keep, slow_keep = math.exp(-T / options.signal_tau_s[0]), math.exp(-T / options.slow_tau_s)
    s, slow, mode = rng.normal(0, options.signal_V[0]), rng.normal(0, options.slow_V), 0
    inputs, modes, readings = np.empty(n), np.empty(n, dtype=int), np.empty(n)
    for k in range(n):
        s = keep * s + rng.normal(0, options.signal_V[0] * math.sqrt(1 - keep**2))
        slow = slow_keep * slow + rng.normal(0, options.slow_V * math.sqrt(1 - slow_keep**2))
        mode ^= rng.uniform() < 1 - math.exp(-T / (options.disturbed_s if mode else options.quiet_s))
        readings[k] = s + slow + rng.normal(0, options.noise_V) + mode * rng.normal(0, options.disturbed_V)
        inputs[k], modes[k] = s, mode
    return make_block(readings, interval_ns=T * 1e9), inputs, modes


def with_holes(block: Block, seed: int) -> Block:
    """Some readings lost, some flagged."""
    rng = np.random.default_rng(seed)
    kept = block[np.sort(rng.choice(block.size, block.size - 20, replace=False))].copy()
    flagged = rng.choice(kept.size, 10, replace=False)
    kept["status"][flagged] = Status.OVERLOAD_HIGH
    kept["value_V"][flagged] = np.nan
    return kept


@pytest.mark.parametrize("lag", [0, 1, 7])
@pytest.mark.parametrize(
    "options", [ABOUT_ZERO, TWO_PARTS, replace(TWO_PARTS, slow="disturbance"), replace(TWO_PARTS, **DRIVEN)]
)
def test_the_kernel_equals_plain_matrices(options: ImmOptions, lag: int) -> None:
    options = replace(options, lag=lag)
    block = with_holes(drawn(ABOUT_ZERO, seed=3)[0], seed=4)
    block["value_V"][0] = 1e-3  # the origin of the options that have none

    ours, plain = estimates_of(options, block), PlainImm(options, T).run(block)

    for name in ("index", "t_ns", "status"):
        np.testing.assert_array_equal(ours[name], plain[name])
    for name in ("value_V", "u_V"):
        np.testing.assert_allclose(ours[name], plain[name], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(ours["log_likelihood"], plain["log_likelihood"], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(ours["sigma_V"], plain["sigma_V"], rtol=6e-3)  # the interval's tolerance


def filterpy_filter(options: ImmOptions) -> KalmanFilter:
    """The quiet mode alone, of one part without a frequency, in filterpy."""
    keep, slow_keep = math.exp(-T / options.signal_tau_s[0]), math.exp(-T / options.slow_tau_s)
    kf = KalmanFilter(dim_x=2, dim_z=1)
    kf.x = np.zeros((2, 1))
    kf.P = np.diag([options.signal_V[0] ** 2, options.slow_V**2])
    kf.F = np.diag([keep, slow_keep])
    kf.Q = np.diag([options.signal_V[0] ** 2 * (1 - keep**2), options.slow_V**2 * (1 - slow_keep**2)])
    kf.H = np.array([[1.0, 1.0]])
    kf.R = np.array([[options.noise_V**2]])
    return kf


UNDISTURBED = replace(ABOUT_ZERO, quiet_s=1e15, disturbed_s=1e-3)


def test_without_disturbances_it_is_filterpys_kalman_filter() -> None:
    block = drawn(UNDISTURBED, seed=5)[0]
    kf = filterpy_filter(UNDISTURBED)
    means, covs, _, _ = kf.batch_filter(block["value_V"])

    ours = estimates_of(UNDISTURBED, block)

    np.testing.assert_allclose(ours["value_V"], means[:, 0, 0], rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(ours["sigma_V"], np.sqrt(covs[:, 0, 0]), rtol=1e-9)


def test_without_disturbances_the_lag_is_filterpys_smoother() -> None:
    options, n, lag = replace(UNDISTURBED, lag=12), 60, 12
    block = drawn(options, seed=6, n=n)[0]
    ours = estimates_of(options, block)
    kf = filterpy_filter(options)
    means, covs, _, _ = kf.batch_filter(block["value_V"])

    for k in (0, 20, n - 5):
        end = min(k + lag, n - 1) + 1
        smoothed, smoothed_P, _, _ = rts_smoother(means[:end], covs[:end], [kf.F] * end, [kf.Q] * end)
        assert ours["value_V"][k] == pytest.approx(smoothed[k, 0, 0], rel=1e-8, abs=1e-12)
        assert ours["sigma_V"][k] == pytest.approx(math.sqrt(smoothed_P[k, 0, 0]), rel=1e-8)


@pytest.mark.parametrize("lag", [0, 7])
def test_a_part_that_is_a_disturbance_is_left_out_as_the_slow_part_is(lag: int) -> None:
    """The slow part said as a part of its own, of the same law: all that is estimated stays, through holes, too."""
    options = replace(ABOUT_ZERO, slow_V=2e-3, slow_tau_s=30.0, lag=lag)
    said_otherwise = replace(
        options,
        signal_V=(*options.signal_V, options.slow_V),
        signal_tau_s=(*options.signal_tau_s, options.slow_tau_s),
        signal_hz=(0.0, 0.0),
        signal_is=("input", "disturbance"),
        slow_V=1e-15,
    )
    block = with_holes(drawn(options, seed=21)[0], seed=22)
    ours, expected = estimates_of(said_otherwise, block), estimates_of(options, block)

    for name in FIELDS:
        np.testing.assert_allclose(ours[name], expected[name], rtol=1e-8, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("lag", [0, 9])
@given(cuts=st.lists(st.integers(0, 380), max_size=6), seed=st.integers(0, 3), driven=st.booleans())
def test_cutting_the_stream_changes_no_bit(lag: int, cuts: list[int], seed: int, driven: bool) -> None:
    options = replace(TWO_PARTS, lag=lag, **(DRIVEN if driven else {}))
    block = with_holes(drawn(ABOUT_ZERO, seed=seed)[0], seed=seed)
    imm = Imm(options, T)

    pieces = [imm.push(piece) for piece in np.split(block, sorted(cuts))]

    assert np.concatenate([*pieces, imm.flush()]).tobytes() == estimates_of(options, block).tobytes()


def test_a_lag_gives_each_estimate_when_it_is_due() -> None:
    imm = Imm(replace(ABOUT_ZERO, lag=4), T)
    block = make_block(np.zeros(10))

    assert imm.push(block[:4]).size == 0
    assert imm.push(block[4:7])["index"].tolist() == [0, 1, 2]
    assert imm.push(block[7:])["index"].tolist() == [3, 4, 5]
    assert imm.flush()["index"].tolist() == [6, 7, 8, 9]
    assert imm.flush().size == 0


@given(
    quiet=st.floats(1e-3, 1 - 1e-3),
    apart=st.floats(-30, 30),
    wider=st.floats(-4, 4),
)
def test_the_interval_of_any_two_modes_holds_95_percent_of_their_mixture(
    quiet: float, apart: float, wider: float
) -> None:
    weights, means, sds = np.array([quiet, 1 - quiet]), np.array([0.0, apart]), np.array([1.0, math.exp(wider)])

    value, sigma = merge(quiet, 1 - quiet, 0.0, apart, 1.0, math.exp(2 * wider))

    def missing(h: float) -> float:
        return 0.95 - float(weights @ (norm.cdf((h - means + value) / sds) - norm.cdf((-h - means + value) / sds)))

    assert value == pytest.approx(weights @ means)
    half = brentq(missing, 0, 2 * (abs(apart) + 10 * sds.max()))
    assert 1.959964 * sigma == pytest.approx(half, rel=1e-3) or abs(missing(1.959964 * sigma)) < 1e-4


def test_its_intervals_hold_the_input_of_its_own_model_95_times_in_100() -> None:
    for lag in (0, 15):
        inside, modes = [], []
        for seed in range(20):
            options = replace(ABOUT_ZERO, lag=lag)
            block, inputs, mode = drawn(options, seed, n=1000)
            ours = estimates_of(options, block)
            inside.append(np.abs(ours["value_V"] - inputs) < 1.96 * ours["sigma_V"])
            modes.append(mode)
        share = np.concatenate(inside)

        # 20,000 readings, alike over some ten at a time: three standard deviations are 0.015
        assert share.mean() == pytest.approx(0.95, abs=0.015)
        assert share[np.concatenate(modes) == 1].mean() > 0.9


def test_a_shock_leaves_the_estimate_where_the_model_carries_it() -> None:
    without_drift = replace(ABOUT_ZERO, slow_V=1e-6)
    block, _, _ = drawn(replace(UNDISTURBED, slow_V=1e-6), seed=7)
    struck = block.copy()
    struck["value_V"][200] += 60e-3

    calm, hit = estimates_of(without_drift, block), estimates_of(without_drift, struck)

    moved = np.abs(hit["value_V"] - calm["value_V"])
    assert moved[200] < 3 * hit["sigma_V"][200]
    assert moved[210:].max() < 0.1 * ABOUT_ZERO.noise_V
    assert hit["u_V"][200] == pytest.approx(60e-3, abs=3e-3)
    assert hit["sigma_V"][200] > 5 * calm["sigma_V"][200]


def test_a_lost_reading_and_a_flagged_one_are_the_same() -> None:
    block = drawn(ABOUT_ZERO, seed=8)[0]
    flagged = block.copy()
    flagged["status"][100:104] = Status.INVALID
    flagged["value_V"][100:104] = np.nan

    lost, coasted = estimates_of(ABOUT_ZERO, np.delete(block, slice(100, 104))), estimates_of(ABOUT_ZERO, flagged)

    assert lost[100:].tobytes() == coasted[104:].tobytes()
    assert np.all(coasted["status"][100:104] & Status.COASTED)
    assert np.all(np.diff(coasted["sigma_V"][99:104]) > 0)
    assert np.all(coasted["log_likelihood"][100:104] == 0)
    assert np.isfinite(coasted["value_V"]).all()


def test_a_number_that_cannot_be_is_not_taken_in() -> None:
    block = drawn(ABOUT_ZERO, seed=9)[0]
    for wrong in (1e30, -1e300, np.inf, np.nan):  # not flagged
        block["value_V"][50] = wrong
        ours = estimates_of(ABOUT_ZERO, block)

        assert ours["status"][50] & Status.COASTED
        assert all(np.isfinite(ours[name]).all() for name in FIELDS)


def test_before_the_first_value_it_says_that_it_knows_nothing() -> None:
    block = make_block([np.nan, np.nan, 5.0, 5.0], status=[Status.INVALID, Status.INVALID, 0, 0])

    ours = estimates_of(ImmOptions(), block)

    assert ours["value_V"].tolist()[:2] == [0.0, 0.0]
    assert ours["sigma_V"].tolist()[:2] == [1000.0, 1000.0]
    assert ours["value_V"][2] == pytest.approx(5.0, abs=0.03)


def test_a_wrong_first_reading_is_got_over() -> None:
    rng = np.random.default_rng(10)
    readings = 5.0 + rng.normal(0, 17e-6, 300)
    readings[0] += 50e-3  # a shock where the origin is taken
    options = ImmOptions(slow="input")

    ours = estimates_of(options, make_block(readings))

    np.testing.assert_allclose(ours["value_V"][20:], 5.0, atol=1e-4)


def test_it_starts_afresh_after_a_long_hole_another_acquisition_and_an_endless_disturbance() -> None:
    options = replace(ABOUT_ZERO, origin_V=None, restart_after=50, longest_disturbance_s=2.0)
    block = make_block(np.full(400, 1.0))
    hole, again, step = block.copy(), block.copy(), block.copy()
    hole["index"][200:] += 60
    again["index"][200:] -= 200
    step["value_V"][200:] = 2.0  # the input has changed: no disturbance of the model is as large, or lasts as long

    for changed, at in ((hole, 200), (again, 200), (step, 231)):
        ours = estimates_of(options, changed)
        assert np.flatnonzero(ours["status"] & Status.RESTARTED).tolist() == [at]
    assert estimates_of(options, step)["value_V"][-1] == pytest.approx(2.0, abs=1e-3)


@pytest.mark.timeout(30)
def test_a_hole_of_a_trillion_readings_is_no_work() -> None:
    block = drawn(ABOUT_ZERO, seed=15)[0]
    block["index"][200:] += 10**12

    ours = estimates_of(replace(ABOUT_ZERO, lag=5), block)

    assert np.flatnonzero(ours["status"] & Status.RESTARTED).tolist() == [200]


def test_a_unit_is_only_a_unit() -> None:
    block = drawn(ABOUT_ZERO, seed=11)[0]
    scaled = block.copy()
    scaled["value_V"] *= 1024.0
    volts = ("signal_V", "slow_V", "noise_V", "disturbed_V")
    options = replace(
        ABOUT_ZERO,
        **{
            name: tuple(1024 * v for v in value)
            if isinstance(value := getattr(ABOUT_ZERO, name), tuple)
            else 1024 * value
            for name in volts
        },
    )

    small, large = estimates_of(ABOUT_ZERO, block), estimates_of(options, scaled)

    for name in ("value_V", "sigma_V", "u_V"):
        np.testing.assert_allclose(large[name], 1024 * small[name], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(large["log_likelihood"], small["log_likelihood"] - math.log(1024), atol=1e-8)


def test_followed_variances_find_a_noise_that_is_three_times_what_was_said() -> None:
    rng = np.random.default_rng(12)
    options = ImmOptions(signal_V=(1e-9,), slow_V=1e-9, noise_V=1e-5, disturbed_V=1e-2, origin_V=0.0, quiet_s=1e4)
    block = make_block(rng.normal(0, 3e-5, 4000))

    said, followed = (estimates_of(replace(options, variance_memory_s=m), block) for m in (math.inf, 20.0))

    right = -0.5 * math.log(2 * math.pi * math.e) - math.log(3e-5)
    assert followed["log_likelihood"][1000:].mean() == pytest.approx(right, abs=0.02)
    assert said["log_likelihood"][1000:].mean() < right - 0.5


def test_modes_that_end_at_once_or_never_divide_by_nothing() -> None:
    block = drawn(ABOUT_ZERO, seed=13)[0]
    block["value_V"][::7] += 1.0
    for quiet_s, disturbed_s in ((1e-9, 1e-9), (1e30, 1e30), (1e-9, 1e30), (1e30, 1e-9)):
        ours = estimates_of(replace(ABOUT_ZERO, quiet_s=quiet_s, disturbed_s=disturbed_s), block)
        assert all(np.isfinite(ours[name]).all() for name in FIELDS)


def test_readings_that_repeat_to_the_last_digit_leave_a_finite_estimate() -> None:
    ours = estimates_of(replace(ABOUT_ZERO, variance_memory_s=0.5), make_block(np.zeros(20_000)))

    assert all(np.isfinite(ours[name]).all() for name in FIELDS)


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        ({"signal_V": (1.0, 2.0)}, "as many"),
        ({"signal_V": (), "signal_tau_s": (), "signal_hz": ()}, "at least 1"),
        ({"signal_V": 3.0}, "must be a list"),
        ({"signal_tau_s": (0.0,)}, "above 0"),
        ({"signal_hz": (-1.0,)}, "signal_hz"),
        ({"signal_V": (math.nan,)}, "finite"),
        ({"origin_V": math.inf}, "finite"),
        ({"drive_V": (1.0, 1.0), "drive_rad": (0.0, 0.0)}, "must have as many as signal_V, 1, or none"),
        ({"drive_V": (1.0,)}, "drive_V, drive_rad have 1 and 0"),
        ({"drive_V": (0.0,), "drive_rad": (0.0,)}, "drive_V above 0"),
        ({"noise_V": 0.0}, "noise_V"),
        ({"lag": -1}, "lag"),
        ({"slow": "drift"}, "slow"),
        ({"signal_is": ("input", "input")}, "as many as signal_V, 1, or none"),
        ({"signal_is": ("noise",)}, "must be 'input' or 'disturbance'"),
        ({"signal_is": ("disturbance",)}, "at least one must be 'input'"),
    ],
)
def test_options_that_cannot_be_are_refused(options: dict[str, object], rule: str) -> None:
    with pytest.raises(ConfigError, match=rule):
        make_estimator("imm", options, T)


def test_a_frequency_above_half_the_rate_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"signal_hz = 8: must be at most half the reading rate, 7\.5 Hz"):
        Imm(ImmOptions(signal_hz=(8.0,)), T)


def test_a_copy_by_options_estimates_the_same() -> None:
    block = drawn(ABOUT_ZERO, seed=14)[0]
    original = Imm(replace(TWO_PARTS, lag=3), T)

    copy = make_estimator("imm", options_of(original), original.interval_s)

    assert copy.lag == 3
    assert copy.push(block).tobytes() == original.push(block).tobytes()
