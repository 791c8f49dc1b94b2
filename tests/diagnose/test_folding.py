"""Pulses that come back at even times are placed as sharply as a record allows, of which only the start is folded."""

from aemd.diagnose.checks import folding
from aemd.diagnose.checks.folding import check_periodic_glitch
from aemd.diagnose.fit import fit_base, residuals
from aemd.diagnose.hypothesis import make_data
from tests.diagnose.plant import INTERVAL_S, clean, series, times

LONG = 14_000


def test_the_period_is_known_to_a_part_of_a_reading_over_all_of_a_long_record(monkeypatch):
    monkeypatch.setattr(folding, "_LONG", 5_000)
    period_s, width_s, begin_s = 10.123457, 0.3, 2.0
    pulses = ((times(LONG) - begin_s) % period_s < width_s) * 2e-3
    y = clean(3, LONG)
    base = fit_base(make_data(series(y[:5_000], interval_s=INTERVAL_S)))
    fit = residuals(base.terms, base.theta, make_data(series(y + pulses)))
    found = check_periodic_glitch(fit)
    (term,) = found.terms

    assert found.p_value < 1e-9
    count = times(LONG)[-1] / period_s
    assert abs(term.period_s - period_s) * count < 0.5 * INTERVAL_S


def test_without_pulses_nothing_is_refined():
    found = check_periodic_glitch(fit_base(make_data(series(clean(4)))))

    assert found.p_value > 0.003
    assert found.terms == ()
