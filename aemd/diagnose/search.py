"""The rounds: check what is left, fit what could explain it, add the best, until nothing is left or it costs too much.

Holm's procedure over the checks of a round, 0.3 % in the first and half as much in each further one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from math import exp

from aemd.diagnose.checks.local import best_hump, best_packets
from aemd.diagnose.checks.residuals import check_each
from aemd.diagnose.checks.witnessed import gains_like_noise
from aemd.diagnose.evidence import Evidence
from aemd.diagnose.figures import rival_figures
from aemd.diagnose.fit import Fit, restart_base
from aemd.diagnose.given import Given
from aemd.diagnose.hypothesis import Base, Term
from aemd.diagnose.naming import Named, name
from aemd.diagnose.rebased import rebased
from aemd.diagnose.redrawn import Redrawn
from aemd.diagnose.terms.courses import BreathingNoise
from aemd.diagnose.terms.noise import SwellingNoise

__all__ = ["LEAST_NATS", "Searched", "search"]

Progress = Callable[[str], None]

_LEVEL = 0.003
"""Family-wise probability of any finding on a clean record, first round."""
_OVERWHELMING = 1e-9
"""p of evidence that no law, however roughly it holds, is doubted for; and beside shocks, at each of which the filter
merges what it should keep apart, so many nats less a shock, far more than is lost."""
_LOST_A_SHOCK = 0.1
_MOST_LOST = 600.0
_MOST_FINDINGS, _FEWEST, _READ = 6, 3, 600_000
"""After so many terms the search stops and says so; on a record that has more, the first are worth the most by far. For
each one it goes through all readings some hundred times; so on a long record it stops after fewer, but for the first
few, where these times the readings are so many."""
_HEAVIEST = 8.0
_LIGHT = 1.4e7
"""Times the base's cost of a step of the fit, (states + 1)^2 free numbers, from which no term is added any more, unless
the step costs less than so many over all readings: each resonance brings two states and three numbers. A bound on work
and not on time, so that an answer does not depend on what else the machine does."""
LEAST_NATS = 4.0
"""Log-likelihood that a term must add to be called an explanation: what a check sees and no term can use is
`unexplained`."""
_HUMPED = ("nonlinearity", "popcorn_noise", "shock_law", "ring_down")
"""What one hump of the mean passes for: beside these it is fitted as well."""


@dataclass(frozen=True, slots=True)
class Searched:
    """What the rounds came to."""

    base: Fit
    fit: Fit
    """Base and terms."""
    named: list[tuple[Evidence, Named]]
    """The terms, each with the check that asked for it."""
    without_last: Fit
    """Before the last term was added."""
    seen: list[Evidence]
    """What the base fails."""
    left: list[Evidence]
    """What base and terms fail."""
    evidence: list[Evidence]
    """Of every check on what they leave."""
    stopped: str
    """Why no term was sought for what is left, in words; empty where one was."""


def search(base: Fit, line_frequency_hz: float | None, tell: Progress) -> Searched:
    """Add terms to a base until its residuals pass every check.

    Args:
        base: the hypothesis under criticism.
        line_frequency_hz: of the mains, where it is known.
        tell: called with a few words at each step.
    """
    fit, before, named, seen, left = base, base, list[tuple[Evidence, Named]](), list[Evidence](), list[Evidence]()
    stopped, evidence = "", list[Evidence]()
    for number in count():
        tell(f"checking the residuals, round {number + 1}")
        fit, evidence, left = _judge(fit, line_frequency_hz, _LEVEL / 2**number, tell)
        if not number:
            base = before = fit
        seen = seen or left
        stopped = _stop(fit, base, number) if left else ""
        if not left or stopped:
            break
        tell(f"fitting what could explain: {left[0].check}")
        found = name(fit, _candidates(fit, left), LEAST_NATS)
        if found is None:
            break
        named.append((_nominating(left, found), found))
        before, fit = fit, restart_base(found.fit)
    return Searched(base, fit, named, before, seen, left, evidence, stopped)


def _judge(
    fit: Fit, line_frequency_hz: float | None, level: float, tell: Progress
) -> tuple[Fit, list[Evidence], list[Evidence]]:
    """Return the fit, the evidence of every check, and what of it is left once it was doubted, unless overwhelming.

    First by other bases that the readings like as well, one of which may have nothing left: then that is the fit. Then
    by what the same checks say of records drawn from the fit.
    """
    checked = check_each(fit, line_frequency_hz)
    evidence = [item for item, _ in checked]
    left = _significant(evidence, level)
    if not left or left[0].p_value < _overwhelming(fit):
        return fit, evidence, left
    tell(f"doubting: {left[0].check}")
    for other in rebased(fit, tails=any(term.cause == "heavy_tails" for item in left for term in item.terms)):
        again = check_each(other, line_frequency_hz)
        still = _significant([item for item, _ in again], level)
        if not still or other.log_likelihood > fit.log_likelihood:
            fit, checked, evidence, left = other, again, [item for item, _ in again], still
        if not left:
            return fit, evidence, left
    redrawn, doubted, check_of = Redrawn(fit), set[str](), {item.check: check for item, check in checked}
    while left and left[0].check not in doubted and left[0].p_value > _overwhelming(fit):
        most = left[0]
        doubted.add(most.check)
        corrected = redrawn.corrected(most, check_of[most.check])
        evidence = [corrected if item is most else item for item in evidence]
        left = _significant(evidence, level)
    return fit, evidence, left


def _overwhelming(fit: Fit) -> float:
    """Return the p-value below which nothing is doubted."""
    base = fit.terms[0]
    if not isinstance(base, Base) or not base.shocks:
        return _OVERWHELMING
    return _OVERWHELMING * exp(-min(_LOST_A_SHOCK * exp(fit.theta[6]) * fit.data.span_s, _MOST_LOST))


def _candidates(fit: Fit, left: list[Evidence]) -> list[Term]:
    """Return the terms that the checks ask for, and what else looks like them."""
    candidates = [term for item in left for term in item.terms]
    hump = best_hump(fit) if any(term.cause in _HUMPED for term in candidates) else None
    candidates += [hump] if hump else []
    if any(term.cause == "ring_down" for term in candidates):  # what rings after one shock is most like a wave alone
        candidates += best_packets(fit)
    if any(isinstance(term, BreathingNoise | SwellingNoise) for term in candidates):
        candidates += gains_like_noise(fit)
    if isinstance(fit.terms[0], Given):
        candidates += rival_figures(fit)
    return candidates


def _nominating(left: list[Evidence], found: Named) -> Evidence:
    """Return the most surprising of the checks that asked for what was found."""
    asked = (item for item in left if any(term.cause == found.term.cause for term in item.terms))
    return next(asked, left[0])


def _significant(evidence: list[Evidence], level: float) -> list[Evidence]:
    """Return what is left by Holm's procedure, most surprising first."""
    ranked = sorted(evidence, key=lambda item: item.p_value)
    for number, item in enumerate(ranked):
        if item.p_value * (len(ranked) - number) > level:
            return ranked[:number]
    return ranked


def _stop(fit: Fit, base: Fit, found: int) -> str:
    """Return why no further term is sought, in words; empty where one is."""
    if found >= _MOST_FINDINGS:
        return f"the search stops after {found} findings"
    if found >= max(_FEWEST, _READ // fit.data.n):
        return f"the search stops after {found} findings, as the record is long"
    if _weight(fit) > max(_HEAVIEST * _weight(base), _LIGHT / fit.data.n):
        return (
            f"the search stops after {found} findings, as the model has grown too large to be fitted in reasonable time"
        )
    return ""


def _weight(fit: Fit) -> float:
    return float((len(fit.states) + 1) ** 2 * max(fit.theta.size, 6))
