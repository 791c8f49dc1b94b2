"""The likelihood over some blocks of a long record: what is thinned out first has the densities of what is not."""

from dataclasses import replace

import numpy as np
import pytest

from aemd.diagnose.climb import densities
from aemd.diagnose.hypothesis import Base, Data, Term, base_box, make_data
from aemd.diagnose.terms.events import RingDown
from aemd.diagnose.terms.lines import Sines
from aemd.diagnose.terms.noise import ChangingNoise, HeavyTails, Smoothing
from aemd.diagnose.terms.packets import Packet
from aemd.diagnose.terms.ranges import RangeSwitching
from aemd.diagnose.terms.shapes import Step
from aemd.diagnose.terms.witnessed import Latency, SupplyCoupling, ThermalDrift
from tests.diagnose.plant import clean, series

N = 4_000


def record() -> Data:
    """Return readings with a lost one here and there and a witness that wanders."""
    rng = np.random.default_rng(5)
    values = np.where(rng.random(N) < 0.01, np.nan, clean(5, N))
    data = make_data(series(values))
    return replace(data, witnesses={"temperature": np.cumsum(rng.standard_normal(N))})


def terms_of(data: Data) -> list[Term]:
    """Return terms of all kinds: of a reading's time, of its value, of what was before it."""
    marks = np.where(np.random.default_rng(6).random(N) < 0.02, 5.0, 0.0)
    return [
        RingDown(marks, 1.3, 0.7, (0.4, 0.2), 0.0),
        ThermalDrift("temperature", 20.0, 0.3, 0.0),
        Latency("temperature", 0.8, 0.2, known=False, cost_nats=0.0),
        SupplyCoupling("temperature", 0.002, 0.0),
        RangeSwitching(float(np.median(np.abs(data.y + data.origin_V / data.unit_V))), 0.0, 0.7, 0.5, 0.0),
        Sines("periodic_interference", 1.7, 1.5, (1, 2), (0.3, 0.2, 0.1, 0.1), 0.0),
        Packet(100.0, 3.0, 0.9, (1.0, 0.5), begins=False, cost_nats=0.0),
        Step(120.0, 1.0, 0.0),
        ChangingNoise(40.0, 160.0, 1.4, 0.0),
        HeavyTails(0.02, 4.0, 0.0),
        Smoothing(0.3, 0.0),
    ]


@pytest.mark.parametrize("number", range(11))
def test_blocks_of_a_record_are_as_likely_alone_as_within_it(number):
    data = record()
    base = Base(np.array([-0.7, 0.0, 4.0, -1.0, -0.3, 0.1]), shocks=False, box=base_box(data))
    terms: list[Term] = [base, terms_of(data)[number]]
    theta = np.concatenate([term.start for term in terms])
    some = data.sampled(8, 100)

    alone = densities(terms, theta, some)

    assert alone.size == 800
    assert alone == pytest.approx(densities(terms, theta, replace(some, thinned=None)), abs=1e-9)
