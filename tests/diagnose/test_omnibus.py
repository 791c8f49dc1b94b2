"""What is outside the catalogue is noticed and told where it is and what it looks like; white noise is left alone."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from aemd.diagnose import criticise
from aemd.diagnose.checks.bursts import check_teeth, check_tracks
from aemd.diagnose.checks.omnibus import check_course, check_echo, check_hump
from aemd.diagnose.fit import fit_base
from aemd.diagnose.hypothesis import make_data
from tests.diagnose.plant import INTERVAL_S, N, clean, series, times

CHECKS = (check_tracks, check_teeth, check_hump, check_echo, check_course)
ACTED_ON = 1e-4
"""About Holm's first share of 0.3 %."""


@pytest.fixture(scope="module")
def fit():
    return fit_base(make_data(series(clean(3))))


def white(seed):
    return np.random.default_rng([seed, 90]).standard_normal(N)


def drawn(fit, z):
    return replace(fit, z=z)


def worth(shape, nats):
    """The shape with an energy of twice so many nats: what a filter matched to it would show."""
    return shape * np.sqrt(2 * nats / np.sum(shape**2))


def numbers(text):
    return [float(number) for number in re.findall(r"\d+\.?\d*", text)]


@pytest.mark.parametrize("check", CHECKS)
def test_white_residuals_are_below_five_percent_no_more_often_than_that(fit, check):
    tries = 15
    low = sum(check(drawn(fit, white(seed))).p_value < 0.05 for seed in range(tries))

    assert binom.sf(low - 1, tries, 0.05) > 1e-3


@pytest.mark.parametrize(("first_hz", "last_hz"), [(0.8, 5.5), (4.0, 4.0), (6.0, 2.0)])
def test_a_tone_for_a_while_is_found_where_it_is(fit, first_hz, last_hz):
    since = times() - 100.0
    inside = (since > 0) & (since < 30.0)
    angle = 2 * np.pi * (first_hz * since + (last_hz - first_hz) / 60.0 * since**2)
    evidence = check_tracks(drawn(fit, white(1) + worth(inside * np.sin(angle), 50.0)))

    assert evidence.p_value < ACTED_ON
    *hertz, begin_s, end_s = numbers(evidence.looks)
    assert 80.0 < begin_s < 115.0 < end_s < 150.0
    middle_hz = np.interp(115.0, (begin_s, end_s), (hertz[0], hertz[-1]))
    assert middle_hz == pytest.approx((first_hz + last_hz) / 2, abs=0.6)
    assert ("runs" in evidence.looks) == (first_hz != last_hz)


def saw(fit, begins, length):
    """What the filter leaves of teeth that begin at these readings."""
    shape = np.zeros(N)
    for begin in begins:
        shape[begin : begin + length] = np.arange(length) / length - 0.5
    return worth(fit.whitened(shape), 50.0)


def test_some_even_teeth_of_a_saw_are_found_and_uneven_ones_are_not(fit):
    even = check_teeth(drawn(fit, white(2) + saw(fit, range(1500, 1740, 40), 40)))
    uneven = check_teeth(drawn(fit, white(2) + saw(fit, (1500, 1553, 1611, 1690, 1782, 1851), 40)))

    assert even.p_value < ACTED_ON < 10 * ACTED_ON < uneven.p_value
    count, each_s, begin_s = numbers(even.looks)
    assert count in (4, 6)
    assert each_s == pytest.approx(40 * INTERVAL_S, abs=0.5 * INTERVAL_S)
    assert begin_s == pytest.approx(1500 * INTERVAL_S, abs=120 * INTERVAL_S)


def test_a_hump_is_found_and_one_shock_that_is_much_louder_is_none(fit):
    since = times() - 120.0
    bell = np.exp(-0.5 * (since / 4.0) ** 2)
    shock = np.where(since >= 0, np.exp(-np.maximum(since, 0) / 1.5), 0.0)
    hump, blow = (
        check_hump(drawn(fit, white(3) + worth(fit.whitened(shape), nats)))
        for shape, nats in ((bell, 40.0), (shock, 150.0))  # of which a bell alone would see 4e-10
    )

    assert hump.p_value < ACTED_ON
    assert hump.terms[0].centre_s == pytest.approx(120.0, abs=3.0)
    assert blow.p_value > 0.01


def test_an_echo_shows_with_its_share_times_the_root_of_the_readings(fit):
    z = white(4)
    z[25:] += 0.2 * z[:-25]
    evidence = check_echo(drawn(fit, z))

    assert evidence.observed == pytest.approx(0.2 * np.sqrt(N), abs=3.0)
    assert numbers(evidence.looks)[-1] == pytest.approx(25 * INTERVAL_S, rel=0.01)


def test_noise_that_breathes_shows_in_the_course_of_its_squares(fit):
    """Of a relative swing d in the variance, chi-square is 12 + n d^2 / 4, less what limited squares leave out."""
    part = np.arange(N) / N
    z = white(5) * np.sqrt(1 + 0.3 * np.cos(2 * np.pi * 4 * part))
    evidence = check_course(drawn(fit, z))

    assert evidence.observed * 12 == pytest.approx(12 + N * 0.3**2 / 4, rel=0.4)
    assert evidence.p_value < ACTED_ON
    assert evidence.terms[0].turns == 4.0
    assert "4 times" in evidence.looks


def test_a_breathing_noise_is_told_as_such_with_its_size():
    n = 2_000
    rng, part = np.random.default_rng(62), np.arange(n) / n
    y = clean(62, n, white=0.0) + 1e-3 * np.exp(0.4 * np.sin(2 * np.pi * 3 * part)) * rng.standard_normal(n)
    (finding,) = criticise(series(y)).findings

    assert finding.names == ("unexplained",)
    assert "swells and fades evenly, most like changing noise" in finding.experiment
    assert finding.parameters["ratio"].value == pytest.approx(np.exp(0.4), rel=0.15)
    assert finding.parameters["period_s"].value == pytest.approx(n * INTERVAL_S / 3, rel=0.01)


def test_an_echo_is_told_as_such():
    y = clean(8)
    y[30:] += 0.25 * (y[:-30] - 1.0)
    (finding,) = criticise(series(y)).findings

    assert finding.names == ("unexplained",)
    assert f"{30 * INTERVAL_S:.3g} s later" in finding.experiment


@pytest.mark.parametrize("n", [100, 144])
def test_the_shortest_records_that_are_judged_have_nothing_outside_the_catalogue(n):
    """They are too short for the narrowest hump, and for the shortest track."""
    short = fit_base(make_data(series(clean(9, n))))

    assert min(check(short).p_value for check in CHECKS) > ACTED_ON
