"""A stated model's own figures: which of them could be wrong, and what is said of those that are."""

from math import exp, inf, isfinite, log

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.evidence import two_sided
from aemd.diagnose.fit import Fit
from aemd.diagnose.given import Given
from aemd.diagnose.hypothesis import Term
from aemd.diagnose.intervals import describe
from aemd.diagnose.result import Discrepancy
from aemd.diagnose.terms.stated import OtherFigures, other_figures

__all__ = ["compare_figures", "remark_on", "rival_figures"]

Floats = NDArray[np.float64]


def rival_figures(fit: Fit) -> list[Term]:
    """Return the parts of a stated model whose own figures could be what is wrong."""
    given = fit.terms[0]
    assert isinstance(given, Given)  # noqa: S101 - what is stated is never fitted
    changed = {term.number for term in fit.terms if isinstance(term, OtherFigures)}
    return [term for term in other_figures(given, fit.data.n) if term.number not in changed]


def remark_on(term: Term) -> str:
    """Return what is to be said of the figures of a stated model."""
    return f"The {term.what} has other figures than the stated model has" if isinstance(term, OtherFigures) else ""


def compare_figures(fit: Fit, number: int, spread: Floats) -> list[Discrepancy]:
    """Return each refitted figure of a stated model beside where fits to simulations of what is stated would lie."""
    term = fit.terms[number]
    if not isinstance(term, OtherFigures):
        return []
    made = []
    fitted = describe(fit, number, spread)
    for parameter in term.parameters(fit.data):
        stated, value = parameter.value(term.start), fitted[parameter.name]
        if parameter.positive:
            reach = log(value.high / value.value) if isfinite(value.high) else inf
            low, high, away = stated * exp(-reach), stated * exp(reach), abs(log(value.value / stated))
        else:
            reach = value.high - value.value
            low, high, away = stated - reach, stated + reach, abs(value.value - stated)
        p_value = two_sided(1.96 * away / reach) if reach > 0 else 0.0
        what = f"{term.what} of the stated model: {parameter.name}, fitted"
        made.append(Discrepancy(what, value.value, low, high, p_value))
    return made
