"""A level that jumps between two: its likelihood against that of the base, which imitates it with shocks or drift."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import exp, log

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from aemd.diagnose.climb import Climb, assemble, split
from aemd.diagnose.climb import climb as climb_up
from aemd.diagnose.evidence import Evidence
from aemd.diagnose.fit import Fit
from aemd.diagnose.hypothesis import Base, Bounds, Data, Parameter, Parts, Term
from aemd.diagnose.terms.events import Popcorn
from aemd.diagnose.terms.lines import amplitude_cost

__all__ = ["check_popcorn"]

Floats = NDArray[np.float64]

_SIZES = (2.2, 3.2, 4.6)
"""In deviations of the undisturbed innovation."""
_STAYS = (50.0, 150.0)
"""Readings."""
_SMALL, _ABOVE = (1.5, 150.0), 1.0
"""Jumps that are not seen one by one, beside a slow drift, and nats above the base from which they are a start: a fast
drift stands for them in the base, from which they were 19 nats behind where they came to 43 above. On no clean record
is that start above the base, and none goes on from below it, since so small a level changes little."""
_LASTING = 20.0
"""Readings that shocks last where they stand for jumps, and of which a start goes on whatever it begins with: the base
meets each large jump by a shock that hardly fades."""
_CLIMBING = 2
"""Others that go on."""
_FIRST_STEPS, _STEPS, _LAST_STEPS = 2, 6, 12
"""Before hope is asked for; at most, of each of them, and of the best with all numbers free."""
_BEHIND = 12.0
"""Nats behind the base from which no start goes on. Of records that hold such a level, of 30 nats, the best start was
nowhere more than 9 behind; of clean ones of 9,000 readings hardly one was less than 20."""
_FREEDOM = 4
"""Degrees of chi-square by which twice the gain is judged: step and two stays are three numbers, and one more as they
are sought from a grid of starts on a likelihood with several tops. Of 180 clean records, a third with numbers far from
the usual, many with shocks that dwarf all else, half gained nothing, 13 more than 2 nats, 3 more than 4 and none more
than 4.3; by four degrees 73 and 16 were due, and 13 more than 4.3."""
_LONG = 20_000
"""Readings that are judged; of a longer record the first so many, and those only beside the base alone."""
_KEPT_OUT = 0.02
"""Part of the readings that may be kept out: a dead band's leave a hole, which two levels imitate."""
_PROMISING = 2.0
"""Nats behind the base, after some steps, from which a start is given up."""
_WORTH_IT = 6.0
"""Nats that there must be hope of for the last steps."""


def check_popcorn(fit: Fit) -> Evidence:
    """Fit the jumping level together with all else, from a grid of starts.

    No score does it: who does not know of the level has fitted its jumps as shocks, or its spectrum as a drift, and
    nothing is left of it in second moments. Some starts therefore have a drift that is slow again, and hardly a shock.
    """
    data, before = _part(fit)
    if data is None:
        return _evidence(0.0, ())
    one = float(np.sqrt(np.median(fit.variance[fit.data.used])))
    begun = list[tuple[Climb, _Beside, Popcorn]]()
    for number, base in enumerate(_bases(fit)):
        held = _Beside(fit.terms, base)
        for size, stay in (*product(_SIZES, _STAYS), *([_SMALL] if number == 1 else [])):
            if stay * data.interval_s < data.span_s / 4:
                term = Popcorn(size * one, stay * data.interval_s, stay * data.interval_s, 0.0)
                start = Climb([held, term], np.concatenate((held.start, term.start)), data)
                if (size, stay) != _SMALL or start.value > before + _ABOVE:
                    begun.append((start, held, term))
    best_begun = sorted(begun, key=lambda start: -start[0].value)[:_CLIMBING]
    climbing = [start for start in best_begun if best_begun[0][0].value >= before - _BEHIND]
    climbing += [
        (Climb([held, term], np.concatenate((held.start, term.start)), data), held, term) for held, term in _struck(fit)
    ]
    if not climbing:
        return _evidence(0.0, ())
    for climb, _, _ in climbing:
        _go_on(climb, _STEPS, before - _PROMISING)
    best, beside, jumping = max(climbing, key=lambda start: start[0].value)
    theta = np.concatenate((beside.whole(best.theta[:-3]), best.theta[-3:]))
    value = best.value
    if value > before - _PROMISING:  # with all numbers free
        last = Climb([*fit.terms, jumping], theta, data)
        _go_on(last, _LAST_STEPS, before + _WORTH_IT)
        theta, value = last.theta, last.value
    gained = value - before
    step, low_s, high_s = np.exp(theta[-3:])
    cost = amplitude_cost(3, fit.data.n)
    return _evidence(gained, (Popcorn(float(step), float(low_s), float(high_s), cost, tuple(theta[:-3].tolist())),))


