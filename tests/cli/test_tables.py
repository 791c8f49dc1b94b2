"""Tables that go in and come out, and those that cannot."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.cli.asking import Run, refused


def test_a_table_goes_in_and_comes_out_with_its_values(aemd: Run, tmp_path: Path) -> None:
    table, out_file, back = tmp_path / "log.csv", tmp_path / "log.mcap", tmp_path / "back.csv"
    table.write_text("time,value,temperature\n0.000,1.25,20.5\n0.125,-2.5,20.6\n0.250,3.75,20.7\n")

    assert aemd("import", table, "-o", out_file, "--unit", "mV")[0] == 0
    assert aemd("replay", out_file)[0] == 0
    assert aemd("export", out_file, "-o", back)[0] == 0

    read = np.genfromtxt(back, delimiter=",", names=True)
    assert read.dtype.names[:7] == ("index", "time_s", "value_V", "status", "estimate_V", "sigma_V", "window")
    assert read["value_V"].tolist() == [0.00125, -0.0025, 0.00375]
    assert read["time_s"].tolist() == [0.0, 0.125, 0.25]
    assert json.loads(aemd("info", out_file, "--json")[1])["topics"]["/witness/temperature"] == 3


TABLES = {
    "empty": b"",
    "no header": b"0.0,1.0\n0.1,2.0\n",
    "one column": b"time\n0.0\n0.1\n",
    "other names": b"t,v\n0.0,1.0\n0.1,2.0\n",
    "a word for a number": b"time,value\n0.0,1.0\n0.1,lots\n",
    "a word for a time": b"time,value\n0.0,1.0\nnoon,2.0\n",
    "times that stand still": b"time,value\n0.0,1.0\n0.0,2.0\n",
    "times that go back": b"time,value\n1.0,1.0\n0.5,2.0\n",
    "a row too short": b"time,value\n0.0,1.0\n0.1\n",
    "a row too long": b"time,value\n0.0,1.0\n0.1,2.0,3.0\n",
    "header only": b"time,value\n",
    "binary": bytes(range(256)) * 4,
    "a column twice": b"time,value,value\n0.0,1.0,1.0\n0.1,2.0,1.0\n",
}


@pytest.mark.parametrize("name", TABLES)
def test_a_broken_table_is_refused(name: str, aemd: Run, tmp_path: Path) -> None:
    table, out_file = tmp_path / "log.csv", tmp_path / "log.mcap"
    table.write_bytes(TABLES[name])

    code, out, err = aemd("import", table, "-o", out_file)

    assert str(table) in refused(code, err, out, 1)
    assert not list(tmp_path.glob("*.mcap*"))


def test_a_table_that_is_no_gzip_or_not_there_is_refused(aemd: Run, tmp_path: Path) -> None:
    table = tmp_path / "log.csv.gz"
    for content in (None, b"time,value\n0,1\n1,2\n"):
        if content is not None:
            table.write_bytes(content)
        code, out, err = aemd("import", table, "-o", tmp_path / "log.mcap")
        assert str(table) in refused(code, err, out, 1)
