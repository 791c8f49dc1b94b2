"""A run that was interrupted goes on with what it had, and the oracle's likelihood is that of the dense covariance."""

import json
from dataclasses import asdict, replace
from math import exp, nan, sqrt

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from tests.blind import envelope as drawing
from tests.blind.certificate import d_nats
from tests.blind.envelope import RANGES, STRONG, Envelope, Mix, draw
from tests.blind.gaussian import numbers
from tests.blind.harness import ANSWERS, Answer, open_folder, shut
from tests.blind.injector import make_record
from tests.blind.made import USUAL
from tests.blind.oracle import filtered, oracle_gain, with_effect
from tests.blind.plant import Effect, Run
from tests.blind.report import write_report
from tests.blind.score import Pair, rung

PLANT = replace(USUAL, n=1500, interval_s=0.0684, aperture_s=0.01)


def test_a_run_goes_on_with_the_same_key_and_the_answers_that_are_whole(tmp_path):
    mix = Mix(clean=4, rungs=0, singles=0, doubles=0, outside=0, below=0, gains=0)
    hidden = Envelope(4, "ladder", Run(PLANT, 1, (Effect("step", 1e-3, {"time_s": 50.0}),)), ".csv", (nan,), 1.25)
    sealed = shut("salt", mix, [*(draw("salt", ticket) for ticket in mix.tickets()), hidden], tmp_path)
    answer = Answer(3, "explained", ({"cause": "step", "parameters": {}},), 1.5, ("heavy_tails",), (12.0, "step"))
    whole = json.dumps(asdict(answer))
    (tmp_path / ANSWERS).write_text(f"{whole}\n\n{whole[: len(whole) // 2]}")

    again = open_folder(tmp_path)

    assert again.key_hash == sealed.key_hash
    assert repr(again.envelopes) == repr(sealed.envelopes)  # NaN is not equal to itself
    assert [(number, got.findings[0]["cause"]) for number, got in again.answers.items()] == [(3, "step")]
    with pytest.raises(FileExistsError):
        shut("pepper", mix, [], tmp_path)


@pytest.mark.parametrize(
    "effect",
    [None, Effect("difference_noise", 4e-4), Effect("resonance", 8e-4, {"frequency_hz": 3.1, "quality": 20.0})],
    ids=["clean", "difference_noise", "resonance"],
)
def test_the_oracle_s_likelihood_is_that_of_the_dense_covariance(effect):
    plant = replace(PLANT, n=60)
    y = 1e-3 * np.random.default_rng(2).standard_normal(plant.n)
    y[[7, 8, 30]] = np.nan
    lag = np.abs(np.subtract.outer(np.arange(plant.n), np.arange(plant.n)))
    theta = numbers(plant)
    covariance = exp(theta[4]) * np.eye(plant.n)
    for j in (0, 2):
        covariance += exp(theta[j]) * np.exp(-lag * plant.interval_s / exp(theta[j + 1]))
    if effect and effect.cause == "difference_noise":
        covariance += effect.size**2 * (2 * (lag == 0) - 1.0 * (lag == 1))
    if effect and effect.cause == "resonance":
        seen, t_s = np.sinc(3.1 * plant.inside * plant.step_s), lag * plant.interval_s
        covariance += (effect.size * seen) ** 2 * np.exp(-np.pi * 3.1 / 20 * t_s) * np.cos(2 * np.pi * 3.1 * t_s)
    known = np.isfinite(y)
    expected = multivariate_normal(cov=covariance[np.ix_(known, known)]).logpdf(y[known])

    assert filtered(plant, theta, y, None, effect and with_effect(plant, effect)) == pytest.approx(expected, rel=1e-9)


def test_the_oracle_gains_what_the_certificate_says_within_its_scatter():
    # A log ratio whose mean is D scatters by sqrt(2 D); the base's six fitted numbers cost it some nats more.
    effect = Effect("periodic_interference", 2.6e-4, {"frequency_hz": 5.77, "phase_rad": 1.0})
    run = Run(PLANT, 3, (effect,))
    d = d_nats(run, effect)

    assert oracle_gain(run, effect, make_record(run)) == pytest.approx(d, abs=3 * sqrt(2 * d) + 6)


def one(factor, group="single", cause="step", said=()):
    run = Run(PLANT, 1, (Effect(cause, 1e-3, {"time_s": 50.0}),))
    findings = tuple(
        {"cause": name, "names": [name], "probability": 1.0, "p_value": 1e-9, "parameters": {}} for name in said
    )
    answer = Answer(0, "explained", findings, 1.0, (), (50.0, "warmup_drift"))
    return Pair(Envelope(0, group, run, ".csv", (50.0,), factor), answer)


def test_an_effect_that_reaches_no_whole_multiple_is_told_with_the_last_below_it():
    assert [rung(one(factor)) for factor in (0.0, 0.4, 1.6, 2.9, 4.2, 9.8, 10.0)] == [
        0.0,
        0.6,
        1.6,
        1.6,
        3.0,
        3.0,
        10.0,
    ]


def test_what_is_strong_is_owed_apart_from_what_is_at_the_limit():
    pairs = [one(3.0, said=["step"]), one(10.0, said=["warmup_drift"]), one(4.2), one(1.6), one(1.25, "ladder")]

    lines = write_report(pairs, sealed=5, salt="", key_hash="", covered=["step"]).splitlines()

    assert [line for line in lines if line.startswith("| found at 3 times and more | 2/3 66.7%")]
    assert [line for line in lines if line.startswith("| named first at 3 times and more, D_rival >= 10.8 | 1/2 50.0%")]
    assert [line for line in lines if line.startswith("| step | mean |  |  |  | 0/1 | 0/1 | 1/2 | 1/1 |")]


def test_a_strong_effect_that_no_plant_carries_is_the_largest_that_one_does(monkeypatch):
    monkeypatch.setattr(drawing, "PLANTS", 3)
    number = 5 * len(drawing.UNCOUNTED) + drawing.UNCOUNTED.index("shock_law")

    made = draw("salt", ("single", number))

    assert made.run.effects[0].size == RANGES["shock_law"][1]
    assert 0 < made.factor < STRONG
