"""On measured logs, IMM foresees the readings it has not seen better than each of the paper's four."""

import pytest

from tests.estimate.real_logs import FOLDER, NAMES, RIVALS, SHAKER, scores_of


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", NAMES)
def test_tuned_on_one_half_it_foresees_the_other_best(name: str) -> None:
    if not any(FOLDER.glob(f"{SHAKER if name.startswith('shaker') else name}.*")):
        pytest.skip(f"{name}: no such log in {FOLDER}; AEMD_MEASURED names their folder")

    for direction, scores, _ in scores_of(FOLDER, name):
        for rival in RIVALS:
            assert scores["imm"] > scores[rival], (direction, rival, scores)
