"""Archives, as the command line takes them."""

import json
from pathlib import Path

from tests.archive.made import readings_of, write
from tests.cli.asking import Run


def test_the_command_line_replays_an_archive_and_fails_with_a_line_for_each_bad_file(aemd: Run, tmp_path: Path) -> None:
    write(tmp_path / "in" / "a.mcap", readings_of(200))
    (tmp_path / "in" / "bad.mcap").write_text("no recording")

    code, out, err = aemd("replay", f"{tmp_path}/in/*.mcap", "-o", tmp_path / "out", "--json")

    found = json.loads(out)
    assert code == 1
    assert (found["replayed"], len(found["failed"])) == (1, 1)
    assert err.splitlines() == [
        f"aemd: {tmp_path}/in/bad.mcap: is no MCAP file: its first 8 bytes are not MCAP's; "
        "import a table with `aemd import`"
    ]


def test_an_archive_without_a_folder_for_its_results_is_a_usage_error(aemd: Run, tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", readings_of(200))

    code, out, err = aemd("replay", tmp_path)

    assert (code, out) == (2, "")
    assert err.strip().endswith("means many files; name a folder by --out, and leave out --check and --plot")
