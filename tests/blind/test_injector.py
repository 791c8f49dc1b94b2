"""The injector and its certificates against formulas and against numpy's dense linear algebra."""

import ast
from dataclasses import replace
from math import exp, log, pi, sqrt
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize

from aemd.record.reader import Recording
from tests.blind.certificate import KINDS, clairvoyant_d95, d_nats, size_for
from tests.blind.envelope import OUTSIDE, RANGES, SINGLE, Mix, draw, draw_plant, draw_shape
from tests.blind.files import START_NS, write_csv, write_mcap
from tests.blind.gaussian import numbers, spectrum, turns, whiten
from tests.blind.injector import AFTERWARDS, AT_INPUT, NOISE, make_record, template
from tests.blind.made import USUAL
from tests.blind.plant import Effect, Run, markov

PLANT = replace(USUAL, n=4000)
RUN = Run(PLANT, seed=11)


@pytest.mark.parametrize("name", ["injector.py", "plant.py"])
def test_the_injector_shares_no_code_with_the_package(name):
    tree = ast.parse(Path(__file__).with_name(name).read_text())
    modules = {
        module
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for module in ([node.module] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names])
    }

    assert modules <= {"collections.abc", "dataclasses", "math", "numpy", "tests.blind.plant"}


def test_the_recursion_in_blocks_is_the_recursion():
    n, step_s, tau_s, rate = 1000, 1e-3, 0.05, 0.3
    kicks = np.random.default_rng(5).standard_normal(1024 + 1)  # in the order of the draws: the start comes last
    sd, keep = rate * sqrt(tau_s / 2), exp(-step_s / tau_s)
    x, expected = sd * kicks[1024], []
    for kick in kicks[:n]:
        x = keep * x + sd * sqrt(1 - keep**2) * kick
        expected.append(x)

    assert markov(np.random.default_rng(5), n, step_s, tau_s, rate) == pytest.approx(np.array(expected), abs=1e-12)


def test_readings_have_the_variance_and_the_covariance_of_aperture_means():
    # As of any exponential covariance averaged over an aperture h: sd^2 2 (a - 1 + e^-a)/a^2, a = h/tau, and so on.
    plant = replace(PLANT, n=60_000, drift_rate_V_per_rt_s=1e-12, white_sd_V=5e-4)
    value = make_record(Run(plant, seed=3)).value_V
    a = plant.inside * plant.step_s / 0.5
    variance = 1e-6 * 2 * (a - 1 + exp(-a)) / a**2
    covariance = 1e-6 * ((1 - exp(-a)) / a) ** 2 * exp(a - plant.interval_s / 0.5)
    tolerance = 5e-6 * sqrt(2 * 0.5 / plant.interval_s * 2 / plant.n)

    assert value.var() == pytest.approx(variance + 25e-8, abs=tolerance)
    assert np.mean(value[1:] * value[:-1]) == pytest.approx(covariance, abs=tolerance)


def test_the_spectrum_of_the_certificate_is_that_of_readings():
    plant = replace(PLANT, n=8192, drift_tau_s=3.0)
    power = np.mean(
        [np.abs(np.fft.rfft(make_record(Run(plant, seed)).value_V)[1:4096]) ** 2 / plant.n for seed in range(12)],
        axis=0,
    )
    bands = np.array_split(power / spectrum(numbers(plant), plant), 16)

    assert [float(band.mean()) for band in bands] == pytest.approx([1.0] * 16, abs=5 / sqrt(12 * 256) + 0.01)


def test_a_line_shows_at_its_fold_with_what_the_aperture_leaves_of_it():
    rate_hz, f = 1 / PLANT.interval_s, 50.3
    shape = {"frequency_hz": f, "phase_rad": 0.4}
    run = replace(RUN, plant=replace(PLANT, aperture_s=0.01))
    seen = template(run, Effect("mains_alias", 1.0, shape))
    angle = 2 * pi * abs(f - rate_hz * round(f / rate_hz)) * np.arange(PLANT.n) * PLANT.interval_s
    amplitude = 2 * abs(np.mean(seen * np.exp(-1j * angle)))

    assert amplitude == pytest.approx(abs(np.sinc(f * run.plant.inside * run.plant.step_s)), rel=0.01)


def test_a_resonance_has_unit_variance_and_rings_for_its_quality():
    plant = replace(PLANT, n=60_000)
    seen = template(Run(plant, 5), Effect("resonance", 1.0, {"frequency_hz": 2.0, "quality": 5.0}))
    decay_s, lag = 5 / (pi * 2), 8
    lag_s = lag * plant.interval_s
    attenuated = np.sinc(2.0 * 0.02) ** 2
    tolerance = 5 * sqrt(2 * decay_s / (plant.n * plant.interval_s))

    assert seen.var() == pytest.approx(attenuated, abs=tolerance)
    expected = attenuated * exp(-lag_s / decay_s) * np.cos(2 * pi * 2 * lag_s)
    assert np.mean(seen[lag:] * seen[:-lag]) == pytest.approx(expected, abs=tolerance)


