"""On measured logs, IMM foresees the readings it has not seen better than each of the paper's four."""

from pathlib import Path

import pytest

from tests.estimate.real_logs import NAMES, RIVALS, SHAKER, scores_of


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", NAMES)
def test_tuned_on_one_half_it_foresees_the_other_best(measured: Path, name: str) -> None:
    if not any(measured.glob(f"{SHAKER if name.startswith('shaker') else name}.*")):
        pytest.skip(f"{name}: no such log in {measured}")

    for direction, scores, _ in scores_of(measured, name):
        for rival in RIVALS:
            assert scores["imm"] > scores[rival], (direction, rival, scores)
