"""What the catalogue does not have is not given the name of what it happens to look like."""

import numpy as np
import pytest

from aemd.diagnose import criticise
from aemd.diagnose.checks.local import best_hump
from aemd.diagnose.fit import fit_base
from aemd.diagnose.hypothesis import make_data
from aemd.diagnose.naming import name
from aemd.diagnose.terms.lines import amplitude_cost
from aemd.diagnose.terms.shapes import Nonlinearity
from tests.diagnose.plant import INTERVAL_S, N, clean, series, times


def slow_wave(rng):
    """One and a half turns in the whole record are no period."""
    return 40.0 * np.sin(3 * np.pi * times() / times()[-1])


def swell(rng):
    """Noise that swells along a bell and never jumps."""
    return 1.5 * np.exp(-0.5 * ((times() - 150.0) / 15.0) ** 2) * rng.standard_normal(N)


def packet(rng):
    """A wave for some seconds is neither noise that changes nor a resonance, which swings all the time."""
    return 3.0 * np.exp(-(((times() - 100.0) / 3.0) ** 2)) * np.sin(2 * np.pi * 2.7 * times())


def beat(rng):
    """Two lines beside each other swing no more at random than one."""
    return 0.3 * np.sin(2 * np.pi * times() / 60) * np.sin(2 * np.pi * 4.4 * times())


def clusters(rng):
    """Shocks that set off others: the catalogue's come alone."""
    jumps = np.zeros(N)
    for begin in rng.uniform(0, N - 200, 7):
        np.add.at(jumps, (begin + np.cumsum(rng.exponential(0.4, 8)) / INTERVAL_S).astype(int), 8.0)
    jumps *= np.sign(rng.standard_normal(N))
    decayed = np.exp(-np.arange(60) * INTERVAL_S / 0.3)
    return np.convolve(jumps, decayed)[:N]


@pytest.mark.parametrize("shape", [slow_wave, swell, packet, clusters, beat])
def test_it_is_found_and_no_name_is_sure(shape):
    found = criticise(series(clean(5) + 1e-3 * shape(np.random.default_rng(77))))

    assert found.verdict == "unexplained"
    assert [f.names for f in found.findings if len(f.names) == 1 and f.cause not in ("unexplained", "shock_law")] == []


def test_a_hump_that_comes_once_is_no_bent_scale():
    """A bent scale answers a loud moment; so does a hump there, and it answers more."""
    y = clean(5) + 10e-3 * np.exp(-(((times() - 120.0) / 2.0) ** 2))
    fit = fit_base(make_data(series(y)))
    hump = best_hump(fit)
    found = name(fit, [Nonlinearity(0.01, amplitude_cost(1, N)), hump], 4.0)

    assert hump.centre_s == pytest.approx(120.0, abs=2.0)
    assert found.names == ("nonlinearity",)
    assert found.refused
