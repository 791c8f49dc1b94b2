"""The oracle is a Kalman filter, and a smoother with its lag, that nobody beats."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter, rts_smoother

from aemd.estimate import make_estimator
from aemd.paper.oracle import _state_model, oracle
from aemd.paper.protocol import APERTURE_S, INTERVAL_S, NOISE_V, READINGS, Condition, Record, make_record


def filterpy_oracle(record: Record) -> tuple[KalmanFilter, np.ndarray, np.ndarray]:
    kf = KalmanFilter(dim_x=2, dim_z=1)
    kf.F, kf.Q, kf.P = _state_model("broadband")
    kf.x, kf.H = np.zeros((2, 1)), np.array([[1.0, 0.0]])
    variance = [np.array([[v]]) for v in NOISE_V**2 + record.abrupt_variance_V2]
    means, covs, _, _ = kf.batch_filter(record.block["value_V"], Rs=variance)
    return kf, means, covs


def test_its_broadband_model_is_the_process_averaged_over_apertures() -> None:
    F, Q, start = _state_model("broadband")
    t = (np.arange(400) + 0.5) / 400 * APERTURE_S

    np.testing.assert_allclose(F @ start @ F.T + Q, start, rtol=1e-12)  # the law that it starts from stays
    for steps in (0, 1, 2, 7):
        between = np.mean(np.exp(-np.abs(steps * INTERVAL_S + t[:, None] - t)))  # two apertures, by the midpoint rule
        ours = (np.linalg.matrix_power(F, steps) @ start)[0, 0]
        assert ours == pytest.approx(2e-6 * between, rel=1e-6)


def test_without_lag_it_is_filterpys_filter() -> None:
    record = make_record("broadband", 1)
    _, means, covs = filterpy_oracle(record)

    ours = oracle("broadband", record, lag=0)

    np.testing.assert_allclose(ours["value_V"], means[:, 0, 0], rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(ours["sigma_V"], np.sqrt(covs[:, 0, 0]), rtol=1e-9)


def test_with_lag_it_is_filterpys_smoother() -> None:
    record, lag = make_record("broadband", 2), 15
    kf, means, covs = filterpy_oracle(record)
    ours = oracle("broadband", record, lag)

    for k in (0, 300, 700, READINGS - 10, READINGS - 1):
        end = min(k + lag, READINGS - 1) + 1
        first = max(end - 40, 0)
        n = end - first
        smoothed, smoothed_P, _, _ = rts_smoother(means[first:end], covs[first:end], [kf.F] * n, [kf.Q] * n)
        assert ours["value_V"][k] == pytest.approx(smoothed[k - first, 0, 0], rel=1e-8, abs=1e-13)
        assert ours["sigma_V"][k] == pytest.approx(np.sqrt(smoothed_P[k - first, 0, 0]), rel=1e-8)


@pytest.mark.parametrize("condition", ["static", "dynamic", "broadband", "probe"])
def test_no_estimator_beats_it(condition: Condition) -> None:
    for seed in range(5):
        record = make_record(condition, seed)
        limit = np.mean((oracle(condition, record, 0)["value_V"] - record.truth_V) ** 2)
        for name in ("kalman", "lms", "rem", "aem", "imm"):
            value_V = make_estimator(name, {}, INTERVAL_S).push(record.block)["value_V"]
            assert np.mean((value_V - record.truth_V) ** 2) > limit


def test_its_intervals_hold_the_truth_95_times_in_100() -> None:
    inside = []
    for seed in range(40):
        record = make_record("broadband", seed)
        ours = oracle("broadband", record, lag=0)
        inside.append((np.abs(ours["value_V"] - record.truth_V) < 1.96 * ours["sigma_V"])[~record.disturbed])

    assert np.concatenate(inside).mean() == pytest.approx(0.95, abs=0.01)