def test_whitening_is_that_of_the_dense_covariance():
    n, keep1, keep2, var1, var2, noise = 40, 0.8, 0.99, 2.0, 3.0, 0.5
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    covariance = var1 * keep1**lag + var2 * keep2**lag + noise * np.eye(n)
    y = np.random.default_rng(1).standard_normal(n)

    expected = np.linalg.solve(np.linalg.cholesky(covariance), y)
    assert whiten(y, keep1, keep2, var1, var2, noise) == pytest.approx(expected, rel=1e-9)


def test_d_of_a_line_is_a_quarter_of_its_power_ratio():
    # A^2 n / (4 S), with the folded density at its place: far above the knees no refit absorbs anything.
    f = 3.3
    effect = Effect("periodic_interference", 1e-4, {"frequency_hz": f, "phase_rad": 1.0})
    at = int(np.argmin(np.abs(turns(PLANT) - 2 * pi * f * PLANT.interval_s)))
    expected = (1e-4 * np.sinc(f * 0.02)) ** 2 * PLANT.n / (4 * spectrum(numbers(PLANT), PLANT)[at])

    assert d_nats(RUN, effect) == pytest.approx(expected, rel=0.03)


def test_d_of_a_changed_variance_in_half_the_record_is_its_expansion():
    # n (d ln s^2)^2 / 16 for a half of the record, where white noise is nearly all there is.
    plant = replace(PLANT, signal_sd_V=1e-6, drift_rate_V_per_rt_s=1e-9)
    effect = Effect("changing_noise", 1.05, {"begin": 0.5, "end": 1.0})

    assert d_nats(Run(plant, 1), effect) == pytest.approx(PLANT.n * (2 * log(1.05)) ** 2 / 16, rel=0.02)


