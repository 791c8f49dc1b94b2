"""The shocks themselves: whether their signs are even, and whether they come alone."""

from dataclasses import dataclass
from math import log, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, binomtest, norm

from aemd.diagnose.evidence import Evidence, bonferroni
from aemd.diagnose.fit import Fit, densities
from aemd.diagnose.given import Given
from aemd.diagnose.kernels import MARKOV
from aemd.diagnose.terms.events import ShockLaw
from aemd.diagnose.terms.noise import SignalDependentNoise
from aemd.model import Shocks

__all__ = ["Marks", "check_shock_law", "coins_tail", "marks_of"]

Floats = NDArray[np.float64]

_CLEAR = 4.5
"""Deviations of the undisturbed innovation from which a reading is surely struck: seven in a million by chance."""
_SAME = 3
"""Readings within which two marks are of one shock, cut by an aperture or faded not quite as the base has it."""
_LEAST = 5
_CLOSE = (0.03, 0.1, 0.3)
"""Gaps, in mean gaps, below which there should not be too many."""
_NUDGE = 1e-4
"""Bias by which the scores are differenced."""
_WORTH_A_FIT = 0.05
_HARDLY = 1.5
"""Deviations of a sum below which its law may be normal."""
_LATTICE = 300
"""Steps in what was observed."""
_MOST_COINS = 200
_SMALL = 0.03
"""Of the largest; what is smaller adds a normal number."""


@dataclass(frozen=True, slots=True)
class Marks:
    """Readings that were surely struck."""

    at: NDArray[np.int64]
    size: Floats
    """By how much the reading moved the shock's state, in scaled units."""


def marks_of(fit: Fit) -> Marks | None:
    """Return the shocks; None where the model has none."""
    at_state = [
        number for number, row in enumerate(fit.states) if row[0] == MARKOV and row[3] == 0 and row[4] == 0 and row[5]
    ]
    if not at_state:
        return None
    struck = fit.data.used & (np.abs(fit.innovation) > _CLEAR * np.sqrt(fit.variance))
    at = np.flatnonzero(struck)
    at = at[np.concatenate(([True], np.diff(at) > _SAME))] if at.size else at
    return Marks(at, fit.gains[at, at_state[0]] * fit.innovation[at])


def check_shock_law(fit: Fit) -> list[Evidence]:
    """Weigh the shocks' signs, and count the gaps between them that are short."""
    marks = marks_of(fit)
    if marks is None:
        return []
    if _is_skew(fit):
        return _close(fit, marks)
    even = _positive_part(fit)
    if marks.at.size < _LEAST:  # none of so few is a law
        return [_evidence_of_signs(1.0, 0.0, 0.0, ())] if even == 0.5 else []
    found = [_weighed(fit)] if even == 0.5 else [_counted(marks, even)]
    return [*found, *_close(fit, marks)]


def _is_skew(fit: Fit) -> bool:
    """Return whether a noise that grows with the reading was found.

    A reading that the input's news lifted has more of it, so innovations are skew without any shock, and signs are no
    fair coins.
    """
    return any(isinstance(term, SignalDependentNoise) for term in fit.terms)


def _weighed(fit: Fit) -> Evidence:
    """Return the score of the bias of the shocks' signs, over all readings by what each tells of it.

    A reading's score is odd in its innovation given the readings before, and its density is even: so given their sizes
    the scores' signs are fair coins, and the law of their sum is exact whatever the sizes are.
    """
    law = ShockLaw(0.0, 0.0)
    terms = [*fit.terms, law]
    up, down = (densities(terms, np.append(fit.theta, bias), fit.data) for bias in (_NUDGE, -_NUDGE))
    scores = ((up - down) / (2 * _NUDGE))[fit.data.used]
    information = float(scores @ scores)
    if information <= 0:
        return _evidence_of_signs(1.0, 0.0, 0.0, ())
    score = float(scores.sum())
    p_value = min(1.0, 2 * coins_tail(np.abs(scores), abs(score)))
    bias = float(np.clip(score / information, -0.95, 0.95))
    cost = 0.5 * log(max(information, 1.0))
    return _evidence_of_signs(
        p_value, score, sqrt(information), (ShockLaw(bias, cost),) if p_value < _WORTH_A_FIT else ()
    )


