"""The likelihood of a hypothesis, and the way up it: one start, or several that race."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aemd.diagnose.hypothesis import Base, Data, Parts, Seen, Term
from aemd.diagnose.kernels import log_densities, telegraph_densities
from aemd.diagnose.sharpened import quieted, sharpened

__all__ = [
    "HOPELESS",
    "Climb",
    "assemble",
    "box",
    "climb",
    "climb_on",
    "densities",
    "race",
    "readings_scores",
    "score_log_likelihood",
    "split",
]

Floats = NDArray[np.float64]

_IMPOSSIBLE = 1e9  # nats a reading that what cannot be computed costs
_LONGEST_STEP = 1.5  # of any free number at once; most are logarithms
_CONVERGED = 1e-2  # nats that are not worth another step
_CONVERGED_PER_READING = 3e-7  # in a long record a hundredth of a nat is far below what can be told
_SLOW = 0.5  # nats: two steps in a row that gain less are the last where each is costly
_COSTLY = 1e7  # work of a step over all readings from which it is; see `Climb.work`
_COSTLY_STEPS = 15  # at most, of such
_FREE = 1e-2  # damping above which a small gain may be a short step's and not the top's
_ONE_TOP = 0.3  # nats between climbs that have met on one top
_FLAT = 0.1  # of what is worth a step: a free number that can gain no more stays
_DIFFERENCE = 1e-5  # of a free number, for the derivatives
HOPELESS = 20.0
"""Nats behind the best, after what may still come, from which a start is given up."""
_PATIENCE = 5  # steps that the best start of each kind has at least, where that is not too much work
_WORK = 1e5  # (free numbers times states squared) of those steps, for each reading
_IN_HASTE = 3  # such steps, below which only the best start of each kind sets out
_LONG = 40_000  # readings beyond which a race is run on some of them first
_BLOCKS = 20
_BLOCK = 500  # readings: the gaps between blocks show what is slow, the readings within what is not
_FIRST_STEPS = 6  # on those, of each start of a race of many
_LAST_STEPS = 8  # over all readings after them, each some dozen passes of the filter
_FROM_BEFORE = ("ring_down", "thermal_drift", "latency")  # terms that add to the mean what other readings decide
_OF_ALL = ("supply_coupling", "range_switching", "smoothing")  # terms that do more than that with them
_FEW, _FEW_LONG = 8, 2  # steps from a maximum to that of half the record; of a long one that is near
_LED_PATIENCE = 2  # steps over all of what has hope after them
_STILL_TO_COME = 3.0  # times its last step's gain that a start is given credit for; steps gain less and less


def split(terms: Sequence[Term], theta: Floats) -> list[Floats]:
    """Return each term's free numbers."""
    parts, at = list[Floats](), 0
    for term in terms[:-1]:
        parts.append(theta[at : at + term.start.size])
        at += parts[-1].size
    return [*parts, theta[at:]]


def box(terms: Sequence[Term], near: Floats, held: Sequence[int] = ()) -> tuple[Floats, Floats]:
    """Return the bounds of all free numbers, low and high; those that are held have both where they are."""
    low, high = np.array([bound for term in terms for bound in term.bounds], np.float64).reshape(-1, 2).T
    low[list(held)] = high[list(held)] = near[list(held)]
    return low, high


def assemble(
    terms: Sequence[Term], theta: Floats, data: Data, whole: Data | None = None
) -> tuple[Seen, Parts, tuple[Any, ...]]:
    """Return what stands for the readings, the parts, and the filter's arguments beside the readings and their steps.

    What was done to the readings last is undone first: a smoothing, then what a stated model has beside it.

    Args:
        terms: the hypothesis.
        theta: its free numbers.
        data: the readings; or those of a sample alone, and
        whole: what they are a sample of, which some terms follow from reading to reading.
    """
    parts = Parts(np.zeros(data.y.size), np.zeros(data.y.size), np.ones(data.y.size))
    for term, numbers in zip(terms, split(terms, theta), strict=True):
        if whole is not None and term.cause in _FROM_BEFORE:
            size = whole.y.size
            alone = Parts(np.zeros(size), np.zeros(size), np.ones(size))
            term.add(numbers, whole, alone)
            parts.mean += alone.mean[whole.sample]
        else:
            term.add(numbers, data, parts)
    states = np.array(parts.states, np.float64).reshape(-1, 6)  # of white noise alone there is none
    seen = sharpened(data, parts.kept)
    if parts.kept > 0:
        parts.noise_var = parts.noise_var * quieted(data, parts.kept)
    if parts.undo is not None:
        seen = parts.undo(seen)
    bounds = () if seen.low is None else (seen.low, seen.high)
    shocks = np.concatenate((parts.shocks, parts.struck))
    extras = np.concatenate((parts.extras, np.array(parts.tails).ravel()))
    arguments = (parts.mean, parts.noise_var, parts.scale, states, shocks, extras, *bounds)
    return seen, parts, arguments


