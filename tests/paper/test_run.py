"""The whole run: complete, repeatable, and its words follow from its numbers."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from aemd.paper import as_mapping, as_text, draw_figures, run_paper
from aemd.paper.claims import paper_verdicts, rival_verdicts
from aemd.paper.methods import METHODS
from aemd.paper.protocol import CONDITIONS
from aemd.paper.run import PaperResult, _Workers


@pytest.fixture(scope="module")
def steps() -> list[tuple[int, int]]:
    return []


@pytest.fixture(scope="module")
def result(steps: list[tuple[int, int]]) -> PaperResult:
    return run_paper(seeds=3, jobs=1, progress=lambda done, total: steps.append((done, total)))


def with_figure(result: PaperResult, condition: str, method: str, measure: str, value: float) -> PaperResult:
    figures: dict[str, dict[str, dict[str, Any]]] = {
        c: {m: dict(measures) for m, measures in methods.items()} for c, methods in result.figures.items()
    }
    figures[condition][method][measure] = (value, value, value)
    return replace(result, figures=figures)


def with_ratio(result: PaperResult, condition: str, method: str, other: str, value: float) -> PaperResult:
    ratios: dict[str, dict[str, dict[str, Any]]] = {
        c: {m: dict(others) for m, others in methods.items()} for c, methods in result.ratios.items()
    }
    ratios[condition][method][other] = (value, value, value)
    return replace(result, ratios=ratios)


def held(verdicts: list[Any], words: str) -> list[bool]:
    return [verdict.holds for verdict in verdicts if words in verdict.claim]


@pytest.mark.slow
def test_progress_comes_to_its_end(result: PaperResult, steps: list[tuple[int, int]]) -> None:
    assert result.seeds == 3
    assert [done for done, _ in steps] == list(range(1, steps[-1][1] + 1))


@pytest.mark.slow
def test_the_json_has_every_method_and_measure(result: PaperResult) -> None:
    mapping = json.loads(json.dumps(as_mapping(result), allow_nan=False))

    assert mapping["better"] in mapping["dynamic"]
    for condition in CONDITIONS:
        assert set(mapping[condition]) == set(METHODS)
        for figures in mapping[condition].values():
            for name in ("variance_mV2", "mse_mV2", "gain", "gain_undisturbed"):
                low, middle, high = figures[name]
                assert (low is None and condition == "static") or low <= middle <= high


@pytest.mark.slow
def test_the_text_has_all_tables_and_every_verdict(result: PaperResult) -> None:
    text = as_text(result)

    for number in range(1, 6):
        assert f"Table {number}. " in text
    for verdict in (*paper_verdicts(result), *rival_verdicts(result)):
        assert verdict.claim in text
        assert verdict.because in text
    for printed in ("0.212", "0.149", "0.015", "0.004", "35.5", "2.07", "1.45"):
        assert printed in text


@pytest.mark.slow
def test_verdicts_follow_the_numbers(result: PaperResult) -> None:
    good = with_ratio(result, "static", "imm", "KF", 0.018)
    bad = with_ratio(result, "static", "imm", "KF", 0.020)
    assert held(rival_verdicts(good), "at most 1.9 % of KF's") == [True]
    assert held(rival_verdicts(bad), "at most 1.9 % of KF's") == [False]
    assert "MISSED: static: imm's squared error is at most 1.9 % of KF's; 2 %" in as_text(bad)

    low = with_figure(result, "dynamic", "imm", "gain_undisturbed", 0.97)
    assert held(rival_verdicts(low), "gain at 0.2 Hz is 0.98 to 1.02") == [False]

    like_the_paper = with_figure(result, "dynamic", "AEM", "variance_mV2", 1.45)
    like_the_paper = with_figure(like_the_paper, "dynamic", "KF", "variance_mV2", 35.5)
    assert held(paper_verdicts(like_the_paper), "dynamic: the variance of AEM") == [True]
    assert held(paper_verdicts(like_the_paper), "dynamic: AEM reduces the variance to 4.1 % of KF's") == [True]


@pytest.mark.slow
def test_figures_4_and_5_are_drawn_with_all_panels(result: PaperResult, tmp_path: Path) -> None:
    for path in draw_figures(result.parameters[0], tmp_path / "new"):
        assert path.read_bytes()[1:4] == b"PNG"
        assert path.stat().st_size > 50_000


@pytest.mark.slow
def test_the_better_estimator_is_never_tuned_on_what_it_is_judged_on(result: PaperResult) -> None:
    again = run_paper(seeds=2, jobs=1)  # other seeds judged, same historical samples

    def plain(parameters: Mapping[str, Any]) -> dict[str, Any]:
        return dict(parameters)

    assert plain(again.parameters[0]) == plain(result.parameters[0])


def test_work_comes_back_in_its_order() -> None:
    steps: list[int] = []
    with _Workers(2) as workers:
        found = workers.map(divmod, [(k, 3) for k in range(7)], lambda: steps.append(1))

    assert found == [divmod(k, 3) for k in range(7)]
    assert len(steps) == 7


def test_one_seed_has_no_interval() -> None:
    with pytest.raises(ValueError, match="seeds = 1: must be at least 2"):
        run_paper(seeds=1, jobs=1)
