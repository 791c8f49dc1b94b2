"""What is run as written has the bits of what is compiled, and spares a live acquisition the compiler."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from aemd.block import Status, make_block
from aemd.estimate.compiled import FEW
from aemd.estimate.registry import ESTIMATORS, make_estimator

INTERVAL_S = 1 / 15
READINGS = 600

CASES: list[tuple[str, dict[str, Any]]] = [
    ("aem", {}),
    ("aem", {"e_step": "smoothed", "stop_rule": "disturbance", "prior": "process", "holes": "kalman"}),
    ("rem", {"tau_s": float("inf")}),
    ("kalman", {}),
    ("lms", {}),
    ("lms", {"form": "plain", "step": 1.0}),
    ("imm", {}),
    ("imm", {"lag": 7, "signal_V": (1e-3, 2e-3), "signal_tau_s": (1.0, 2.0), "signal_hz": (0.0, 3.0)}),
]


def _rough(seed: int) -> NDArray[np.void]:
    """Return readings with noise, shocks, holes of up to 40, flags, a NaN, and one that overflows when squared."""
    rng = np.random.default_rng(seed)
    value_V = rng.normal(scale=1e-3, size=READINGS)
    value_V[::37] += rng.normal(scale=0.05, size=value_V[::37].size)
    value_V[[100, 200]] = np.nan, 1e200
    status = np.where(rng.random(READINGS) < 0.03, int(Status.OVERLOAD_HIGH), 0)
    block = make_block(value_V, interval_ns=INTERVAL_S * 1e9, status=status)
    block["index"] += np.cumsum(np.where(rng.random(READINGS) < 0.02, rng.integers(1, 40, READINGS), 0))
    return block


@pytest.mark.parametrize(("name", "options"), CASES)
def test_as_written_and_compiled_are_the_same_to_the_bit(name: str, options: dict[str, Any]) -> None:
    options_type, estimator_type = ESTIMATORS[name]
    block = _rough(1)
    written, compiled, mixed = (estimator_type(options_type(**options), INTERVAL_S, few) for few in (FEW, 0, 100))

    wanted = np.concatenate([compiled.push(block), compiled.flush()])
    found = np.concatenate([*(written.push(block[k : k + 1]) for k in range(READINGS)), written.flush()])
    # Few, many, few: what an outage has heaped up is compiled, in mid-stream.
    parts = (block[:50], block[50:90], block[90:300], block[300:330], block[330:])
    both = np.concatenate([*(mixed.push(part) for part in parts), mixed.flush()])

    assert found.tobytes() == wanted.tobytes()
    assert both.tobytes() == wanted.tobytes()


@pytest.mark.parametrize(("interval_s", "options", "imported"), [
    (1 / 15, "{}", False),
    (1e-4, "{}", True),
    (1 / 15, "{'fit_history': 500}", True),  # a window that long would take a core's tenth
])  # fmt: skip
def test_a_live_estimator_takes_a_compiler_only_where_it_pays(interval_s: float, options: str, imported: bool) -> None:
    code = f"""
import sys
from aemd.block import make_block
from aemd.estimate.registry import make_estimator
make_estimator("aem", {options}, {interval_s!r}, is_live=True).push(make_block([1.0]))
print("numba" in sys.modules)
"""
    printed = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60
    ).stdout

    assert printed.strip() == str(imported)


def test_a_backlog_is_compiled_though_the_rate_is_slow() -> None:
    code = """
import sys
import numpy as np
from aemd.block import make_block
from aemd.estimate.registry import make_estimator
make_estimator("aem", {}, 1 / 15, is_live=True).push(make_block(np.zeros(50_000)))
print("numba" in sys.modules)
"""
    printed = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60
    ).stdout

    assert printed.strip() == "True"


def test_what_is_live_is_the_same_estimator() -> None:
    live, replayed = make_estimator("aem", {}, INTERVAL_S, is_live=True), make_estimator("aem", {}, INTERVAL_S)

    assert live.push(_rough(2)).tobytes() == replayed.push(_rough(2)).tobytes()


@pytest.mark.parametrize("few", [0, FEW])
def test_an_input_of_nothing_but_zeros_is_no_division_by_zero(few: int) -> None:
    options_type, estimator_type = ESTIMATORS["lms"]

    estimates = estimator_type(options_type(least_power_V2=0.0), INTERVAL_S, few).push(make_block(np.zeros(40)))

    assert not estimates["value_V"].any()