def _evidence_of_signs(p_value: float, score: float, deviation: float, terms: tuple[ShockLaw, ...]) -> Evidence:
    return Evidence(
        check="excess of positive over negative shocks, by the readings' odds",
        p_value=p_value,
        observed=score,
        low=-1.96 * deviation,
        high=1.96 * deviation,
        terms=terms,
    )


def coins_tail(sizes: Floats, observed: float) -> float:
    """Return P(sum of +-sizes >= observed) for fair coins.

    The large ones are summed on a lattice, exactly but for its step; all that the small ones add is normal.

    >>> round(coins_tail(np.ones(10), 10.0) * 2**10, 6)
    1.0
    """
    deviation = sqrt(float(sizes @ sizes))
    if observed < _HARDLY * deviation:
        return float(norm.sf(observed / max(deviation, 1e-300)))
    largest = float(sizes.max())
    step = largest / np.ceil(largest / max(observed / _LATTICE, largest / _LATTICE))  # sure shocks are of one size
    large = np.rint(np.sort(sizes)[::-1][:_MOST_COINS] / step).astype(np.int64)
    large = large[large > _SMALL / step * largest]
    rest = sqrt(float(np.sum(np.sort(sizes)[::-1][large.size :] ** 2)))
    reach = int(large.sum())
    law = np.zeros(2 * reach + 1)
    law[reach] = 1.0
    for size in large:
        law = 0.5 * (np.roll(law, size) + np.roll(law, -size))  # what would come round has no probability yet
    beyond = observed - step * np.arange(-reach, reach + 1)
    if rest <= step:
        return float(law[beyond <= 0.5 * step].sum())
    return float(law @ norm.sf(beyond / rest))


def _counted(marks: Marks, even: float) -> Evidence:
    """Count the sure shocks' signs, of which a part that is not half should be positive."""
    count, positive = marks.at.size, int(np.count_nonzero(marks.size > 0))
    p_value = float(binomtest(positive, count, even).pvalue)
    bias = float(np.clip(2 * positive / count - 1, -0.95, 0.95))
    return Evidence(
        check="part of the shocks that are positive",
        p_value=p_value,
        observed=positive / count,
        low=float(binom.ppf(0.025, count, even)) / count,
        high=float(binom.ppf(0.975, count, even)) / count,
        terms=(ShockLaw(bias, 0.5 * log(count)),) if p_value < _WORTH_A_FIT else (),
    )


def _close(fit: Fit, marks: Marks) -> list[Evidence]:
    """Count the short gaps between shocks."""
    if marks.at.size < _LEAST:
        return []
    count = marks.at.size
    # Of so many instants anywhere in the record, a gap exceeds the part x of it with probability (1 - x)^count; that
    # they share the record makes counts of short ones scatter less than binomially.
    gaps = np.diff(fit.data.t_s[marks.at]) / fit.data.span_s
    tries = []
    for close in _CLOSE:
        dead = (_SAME + 1) * fit.data.interval_s / fit.data.span_s
        share = 1 - (1 - max(close / count, dead)) ** count
        seen = int(np.count_nonzero(gaps < max(close / count, dead)))
        tries.append((float(binom.sf(seen - 1, gaps.size, share)), seen, share))
    p_value, seen, share = min(tries)
    return [
        Evidence(
            check="shocks that follow one another closely",
            p_value=bonferroni(p_value, len(_CLOSE)),
            observed=float(seen),
            low=float(binom.ppf(0.025, gaps.size, share)),
            high=float(binom.ppf(0.975, gaps.size, share)),
        ),
    ]


def _positive_part(fit: Fit) -> float:
    """Return the part of the shocks that the model has positive."""
    part = 0.5
    for number, term in enumerate(fit.terms):
        if isinstance(term, ShockLaw):
            part += float(fit.parts_of(number)[0]) / 2
        elif isinstance(term, Given):
            part = next((shocks.positive_fraction for shocks in term.stated.terms if isinstance(shocks, Shocks)), part)
    return float(np.clip(part, 1e-6, 1 - 1e-6))
