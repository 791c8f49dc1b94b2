"""Many files tuned or diagnosed: a row for each, a line for each that could not be, and one page."""

from pathlib import Path

import pytest

from aemd.archive import diagnose_archive, tune_archive, write_page
from aemd.record.source import Selection
from tests.archive.made import readings_of, write, write_json


def test_each_file_is_a_row_and_one_that_cannot_be_judged_a_line(tmp_path: Path) -> None:
    for name in ("b", "a"):
        write(tmp_path / "in" / f"{name}.mcap", readings_of(300, 5))
    write(tmp_path / "in" / "short.mcap", readings_of(30))

    table = diagnose_archive(str(tmp_path / "in"))
    write_page(table, "aemd diagnose", tmp_path / "page.html")

    page = (tmp_path / "page.html").read_text()
    assert [row["file"] for row in table.rows] == ["a.mcap", "b.mcap"]
    assert [row["readings"] for row in table.rows] == [292, 292]  # 300 less the 7 lost and the one without a value
    assert len(table.failed) == 1
    assert "short.mcap: holds 23 readings; at least 100 are needed" in table.failed[0]
    assert page.count("<tr>") == 4  # head, two rows, and the one that failed
    assert page.count("<details>") == 2


@pytest.mark.slow
def test_tuning_many_files_leaves_a_model_for_each_in_the_folder(tmp_path: Path) -> None:
    write(tmp_path / "in" / "day" / "a.mcap", readings_of(600, 5))

    table = tune_archive(str(tmp_path / "in"), tmp_path / "models", to_s=30.0)

    assert [Path(row["model"]) for row in table.rows] == [tmp_path / "models" / "day" / "a.toml"]
    assert 'name = "imm"' in (tmp_path / "models" / "day" / "a.toml").read_text()


def test_a_number_of_another_programs_files_is_diagnosed_where_it_was_chosen(tmp_path: Path) -> None:
    write_json(tmp_path / "lab.mcap", lambda value: {"mV": value, "celsius": 20.0})

    chosen = diagnose_archive(str(tmp_path), selection=Selection("/lab", "mV"))

    assert [row["readings"] for row in chosen.rows] == [300]
    assert chosen.failed == ()