def score_log_likelihood(terms: Sequence[Term], theta: Floats, data: Data) -> float:
    """Return the log-likelihood of the scaled readings."""
    return float(densities(terms, theta, data).sum())


def densities(terms: Sequence[Term], theta: Floats, data: Data) -> Floats:
    """Return the log density of each scaled reading, shape (n,)."""
    if data.thinned is not None and _can_be_thinned(terms):
        seen, parts, arguments = assemble(terms, theta, data.thinned, data)
        data = data.thinned
    else:
        seen, parts, arguments = assemble(terms, theta, data)
    used, step_s, slope = data.used, data.step_s, seen.log_slope
    if data.sample is not None:
        seen, used, step_s, slope, arguments = _at(data.sample, seen, data, arguments)
    if parts.telegraph is None:
        each = log_densities(seen.y, used, step_s, *arguments) + slope
    else:
        each = telegraph_densities(parts.telegraph, seen.y, used, step_s, *arguments) + slope
    return each if np.isfinite(each).all() else np.full(each.size, -_IMPOSSIBLE)


def _can_be_thinned(terms: Sequence[Term]) -> bool:
    """Return whether each term does to a reading what it does, whatever others there are, or adds what they decide."""
    return isinstance(terms[0], Base) and all(term.cause not in _OF_ALL for term in terms)


