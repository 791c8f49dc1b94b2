"""From a table of options to an estimator and back."""

import math
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from aemd.block import make_block
from aemd.errors import ConfigError
from aemd.estimate import ESTIMATORS, make_estimator, options_of

INTERVAL_S = 1 / 15
PAPERS = ["aem", "rem", "kalman", "lms", "filterpy"]


@pytest.mark.parametrize("name", PAPERS)
def test_the_name_of_an_estimator_is_its_key(name: str) -> None:
    assert make_estimator(name, {}, INTERVAL_S).name == name


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("aem", {"windows": [12, 6], "thresholds": [0.1], "tau_s": 0.3, "delta": 0.0, "e_step": "smoothed"}),
        ("rem", {"window": 7, "stop_rule": "disturbance"}),
        ("kalman", {"sigma_Q_V": 1 / 3000, "tau_s": 1 / 3}),
        ("lms", {"taps": 9, "step": 0.05}),
        ("filterpy", {"tau_s": 0.7}),
    ],
)
def test_its_options_make_its_exact_copy(name: str, options: dict[str, Any]) -> None:
    block = make_block(np.random.default_rng(1).normal(0, 1e-3, 300))
    original = make_estimator(name, options, 0.1)

    copy = make_estimator(name, options_of(original), 0.1)

    assert copy.push(block).tobytes() == original.push(block).tobytes()


@pytest.mark.parametrize("name", PAPERS)
def test_the_defaults_pass_the_check_of_a_config_and_come_out_unchanged(name: str) -> None:
    options_type, _ = ESTIMATORS[name]

    assert TypeAdapter(options_type).validate_python({}) == options_type()


@pytest.mark.parametrize(
    ("name", "table", "rule"),
    [
        ("aem", {"sigma_R_V": 0.0}, "greater than or equal to 0.0"),
        ("aem", {"windows": [5, 10, 15]}, "must fall from the longest"),
        ("aem", {"windows": [15, 10]}, "one fewer than windows"),
        ("aem", {"thresholds": [1.0, 0.5]}, "must rise"),
        ("aem", {"fit_history": 2}, "must be above fit_order"),
        ("rem", {"window": 0}, "greater than or equal to 1"),
        ("rem", {"e_step": "guessed"}, "'filtered' or 'smoothed'"),
        ("kalman", {"tau_s": math.nan}, "greater than 0"),
        ("lms", {"step": 2.0}, "must be below 2"),
    ],
)
def test_a_config_is_refused_with_the_rule_it_breaks(name: str, table: dict[str, Any], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        TypeAdapter(ESTIMATORS[name][0]).validate_python(table)
    with pytest.raises(ConfigError, match=f"estimator '{name}': {next(iter(table))}|thresholds"):
        make_estimator(name, table, INTERVAL_S)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("kalmann", {}, "no estimator 'kalmann'; did you mean 'kalman'"),
        ("aem", {"r_maks": 3}, "estimator 'aem': r_maks: no such option; there are: tau_s"),
        ("aem", {"r_max": "3"}, "estimator 'aem': r_max = '3': must be a whole number"),
        ("aem", {"r_max": 2.5}, "estimator 'aem': r_max = 2.5: must be a whole number"),
        ("aem", {"r_max": True}, "estimator 'aem': r_max = True: must be a whole number"),
        ("aem", ESTIMATORS["kalman"][0](), "estimator 'aem': takes AemOptions, not KalmanOptions"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line_with_the_way_out(name: str, options: Any, message: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        make_estimator(name, options, INTERVAL_S)

    assert str(refusal.value).startswith(message)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("interval_s", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", PAPERS)
def test_an_interval_that_cannot_be_is_refused(name: str, interval_s: float) -> None:
    with pytest.raises(ConfigError, match="interval_s"):
        make_estimator(name, {}, interval_s)
