"""The extended model goes through its file, makes readings like those it was fitted to, and is then not criticised."""

import numpy as np
import pytest

from aemd.diagnose import criticise, diagnose, format_diagnosis, model_of, write_extended
from aemd.diagnose.climb import assemble
from aemd.diagnose.fit import fit_base, residuals
from aemd.diagnose.given import Given, accept
from aemd.diagnose.hypothesis import Base, base_box, make_data
from aemd.diagnose.result import Value
from aemd.diagnose.terms.events import Popcorn, RingDown
from aemd.diagnose.terms.noise import ChangingNoise, DifferenceNoise, Resonance, Smoothing
from aemd.diagnose.translate import to_model
from aemd.model import Resonance as Swinging
from aemd.model import Shocks, Sine
from aemd.simulate import read_model, simulate
from tests.diagnose.plant import INTERVAL_S, clean, series, times


def test_the_extended_model_is_a_file_that_simulate_takes_and_it_shows_the_same_line(tmp_path):
    y = clean(1) + 0.4e-3 * np.sin(2 * np.pi * 3.3 * times())
    diagnosis = criticise(series(y, aperture_s=0.02))
    write_extended(diagnosis, tmp_path / "m.toml")
    simulate(
        tmp_path / "m.toml",
        seconds=270,
        seed=5,
        out=tmp_path / "a.mcap",
        interval_s=INTERVAL_S,
        aperture_s=0.02,
    )
    (again,) = diagnose(tmp_path / "a.mcap").findings

    assert read_model(tmp_path / "m.toml") == model_of(diagnosis)
    assert again.cause == "periodic_interference"
    assert again.parameters["frequency_hz"].value == pytest.approx(3.3, abs=0.002)
    assert again.parameters["amplitude_V"].value == pytest.approx(0.4e-3, rel=0.2)


def test_a_line_keeps_its_phase_on_the_way_through_the_model():
    """The model's own mean over apertures that begin half of one before the readings is the planted sine."""
    y = clean(2) + 1e-3 * np.cos(2 * np.pi * 3.3 * times() + 0.4)
    made = model_of(criticise(series(y, aperture_s=0.02)))
    (sine,) = [term for term in made.terms if isinstance(term, Sine)]
    start_s = times()[:100]

    np.testing.assert_allclose(
        sine.average(start_s, 0.02), 1e-3 * np.cos(2 * np.pi * 3.3 * start_s + 0.4), atol=0.15e-3
    )


def test_mains_that_the_aperture_would_remove_are_carried_as_their_alias():
    y = clean(3) + 0.5e-3 * np.cos(2 * np.pi * 50.0 * times() + 0.4)
    made = model_of(criticise(series(y, aperture_s=0.02)))
    (sine,) = [term for term in made.terms if isinstance(term, Sine)]

    assert sine.frequency_hz == pytest.approx(50.0 - 3 * 14.9, abs=0.002)
    np.testing.assert_allclose(
        sine.average(times()[:100], 0.02), 0.5e-3 * np.cos(2 * np.pi * 50.0 * times()[:100] + 0.4), atol=0.1e-3
    )


def test_the_base_alone_is_the_base_model():
    diagnosis = criticise(series(clean(4)))

    assert model_of(diagnosis) == model_of(diagnosis, extended=False)
    assert not [term for term in model_of(diagnosis).terms if isinstance(term, Sine | Swinging)]


def test_the_report_gives_the_verdict_first_and_two_lines_a_finding():
    y = clean(5) + 0.4e-3 * np.sin(2 * np.pi * 50.0 * times())
    lines = format_diagnosis(criticise(series(y))).splitlines()

    assert lines[0].startswith("1 finding")
    assert lines[2].startswith("Consistent with mains alias")
    assert lines[3].startswith("  Next: ")
    assert "caused" not in " ".join(lines)


def test_the_report_of_a_clean_record_claims_no_more_than_was_looked_for():
    text = format_diagnosis(criticise(series(clean(6))))

    assert text.startswith("Nothing found")
    assert "as far as was looked" in text


def test_an_extended_model_is_written_in_the_order_that_the_filter_has_and_can_be_stated():
    """A smoothing found first and noise that neighbours share second: the noise is written first, and accepted."""
    rng = np.random.default_rng(7)
    y = clean(7, 9_000) + 0.6e-3 * np.diff(rng.standard_normal(9_001))
    fit = fit_base(make_data(series(y)))
    theta = np.concatenate((fit.theta, Smoothing(0.4, 0.0).start, DifferenceNoise(1.0, 0.0).start))
    made, _ = to_model(residuals([*fit.terms, Smoothing(0.4, 0.0), DifferenceNoise(1.0, 0.0)], theta, fit.data), 0.02)

    assert [effect.effect for effect in made.effects] == ["difference_noise", "smoothing"]
    assert accept(made, "made")[0].stated is made