def _at(sample: NDArray[np.int64], seen: Seen, data: Data, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return what the filter takes of some readings; what is left out between them is time that passes."""
    step_s = data.step_s[sample]
    behind_gap = np.flatnonzero(np.diff(sample) > 1) + 1
    step_s[behind_gap] = data.t_s[sample[behind_gap]] - data.t_s[sample[behind_gap - 1]]
    mean, noise_var, scale, states, shocks, extras, *bounds = arguments
    chosen = (mean[sample], noise_var[sample], scale[sample], states, shocks, extras, *(end[sample] for end in bounds))
    slope = seen.log_slope[sample] if isinstance(seen.log_slope, np.ndarray) else seen.log_slope
    return replace(seen, y=seen.y[sample]), data.used[sample], step_s, slope, chosen


def readings_scores(terms: Sequence[Term], theta: Floats, data: Data, here: Floats, high: Floats) -> Floats:
    """Return the derivative of each reading's log density by each free number, shape (n, k)."""
    scores = np.empty((theta.size, here.size)).T  # each number's derivatives side by side
    for number in range(theta.size):
        aside = theta.copy()
        width = _DIFFERENCE if theta[number] + _DIFFERENCE <= high[number] else -_DIFFERENCE
        aside[number] += width
        scores[:, number] = (densities(terms, aside, data) - here) / width
    return scores


class Climb:
    """One start on its way to a local maximum of the likelihood.

    Each step is the score over the outer product of the readings' own scores (Berndt, Hall, Hall and Hausman 1974),
    damped as Levenberg and Marquardt damp least squares; the scores are differences of the readings' log densities, so
    a step costs one pass of the filter per free number.
    """

    def __init__(
        self,
        terms: Sequence[Term],
        start: Floats,
        data: Data,
        cost_nats: float = 0.0,
        counted: NDArray[np.bool_] | None = None,
        held: Sequence[int] = (),
    ) -> None:
        """Begin at `start`; `cost_nats` counts against this hypothesis in a race.

        Of all densities the sum is climbed, or of those that are `counted`: the filter follows the other readings, too.
        The free numbers that are `held` stay where they begin.
        """
        self.terms, self.cost_nats, self.data, self._counted, self._held = terms, cost_nats, data, counted, held
        self._low, self._high = box(terms, start, held)
        self.theta = np.clip(start, self._low, self._high)
        self._here = self._densities(self.theta)
        self.value = float(self._here.sum())
        self.gained = np.inf
        """By the last step, nats."""
        self.done = not self.theta.size
        self._damping = 1e-3
        states = len(assemble(terms, self.theta, data)[1].states)
        self.work = float((self.theta.size + 2) * (states + 2) ** 2)
        """Of a step, for each reading."""

    def _densities(self, theta: Floats) -> Floats:
        each = densities(self.terms, theta, self.data)
        return each if self._counted is None else np.where(self._counted, each, 0.0)

    @property
    def readings(self) -> int:
        """How many a step goes through."""
        return int(self._here.size)

    @property
    def costly(self) -> bool:
        """Whether a step is more than some hundredths of a second of work."""
        return self.work * self.readings > _COSTLY

    @property
    def worth(self) -> float:
        """Log-likelihood less cost."""
        return self.value - self.cost_nats

    def meets(self, other: "Climb") -> bool:
        """Return whether it is all but where another of the same hypothesis has come to rest."""
        same = self.terms[-1].cause == other.terms[-1].cause and self.theta.size == other.theta.size
        return other.done and same and abs(self.value - other.value) < _ONE_TOP and self.gained < 10 * _ONE_TOP

    @property
    def hope(self) -> float:
        """Worth that this start may come to, as far as its steps told so far."""
        return self.worth + _STILL_TO_COME * self.gained

    def over_blocks(self) -> "Climb":
        """Return the same start over some blocks of the record."""
        return Climb(self.terms, self.theta, self.data.sampled(_BLOCKS, _BLOCK), self.cost_nats, held=self._held)

    def led_by(self, begun: "Climb") -> "Climb":
        """Return a climb that begins where one over some blocks of the record ended, if that is higher; else this one.

        An effect that none of the blocks holds leaves its numbers where they were.
        """
        ahead = Climb(self.terms, begun.theta, self.data, self.cost_nats, held=self._held)
        if ahead.value <= self.value:
            return self
        own = self.terms[-1].start.size
        if own and (begun.theta[-own:] != self.theta[-own:]).any():
            # What so few readings leave open, half a nat for each number, is as many times more in all of them.
            ahead.gained = (begun.gained + self.theta.size) * self.readings / begun.readings
        return ahead

    def step(self) -> None:
        """Take one step, or say that there is none worth taking."""
        enough = max(_CONVERGED, _CONVERGED_PER_READING * self.data.n)
        scores = readings_scores(self.terms, self.theta, self.data, self._here, self._high)
        if self._counted is not None:
            scores[~self._counted] = 0.0
        # Not by matrix multiplication: so slim a product costs the library's threads more in waiting than in work.
        gradient, curvature = scores.sum(axis=0), np.einsum("nk,nl->kl", scores, scores)
        pinned = ((self.theta <= self._low) & (gradient < 0)) | ((self.theta >= self._high) & (gradient > 0))
        # What changes nothing would take the longest step all the time, and leave none to the others.
        pinned |= np.abs(gradient) + np.diag(curvature) < _FLAT * enough
        gradient[pinned] = 0.0
        curvature[pinned], curvature[:, pinned] = 0.0, 0.0
        scale, before = np.diag(curvature) + 1e-6, self.gained
        while self._damping < 1e6:
            step = np.linalg.solve(curvature + np.diag(self._damping * scale), gradient)
            if not step.any():  # every number is at a bound, or changes nothing
                self.done = True
                return
            cut = np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
            turned = gradient @ cut <= 0
            if turned:  # by cutting each, downhill
                cut = step * (_LONGEST_STEP / float(np.abs(step).max()))
            trial = np.clip(self.theta + cut, self._low, self._high)
            promised = float(gradient @ (trial - self.theta))
            there = self._densities(trial)
            self.gained = float(there.sum()) - self.value
            if self.gained > 0:
                self.theta, self._here, self.value = trial, there, self.value + self.gained
                self._damping = self._damping * 10.0 if turned else max(self._damping / 10.0, 1e-7)
                self.done = self.gained < enough and promised < 10 * enough and self._damping < _FREE and not turned
                self.done |= self.costly and max(before, self.gained) < _SLOW and not turned
                return
            self._damping *= 10.0
            if 0 <= promised < enough and not turned:  # short or turned for the sake of one number is not the top
                break
        self.gained, self.done = 0.0, True


def climb(
    terms: Sequence[Term], start: Floats, data: Data, iterations: int = 40, held: Sequence[int] = ()
) -> tuple[Floats, float]:
    """Return the free numbers of a local maximum of the likelihood, some held where they begin, and its value."""
    (alone,) = race([Climb(terms, start, data, held=held)], iterations)
    return alone.theta, alone.value


def climb_on(terms: Sequence[Term], start: Floats, data: Data, counted: NDArray[np.bool_] | None = None) -> Floats:
    """Return the free numbers a few steps from `start`, a maximum of all readings, of which these are a part.

    Args:
        terms: the hypothesis.
        start: its free numbers to begin with.
        data: the readings, those that are no part of them not used; or all of them, and
        counted: whose densities, given all readings before, are summed.
    """
    alone = Climb(terms, start, data, counted=counted)
    for _ in range(_FEW if alone.readings <= _LONG else _FEW_LONG):
        if not alone.done:
            alone.step()
    return alone.theta


def race(starts: Sequence[Climb], iterations: int) -> list[Climb]:
    """Let starts climb together, give up those that fall hopelessly behind, and return the others, best first.

    The best of each kind is given a few steps first: a mechanism that the base has imitated begins far down, because
    the base has to give way before it can rise. Fewer steps beside a large model, where each is costly: what loses has
    its turn in the next round.

    On a long record those first steps are taken on some blocks of it. Over all readings go then the best of each kind
    that has hope, a step or two, and the rest of the way those that keep it. So the work of a race grows with the
    readings as that of the winners' last steps does.
    """
    left = list(starts)
    patience = int(np.clip(_WORK / max(sum(one.work for one in left), 1.0), 1, _PATIENCE))
    if patience < _IN_HASTE:
        left = _best_of_each_kind(left)
    if left[0].readings > _LONG:
        first_steps = min(iterations, _FIRST_STEPS) if len(left) > _IN_HASTE else iterations
        patience, left = _LED_PATIENCE, _hopeful(_best_of_each_kind(_led(left, first_steps)))
        iterations = min(iterations, _LAST_STEPS)
    elif left[0].costly:
        iterations = min(iterations, _COSTLY_STEPS)
    for count in range(1, iterations + 1):
        for one in left:
            if not one.done:
                one.step()
        first = _best_of_each_kind(left) if count < patience else []
        hopeful = _hopeful(left)
        left = _distinct([one for one in left if one in first or one in hopeful])
        if all(one.done for one in left):
            break
    return sorted(left, key=lambda one: -one.worth)


def _led(starts: Sequence[Climb], steps: int) -> list[Climb]:
    """Return starts moved by steps over some blocks, less those that fall hopelessly behind others of their kind."""
    pairs = [(one, one.over_blocks()) for one in starts if not one.done]
    for count in range(steps):
        for _, begun in pairs:
            if not begun.done:
                begun.step()
        if count:  # one step tells little
            best = {one.terms[-1].cause: one.worth for one in _best_of_each_kind([begun for _, begun in pairs])}
            pairs = [pair for pair in pairs if pair[1].hope >= best[pair[1].terms[-1].cause] - HOPELESS]
    return [one for one in starts if one.done] + [one.led_by(begun) for one, begun in pairs]


def _best_of_each_kind(starts: Sequence[Climb]) -> list[Climb]:
    best: dict[str, Climb] = {}
    for one in sorted(starts, key=lambda one: -one.worth):
        best.setdefault(one.terms[-1].cause, one)
    return list(best.values())


def _hopeful(starts: Sequence[Climb]) -> list[Climb]:
    top = max(one.worth for one in starts)
    return [one for one in starts if one.hope >= top - HOPELESS]


def _distinct(starts: Sequence[Climb]) -> list[Climb]:
    """Return the starts without those that came to a top where another of the same hypothesis stands."""
    kept: list[Climb] = []
    for one in sorted(starts, key=lambda one: not one.done):
        if not any(one.meets(other) for other in kept):
            kept.append(one)
    return kept
