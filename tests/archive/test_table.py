"""Many files tuned or diagnosed: a row for each, a line for each that could not be, and one page."""

from pathlib import Path

import pytest

from aemd.archive import ArchiveTable, diagnose_archive, tune_archive, write_page
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
    for number, name in enumerate("ab", start=1):  # a row leads to its report
        assert f'<a href="#report-{number}">{name}.mcap</a>' in page
        assert f'<details id="report-{number}"><summary>{name}.mcap</summary>' in page
    assert "<p>3 files, 1 of which could not be read.</p>" in page


def test_of_a_record_that_was_not_judged_whole_the_table_says_so(tmp_path: Path) -> None:
    row = {"file": "a.mcap", "verdict": "nothing_found", "readings": 1_400_000, "left_out": 600_000}

    write_page(ArchiveTable("in", ("file", "verdict", "readings"), (row,), (), {}), "aemd diagnose", tmp_path / "p")

    page = (tmp_path / "p").read_text()
    assert "<td>nothing found</td><td>first 1,400,000 of 2,000,000</td>" in page
    assert "<p>1 file.</p>" in page


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
