"""The page stands alone and shows each finding."""

import numpy as np
import pytest

from aemd.diagnose import diagnose, write_html
from aemd.errors import RecordingError
from tests.diagnose.plant import clean, times


@pytest.fixture
def diagnosis(tmp_path):
    y = clean(1) + 0.4e-3 * np.sin(2 * np.pi * 3.3 * times())
    rows = "\n".join(f"{t:.4f},{v:.9f}" for t, v in zip(times(), y, strict=True))
    (tmp_path / "log.csv").write_text("time,value\n" + rows + "\n")
    return diagnose(tmp_path / "log.csv")


def test_the_page_needs_nothing_but_itself_and_has_a_picture_for_each_finding(diagnosis, tmp_path):
    write_html(diagnosis, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()

    assert page.count("<img") == 1 + len(diagnosis.findings) == 2
    assert 'src="data:image' in page
    assert "http" not in page.replace("http://www.w3.org", "")
    assert "Consistent with periodic interference" in page


def test_a_page_that_cannot_be_written_is_one_line(diagnosis, tmp_path):
    with pytest.raises(RecordingError, match="cannot be written"):
        write_html(diagnosis, tmp_path / "nowhere" / "page.html")