@pytest.mark.parametrize("changes", [(), (10.0, 120.0, 3.0), (10.0, 40.0, 3.0), (10.0, 120.0, 0.4), (10.0, 40.0, 0.4)])
def test_the_model_that_is_written_gives_the_filter_the_processes_and_the_noise_that_the_fit_has(changes):
    """Also where a process is as fast as the apertures, and where noise is louder, or less, for most of the record."""
    n, aperture_s = 2_000, 0.9 * INTERVAL_S
    data = make_data(series(clean(8, n), aperture_s=aperture_s))
    theta = np.array([np.log(0.06), 1.5, np.log(60.0), -1.0, np.log(0.4), 0.0])
    terms = [Base(theta, shocks=False, box=base_box(data)), *([ChangingNoise(*changes, 0.0)] if changes else [])]
    fit = residuals(terms, np.concatenate([term.start for term in terms]), data)
    written = Given(to_model(fit, aperture_s)[0], aperture_s)

    (_, fitted, _), (_, again, _) = (
        assemble(*which, data) for which in ((fit.terms, fit.theta), ([written], np.empty(0)))
    )

    assert again.noise_var == pytest.approx(fitted.noise_var, rel=1e-9)
    assert np.array(again.states) == pytest.approx(np.array(fitted.states), rel=1e-9)


def test_a_resonance_that_an_aperture_weakens_is_written_as_it_was_before_that():
    """Of 4 Hz the mean over 0.9 intervals leaves sinc(0.24), and the filter has what is left."""
    aperture_s = 0.9 * INTERVAL_S
    data = make_data(series(clean(8, 500), aperture_s=aperture_s))
    fit = fit_base(data)
    term = Resonance(4.0, 2.0, 20.0, 1.5, 0.0)
    made, _ = to_model(residuals([*fit.terms, term], np.concatenate((fit.theta, term.start)), data), aperture_s)
    (swinging,) = [part for part in made.terms if isinstance(part, Swinging)]
    kept = [state[3] for state in assemble([Given(made, aperture_s)], np.empty(0), data)[1].states if state[2] > 0]

    assert swinging.sd_V == pytest.approx(1.5 * data.unit_V / np.sinc(4.0 * aperture_s), rel=2e-3)
    assert kept == pytest.approx([1.5, 1.5], rel=1e-3)


RINGS = (RingDown(np.zeros(500), 2.0, 0.5, (0.3, 0.4), 0.0), RingDown(np.zeros(500), 3.0, 1.5, (0.0, 0.2), 0.0))


def rung(*terms, shocks=True):
    """Return the fit of these terms as they begin, beside shocks."""
    data = make_data(series(clean(8, 500)))
    theta = fit_base(data).theta[:6]
    law = np.log([0.05, 8.0, 0.3]) if shocks else []
    base = Base(np.append(theta, law), shocks=shocks, box=(*base_box(data), *[(-9.0, 9.0)] * len(law)))
    return residuals([base, *terms], np.concatenate([term.start for term in (base, *terms)]), data)


def the_ring_of(fit, told):
    made, without = to_model(fit, 0.02, told)
    return [
        (term.ring_fraction, term.ring_hz, term.ring_decay_s) for term in made.terms if isinstance(term, Shocks)
    ], without


def test_of_two_rings_the_louder_is_written_and_the_other_is_said_to_be_left_out():
    told = {2: {"ratio": Value(0.7, 0.6, 0.8, ""), "decay_s": Value(1.4, 1.3, 1.5, "s")}}

    assert the_ring_of(rung(*RINGS), {}) == ([(pytest.approx(0.5), 2.0, pytest.approx(0.5))], ("ring_down",))
    assert the_ring_of(rung(*RINGS), told) == ([(0.7, 3.0, 1.4)], ("ring_down",))
    assert the_ring_of(rung(RINGS[1], RINGS[1]), {}) == ([(pytest.approx(0.2), 3.0, pytest.approx(1.5))], ())
    assert the_ring_of(rung(RINGS[1]), {}) == ([(pytest.approx(0.2), 3.0, pytest.approx(1.5))], ())


def test_what_rings_without_shocks_or_after_a_level_that_jumps_is_left_out():
    assert the_ring_of(rung(RINGS[0], shocks=False), {}) == ([], ("ring_down",))
    assert the_ring_of(rung(RINGS[0], Popcorn(1.0, 5.0, 5.0, 0.0)), {}) == ([], ("ring_down",))