def _struck(fit: Fit) -> list[tuple["_Beside", Popcorn]]:
    """Return a level that jumps as often and as far as shocks strike that hardly fade, with few others beside it."""
    base, step_s = fit.terms[0], fit.data.interval_s
    if not (isinstance(base, Base) and base.shocks and exp(fit.theta[8]) > _LASTING * step_s):
        return []
    stay_s = min(max(exp(-fit.theta[6]), 2 * step_s), fit.data.span_s / 4)
    return [(_Beside(fit.terms, _bases(fit)[-1]), Popcorn(exp(fit.theta[7]), stay_s, stay_s, 0.0))]


def _go_on(climb: Climb, steps: int, least: float) -> None:
    """Climb as long as there is hope of a log-likelihood."""
    for count in range(steps):
        if climb.done or (count >= _FIRST_STEPS and climb.hope < least):
            return
        climb.step()


@dataclass(frozen=True, slots=True)
class _Beside:
    """All that is in the model, of which only drift, white noise and level are free: what must give way to a level."""

    terms: tuple[Term, ...]
    theta: Floats
    cause: str = "base"
    cost_nats: float = 0.0

    @property
    def start(self) -> Floats:
        """The free ones of the numbers."""
        return self.theta[self._free]

    @property
    def bounds(self) -> Sequence[Bounds]:
        """As they are."""
        return [self.terms[0].bounds[number] for number in self._free]

    def add(self, theta: Floats, data: Data, parts: Parts) -> None:
        """Put all terms into the parts."""
        for term, numbers in zip(self.terms, split(self.terms, self.whole(theta)), strict=True):
            term.add(numbers, data, parts)

    def parameters(self, data: Data) -> Sequence[Parameter]:  # noqa: ARG002 - a Term's
        """Nothing is reported."""
        return []

    def whole(self, theta: Floats) -> Floats:
        """Return all free numbers of the terms."""
        whole = self.theta.copy()
        whole[self._free] = theta
        return whole

    @property
    def _free(self) -> list[int]:
        return [2, 3, 4, 5] if isinstance(self.terms[0], Base) else []


def _evidence(gained: float, terms: tuple[Popcorn, ...]) -> Evidence:
    p_value = float(chi2.sf(2 * max(gained, 0.0), _FREEDOM))
    return Evidence(
        check="a level that jumps between two: log-likelihood over the base's, nats",
        p_value=p_value,
        observed=gained,
        low=-1e3,
        high=float(chi2.isf(0.025, _FREEDOM)) / 2,
        terms=terms if p_value < 0.05 else (),
    )


def _part(fit: Fit) -> tuple[Data | None, float]:
    """Return the readings that are judged, and what the model makes of them, nats."""
    if any(isinstance(term, Popcorn) for term in fit.terms):
        return None, 0.0
    # The probability of an interval and the density of its middle are no rivals.
    if assemble(fit.terms, fit.theta, fit.data)[0].low is not None:
        return None, 0.0
    if np.count_nonzero(~fit.data.used) > _KEPT_OUT * fit.data.y.size:
        return None, 0.0
    if fit.data.n <= _LONG:
        return fit.data, fit.log_likelihood
    if len(fit.terms) > 1:
        return None, 0.0
    data, part = fit.data, slice(_LONG)
    short = replace(
        data,
        y=data.y[part],
        used=data.used[part],
        step_s=data.step_s[part],
        t_s=data.t_s[part],
        slot=data.slot[part],
        witnesses={name: values[part] for name, values in data.witnesses.items()},
    )
    return short, climb_up(fit.terms, fit.theta, short)[1]  # its own best, as the level's is


def _bases(fit: Fit) -> list[Floats]:
    """Return the free numbers as they are, and with a drift that is slow and small."""
    if not isinstance(fit.terms[0], Base):
        return [fit.theta]
    slow = fit.theta.copy()
    slow[2] = max(slow[2], log(fit.data.span_s / 4))
    slow[3] -= 0.7
    if not fit.terms[0].shocks:
        return [fit.theta, slow]
    few = slow.copy()
    few[6] = fit.terms[0].bounds[6][0]
    return [fit.theta, slow, few]
