"""What the text of a report says: the right word for a line, ends that are open, what was not fitted."""

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest

from aemd.diagnose import Diagnosis, Finding, Gain, Value, format_diagnosis
from aemd.diagnose.fit import fit_base, residuals
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.intervals import describe
from aemd.diagnose.report import format_finding
from aemd.diagnose.terms.events import Popcorn
from aemd.diagnose.terms.noise import Resonance
from tests.diagnose.plant import clean, series

NOTHING = Gain(0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def base():
    return fit_base(make_data(series(clean(3, 400))))


@pytest.mark.parametrize(
    ("shown_hz", "words"),
    [(240.0, "hum of the mains at 4 times its frequency"), (60.0, "mains hum"), (0.4, "mains alias"), (5.3, "mains")],
)
def test_a_line_of_the_mains_is_an_alias_only_where_it_was_folded(shown_hz, words):
    """60 Hz at 14.9 /s shows at 0.4 Hz; at 1,706 /s it shows at 60 Hz, and its fourth harmonic at 240 Hz."""
    value = {"mains_hz": Value(60.0, 59.9, 60.1, "Hz"), "alias_hz": Value(shown_hz, shown_hz, shown_hz, "Hz")}

    assert format_finding(finding("mains_alias", value)).startswith(f"Consistent with {words}")


def test_of_many_harmonics_the_strongest_are_told_and_the_others_are_counted():
    sizes = {1: 3e-3, 2: 1e-3, 3: 5e-3, 4: 2e-3, 7: 4e-3}
    values = {f"amplitude_{number}_V": Value(size, size, size, "V") for number, size in sizes.items()}
    text = format_finding(finding("periodic_interference", values))

    assert "1st harmonic 3 mV, 3rd harmonic 5 mV, 7th harmonic 4 mV and 2 weaker ones; " in text


def test_a_prediction_error_is_told_where_it_has_become_smaller():
    worth = replace(finding("periodic_interference", {}), gain=Gain(0.1, 100.0, 80.0, 120.0), rms_before=2e-3)

    assert "prediction error 2 mV -> 1 mV rms" in format_finding(replace(worth, rms_after=1e-3))
    assert "prediction error" not in format_finding(replace(worth, rms_after=2.1e-3))


def test_what_was_not_fitted_is_told_apart_from_what_to_do_next():
    first, then = format_finding(
        finding("unexplained", {}, "strongest band looks most like resonance, which was not fitted; record again")
    ).splitlines()

    assert first.startswith("Unexplained: strongest band looks most like resonance, which was not fitted; p = ")
    assert then == "  Next: record again."


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (Value(62.2261, 55.5205, 69.7416, ""), "62.23 (55.52 to 69.74)"),
        (Value(62.2261, 55.5205, inf, "s"), "62.23 s (55.52 s or more)"),
        (Value(62.2261, 0.0, 69.7416, "s"), "62.23 s (69.74 s or less)"),
        (Value(1e-3, 0.0, inf, "V"), "1 mV (of any size)"),
        (Value(608.147039, 608.146, 608.148, "Hz"), "608.147 Hz (608.146 to 608.148)"),
        (Value(50.0119888, 50.0119664, 50.0120111, "Hz"), "50.011989 Hz (50.011966 to 50.012011)"),
        (Value(1.1e-3, 0.9e-3, 1.3e-3, "V"), "1.1 mV (900 µV to 1.3 mV)"),
        (Value(1.53e-6, nan, nan, "V"), "1.53 µV"),
        (Value(42463.74, 42463.74, 42463.74, "s"), "42,460 s"),
        (Value(42463.74, 42463.5, 42464.0, "s"), "42,463.7 s (42,463.5 to 42,464.0)"),
        (Value(-2081.3, -2210.0, -1960.0, "1/V"), "-2081 /V (-2210 to -1960)"),
    ],
)
def test_a_size_has_the_digits_that_its_interval_tells_and_says_which_end_is_open(value, words):
    assert f"quality {words}; " in format_finding(finding("resonance", {"quality": value}))


def test_a_number_whose_name_does_not_say_of_what_it_is_is_told_in_words():
    text = format_finding(finding("quantisation", {"ratio": Value(1.03, 1.03, 1.03, "")}))

    assert "step over what is new in a reading 1.03; p = 1e-09 over all places" in text


def test_a_probability_below_all_that_are_told_is_said_to_be():
    assert "p below 1e-290 over all places" in format_finding(replace(finding("step", {}), p_value=1e-300))


def test_an_interval_is_open_beyond_a_bound_that_the_fit_ended_at(base):
    """The quality is pi f tau; where tau ended at its longest, nothing longer was tried; the frequency stays."""
    term = Resonance(2.0, 4.0, 5.0, 1.0, 0.0)
    at_its_longest = np.array([np.log(5.0), 0.0, 0.0])
    fit = residuals([*base.terms, term], np.concatenate((base.theta, at_its_longest)), base.data)
    told = describe(fit, 1, np.diag(np.full(fit.theta.size, 1e-4)))

    assert told["quality"].value == pytest.approx(np.pi * 2.0 * 5.0)
    assert told["quality"].low < told["quality"].value
    assert told["quality"].high == inf
    assert 0 < told["frequency_hz"].low <= 2.0 <= told["frequency_hz"].high < inf


def test_the_interval_of_a_share_ends_at_all_of_it_at_most(base):
    """Stays of e^3 s above and 1 s below are a share of 0.95; by the delta method alone 0.18 more would be 1.15."""
    term = Popcorn(1e-3 / base.data.unit_V, 1.0, np.exp(3.0), 0.0)
    fit = residuals([*base.terms, term], np.concatenate((base.theta, term.start)), base.data)
    spread = np.diag(np.append(np.full(fit.theta.size - 1, 1e-12), 4.0))
    share = describe(fit, 1, spread)["fraction"]

    assert share.value == pytest.approx(1 / (1 + np.exp(-3.0)))
    assert share.low < share.value
    assert share.high == 1.0


def finding(cause: str, parameters: dict[str, Value], experiment: str = "look again") -> Finding:
    return Finding(
        cause=cause,
        names=(cause,),
        probability=1.0,
        p_value=1e-9,
        d_nats=20.0,
        parameters=parameters,
        gain=NOTHING,
        rms_before=1.0,
        rms_after=1.0,
        experiment=experiment,
    )


def test_a_doubted_name_is_told_with_the_reason_and_the_verdict_says_so():
    doubted = replace(finding("smoothing", {}), names=("smoothing", "unexplained"), probability=0.5, remark="because x")
    text = format_finding(doubted).splitlines()[0]
    sure = finding("resonance", {})

    assert text.startswith("Consistent with smoothing (50%), not told apart from something unexplained because x; p = ")
    assert verdict(doubted) == "1 finding, consistent with a mechanism of the catalogue, but perhaps something else."
    assert verdict(doubted, sure) == (
        "2 findings, each consistent with a mechanism of the catalogue, 1 of them perhaps something else."
    )
    assert verdict(sure) == "1 finding, consistent with a mechanism of the catalogue."


def verdict(*findings: Finding) -> str:
    return format_diagnosis(Diagnosis("explained", 100, 1.0, findings, (), {}, {}, 0.1)).splitlines()[0]
