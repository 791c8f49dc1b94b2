"""The figures of an estimate that was made to have known ones."""

import numpy as np
import pytest

from aemd.block import ESTIMATE
from aemd.paper.measure import measure
from aemd.paper.protocol import INTERVAL_S, READINGS, Record, make_record


def estimate(value_V: np.ndarray, sigma_V: float = 1.0) -> np.ndarray:
    rows = np.zeros(READINGS, dtype=ESTIMATE)
    rows["value_V"], rows["sigma_V"] = value_V, sigma_V
    return rows


def dynamic() -> Record:
    return make_record("dynamic", 1)


def test_the_truth_is_perfect() -> None:
    figures = measure("dynamic", dynamic(), estimate(dynamic().truth_V))

    assert figures.mse_mV2 == 0
    assert figures.gain == pytest.approx(1)
    assert figures.gain_undisturbed == pytest.approx(1)
    assert figures.phase_rad == pytest.approx(0, abs=1e-9)
    assert figures.variance_mV2 == pytest.approx(2.0, rel=0.02)  # 13 1/3 periods


def test_a_constant_scores_0_in_the_papers_figure_and_loses_the_signal() -> None:
    figures = measure("dynamic", dynamic(), estimate(np.zeros(READINGS)))

    assert figures.variance_mV2 == 0
    assert figures.mse_mV2 == pytest.approx(2.0, rel=0.02)
    assert figures.gain == pytest.approx(0, abs=1e-9)


def test_gain_and_phase_are_those_of_a_scaled_and_shifted_sine() -> None:
    record = dynamic()
    shift = 3  # readings late
    phase = -2 * np.pi * 0.2 * INTERVAL_S * shift
    angle = 2 * np.pi * 0.2 * INTERVAL_S * np.arange(READINGS)
    (c, s), *_ = np.linalg.lstsq(np.column_stack([np.cos(angle), np.sin(angle)]), record.truth_V, rcond=None)
    late = 0.7 * (c * np.cos(angle + phase) + s * np.sin(angle + phase))

    figures = measure("dynamic", record, estimate(late))

    assert figures.gain == pytest.approx(0.7)
    assert figures.phase_rad == pytest.approx(phase)


def test_a_level_is_no_gain() -> None:
    record = dynamic()

    assert measure("dynamic", record, estimate(record.truth_V + 5e-3)).gain == pytest.approx(1)


def test_a_broadband_gain_is_a_regression() -> None:
    record = make_record("broadband", 1)
    figures = measure("broadband", record, estimate(0.8 * record.truth_V))

    assert figures.gain == pytest.approx(0.8)
    assert figures.gain_undisturbed == pytest.approx(0.8)
    assert np.isnan(figures.phase_rad)


def test_a_static_input_has_no_gain() -> None:
    figures = measure("static", make_record("static", 1), estimate(np.zeros(READINGS)))

    assert np.isnan([figures.gain, figures.gain_undisturbed, figures.phase_rad]).all()


def test_coverage_counts_quiet_and_disturbed_readings_apart() -> None:
    record = dynamic()
    off = np.where(record.disturbed, 2.0, 1.9) * 1e-3

    figures = measure("dynamic", record, estimate(record.truth_V + off, sigma_V=1e-3))

    assert figures.coverage_quiet == 1
    assert figures.coverage_disturbed == 0
