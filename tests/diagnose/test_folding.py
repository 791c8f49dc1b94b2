"""Pulses that come back at even times are placed as sharply as a record allows, of which only the start is folded."""

import numpy as np
import pytest

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


def test_four_pulses_are_a_train_and_two_are_none():
    y, t = clean(5, 1500), times(1500)
    train = (t - 3.0) % 25.0 < 0.2
    alone = train & (t > 20) & (t < 60)
    for pulses, size, low, high in ((train, 6e-3, 0.0, 1e-4), (alone, 2e-2, 1e-3, 1.0)):
        fit = fit_base(make_data(series(y)))
        found = check_periodic_glitch(residuals(fit.terms, fit.theta, make_data(series(y + size * pulses))))

        assert low <= found.p_value <= high


def test_a_train_of_pulses_between_whole_readings_is_followed_reading_by_reading():
    n, period, begin, width = 3000, 60.37, 7.3, 2.4
    struck = (np.arange(n) - begin) % period < width
    widths = np.arange(1, folding._WIDEST + 1)  # where the residuals are the readings, a pulse is a sum of so many
    matched = np.array([np.correlate(np.append(struck, np.zeros(width - 1)), np.ones(width)) for width in widths])
    sizes = np.sqrt(widths)
    best, *_ = folding._finer(matched, sizes, np.inf, 60.36, 7.0, 2.0)

    assert best == pytest.approx(np.sqrt(np.count_nonzero(struck)), rel=0.03)
