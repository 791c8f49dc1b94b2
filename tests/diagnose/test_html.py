"""The page stands alone and shows each finding."""

import re
from dataclasses import replace

import numpy as np
import pytest

from aemd.diagnose import diagnose, write_html
from aemd.diagnose.curves import after_jumps, folded, level_changes, levels, running_deviation, unwound
from aemd.errors import RecordingError
from tests.diagnose.plant import INTERVAL_S, clean, times


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


@pytest.mark.parametrize(
    "curve",
    [after_jumps, running_deviation, folded(3.0), level_changes(50.0, 5.0), levels(1.0, 5e-3), unwound(3.3, 1e-4)],
)
def test_each_picture_has_as_many_abscissas_as_ordinates_and_no_gaps(curve):
    x, y = curve(clean(1), INTERVAL_S)

    assert x.size == y.size > 10
    assert np.isfinite(y).all()
    assert (np.diff(x) > 0).all()


def test_a_sweeping_line_stands_still_once_unwound():
    t = times()
    y = clean(1) + 1e-3 * np.sin(2 * np.pi * (3.3 + 0.5e-3 * t / 2) * t)
    f, power = unwound(3.3, 0.5e-3)(y, INTERVAL_S)

    assert f[np.argmax(power)] == pytest.approx(3.3, abs=2 / t[-1])


def test_a_step_is_a_triangle_of_its_height_with_its_top_at_its_time():
    t = np.arange(2000) * 0.1
    x, change = level_changes(120.0, 5.0)(np.where(t >= 120, 3e-3, 0.0) + 1.0, 0.1)

    assert change == pytest.approx(3e-3 * np.maximum(1 - np.abs(x - 120) / 5, 0), abs=1e-12)


def test_what_has_no_name_is_shown_where_its_residuals_are_off(diagnosis, tmp_path):
    (line,) = diagnosis.findings
    nameless = replace(
        diagnosis,
        verdict="unexplained",
        findings=(replace(line, cause="unexplained", names=("unexplained",), parameters={}),),
        extended_model=diagnosis.base_model,
    )
    write_html(nameless, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()

    low, high = re.search(r"[Aa]t ([0-9.]+) to ([0-9.]+) Hz,[a-z ,]* the residuals hold [0-9.]+ times", page).groups()
    assert float(low) < 3.3 < float(high) < float(low) + 1
    assert "residuals of the model with all that has a name" in page


def test_residuals_of_two_that_have_no_name_are_shown_once(diagnosis, tmp_path):
    (line,) = diagnosis.findings
    nameless = replace(line, cause="unexplained", names=("unexplained",), parameters={})
    write_html(replace(diagnosis, findings=(nameless, nameless)), tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()

    assert page.count("<img") == 2
    assert "What the residuals show is with finding 1." in page


def test_a_page_that_cannot_be_written_is_one_line(diagnosis, tmp_path):
    with pytest.raises(RecordingError, match="cannot be written"):
        write_html(diagnosis, tmp_path / "nowhere" / "page.html")