def test_d_of_difference_noise_is_the_mean_log_ratio_of_the_likelihoods():
    # In white noise alone; the best base is the one white level with the same variance, so D has a closed form.
    plant = replace(PLANT, signal_sd_V=1e-7, drift_rate_V_per_rt_s=1e-10)
    ratio = 0.05
    s = 1 + ratio * (2 - 2 * np.cos(turns(plant)))
    expected = plant.n / 2 * (log(np.mean(s)) - np.mean(np.log(s)))
    effect = Effect("difference_noise", plant.white_sd_V * sqrt(ratio))

    assert d_nats(Run(plant, 1), effect) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(
    "effect",
    [
        Effect("warmup_drift", 2e-2, {"tau_s": 20.0}),
        Effect("step", 6e-3, {"time_s": 90.0}),
        Effect("difference_noise", 6e-4),
    ],
    ids=lambda effect: effect.cause,
)
def test_d_is_what_a_fit_with_the_effect_gains_over_one_without(effect):
    # Fits to drawn readings by the exact likelihood; the mean of a few gains lies about D within their scatter, about
    # sqrt(2 D) each, and the half nats that the free numbers of either side bring.
    run = Run(replace(PLANT, n=1500), 0)
    gains = []
    for seed in range(5):
        drawn = replace(run, seed=seed)
        with_it, without = (make_record(replace(drawn, effects=effects)).value_V for effects in ((effect,), ()))
        if effect.cause == "difference_noise":  # known exactly: white noise of the plant, then that of the effect
            w = turns(run.plant)
            density = spectrum(numbers(run.plant), run.plant) + effect.size**2 * (2 - 2 * np.cos(w))
            power = np.abs(np.fft.rfft(with_it - with_it.mean())[1 : run.plant.n // 2]) ** 2 / run.plant.n
            best = least_loss(run.plant, power)
            gains.append(best - float(np.sum(np.log(density) + power / density)))
        else:
            gains.append(least_exact(run.plant, with_it) - least_exact(run.plant, without))
    d = d_nats(run, effect)

    assert np.mean(gains) == pytest.approx(d, abs=3 * sqrt(2 * d / 5) + 3)


def fitted(plant, loss):
    start = numbers(plant)
    results = [
        minimize(loss, start + shift, method="L-BFGS-B", bounds=[(v - 6, v + 6) for v in start]).fun
        for shift in (0.0, np.array([0.3, -0.3, 1.0, -1.0, 0.1]))
    ]
    return min(results)


def least_loss(plant, power):
    def loss(theta):
        density = spectrum(theta, plant)
        return float(np.sum(np.log(density) + power / density))

    return fitted(plant, loss)


def least_exact(plant, y):
    def loss(theta):
        keeps = [exp(-plant.interval_s / exp(theta[j])) for j in (1, 3)]
        white, level = (whiten(column, *keeps, *np.exp(theta[[0, 2, 4]])) for column in (y, np.ones(plant.n)))
        scale = spectrum(theta, plant)  # the mean of its log is that of the innovations' variance (Kolmogorov)
        return float(white @ white - (white @ level) ** 2 / (level @ level)) / 2 + plant.n / 2 * float(
            np.mean(np.log(scale))
        )

    return fitted(plant, loss)


def test_a_size_is_found_for_a_d_and_none_where_there_is_none():
    line = Effect("periodic_interference", 1.0, {"frequency_hz": 3.3, "phase_rad": 1.0})
    sized = size_for(30.0, RUN, line, 1e-6, 1.0)

    assert sized is not None
    assert d_nats(RUN, sized) == pytest.approx(30.0, rel=0.05)
    assert size_for(30.0, RUN, line, 1e-9, 1e-8) is None


def test_a_clairvoyant_with_one_look_has_the_limit_of_a_single_test():
    # At 5 %, two-sided: (1.96 + 1.645)^2 / 2.
    assert clairvoyant_d95("difference_noise", 9000, level=0.05) == pytest.approx(6.5, abs=0.01)


def test_the_twin_without_the_effect_has_the_same_noise():
    effect = Effect("step", 1e-2, {"time_s": 100.0})
    with_it, without = (make_record(replace(RUN, effects=effects)).value_V for effects in ((effect,), ()))

    assert with_it - without == pytest.approx(template(RUN, effect) * 1e-2, abs=1e-15)


def test_a_gain_that_flickers_multiplies_what_is_counted_from_zero_volts():
    run = Run(replace(PLANT, n=1500, level_V=0.05), 3)
    with_it, without = (
        make_record(replace(run, effects=effects)).value_V
        for effects in ((Effect("signal_dependent_noise", 0.01),), ())
    )

    # 1 % of 50 mV, of which sqrt(1 / 3000) by chance; the input's own 1.4 mV would make 14 uV about its mean.
    assert np.std(with_it - without) == pytest.approx(5e-4, rel=0.08)


def test_an_envelope_depends_on_its_salt_and_ticket_alone():
    tickets = Mix(clean=1, rungs=0, singles=1, doubles=0, outside=0, below=0, gains=0).tickets()
    first, again = ([draw("salt", ticket) for ticket in order] for order in (tickets, tickets[::-1]))
    other = draw("pepper", tickets[0])

    assert [envelope.group for envelope in first] == ["clean", "single"]
    assert repr(first) == repr(again[::-1])  # NaN is not equal to itself
    assert first[0].run.seed != other.run.seed


def test_a_mix_has_as_many_envelopes_as_it_says():
    groups = [group for group, _ in Mix(5, 2, 3, 4, 6, 7, 8).tickets()]

    assert len(groups) == len(set(Mix(5, 2, 3, 4, 6, 7, 8).tickets())) == 5 + 2 * len(SINGLE) + 3 + 4 + 6 + 7 + 8
    assert groups.count("ladder") == 2 * len(SINGLE)


def test_every_cause_that_is_hidden_can_be_made_and_certified():
    made = {*AT_INPUT, *NOISE, *AFTERWARDS, "shock_law"}

    assert made == {*SINGLE, *OUTSIDE} == set(KINDS)


@pytest.mark.parametrize("cause", [cause for cause in (*SINGLE, *OUTSIDE) if KINDS[cause] != "counted"])
def test_every_effect_that_is_not_counted_has_a_d_that_grows_with_its_size(cause):
    plant = replace(PLANT, n=1000, shocks_per_s=0.2, shock_sd_V=1e-2, witness=True)
    shape = None
    for seed in range(99):
        shape = draw_shape(np.random.default_rng(seed), plant, cause) if shape is None else shape
    size = {"nonlinearity": 50.0, "supply_coupling": 5.0, "changing_noise": 2.0}.get(
        cause, 0.3 if cause in RANGES else 1e-2
    )
    small, large = (d_nats(Run(plant, 1), Effect(cause, factor * size, shape)) for factor in (1.0, 1.5))

    assert 0 < small < large
    assert np.isfinite(large)


def test_both_files_hold_the_record(tmp_path):
    plant = replace(draw_plant(np.random.default_rng(1)), n=500, witness=True, lost_fraction=0.1)
    record = make_record(Run(plant, 2))
    write_csv(record, tmp_path / "a.csv")
    write_mcap(record, tmp_path / "a.mcap", plant.interval_s)
    table = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    with Recording(tmp_path / "a.mcap") as recording:
        batches = list(recording.batches())
    readings = np.concatenate([batch.readings for batch in batches])
    witnesses = {
        name: np.concatenate([batch.witnesses[name]["value"] for batch in batches if name in batch.witnesses])
        for name in ("temperature", "supply")
    }

    assert table[:, 1].tolist() == readings["value_V"].tolist() == record.value_V.tolist()
    assert table[:, 0] == pytest.approx(record.time_s, abs=1e-9)
    assert ((readings["t_ns"] - START_NS) * 1e-9).tolist() == pytest.approx(record.time_s.tolist(), abs=1e-9)
    assert readings["index"].tolist() == record.index.tolist()
    for name, column in witnesses.items():
        assert column.tolist() == record.witnesses[name][1].tolist()
