"""Maximum likelihood: starts from the spectrum, then the exact filter; and what is left of the readings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from aemd.diagnose.climb import Climb, assemble, climb, densities, race, readings_scores, split
from aemd.diagnose.hypothesis import Base, Data, Seen, Term, base_box, base_start_with_shocks
from aemd.diagnose.kernels import follow_telegraph, predict, whiten
from aemd.diagnose.sharpened import sharpened
from aemd.diagnose.starts import spectral_starts, usual_starts, with_drift, without_jumps
from aemd.diagnose.terms.events import Popcorn
from aemd.diagnose.terms.noise import DifferenceNoise, HeavyTails, Smoothing
from aemd.diagnose.terms.shapes import Step

__all__ = [
    "Fit",
    "begin_with",
    "climb",
    "densities",
    "fit_base",
    "readings_scores",
    "refit",
    "residuals",
    "restart_base",
    "steps_for",
]

Floats = NDArray[np.float64]

_WORTH_A_RESTART = 1e-2  # nats
_SUSPECT = 1.5  # deviations of the kurtosis from which shocks are tried; frequent ones are nearly normal
_SHOCK_GAIN = 6.0  # nats that three more numbers must bring; half of chi-square(3) at 0.7 %
_FEW_SHOCKS = 8.0  # expected in a record, below which they may be something else
_SHORT = 5_000  # readings below which likelihoods have several tops, and more starts are tried
_LONG = 20_000  # readings beyond which the mixture is first fitted to a part
_LEAST_WHITE = 1e-8  # variance; what apertures average out may leave less than none
_DECAYS = tuple(0.3 * 1.6**k for k in range(2, 10))
"""Intervals that shocks of the starts take to decay."""
_MIDDLE = 0.01
"""Of an interval, within which a reading is its middle."""
_AT_BOUND = 0.01  # of the logarithm of the shocks' decay
_SHOCK_SD, _SHOCK_DECAY = 7, 8  # of the base's free numbers
_TAKEN_FOR_SHOCKS = 20
_STARTERS = 6
_FINALISTS = 2
"""Starts that go on to a longer part of the record."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted hypothesis and what it leaves; shapes (n,)."""

    data: Data
    terms: tuple[Term, ...]
    """The base first."""
    theta: Floats
    """Free numbers of all terms, one after another."""
    log_likelihood: float
    """Of the scaled readings."""
    z: Floats
    """Standard normal residuals; 0 where a reading is not used."""
    predicted: Floats
    variance: Floats
    each: Floats
    gains: Floats
    states: Floats
    mean: Floats
    """Deterministic part."""
    y: Floats
    """What stood for the readings, once what was done to them last is undone."""
    innovation: Floats
    """Reading less prediction."""
    white: float
    """Typical standard deviation of the white noise."""

    def parts_of(self, number: int) -> Floats:
        """Return the free numbers of one term."""
        return split(self.terms, self.theta)[number]

    @property
    def base(self) -> Base:
        """The base as fitted here."""
        base = self.terms[0]
        assert isinstance(base, Base)  # noqa: S101 - by construction
        return Base(start=self.parts_of(0), shocks=base.shocks, box=base.box)

    def whitened(self, template: Floats) -> Floats:
        """Return how an effect of that shape would show in z, per unit of it, shape (n,)."""
        left = whiten(np.ascontiguousarray(template), self.data.step_s, self.states, self.gains, self.data.used)
        return np.asarray(np.where(self.data.used, left / np.sqrt(self.variance), 0.0))

    @property
    def innovation_rms(self) -> float:
        """Root mean square of reading minus prediction, V."""
        used = self.data.used
        return float(np.sqrt(np.mean(self.innovation[used] ** 2)) * self.data.unit_V)


def residuals(terms: Sequence[Term], theta: Floats, data: Data) -> Fit:
    """Return the fit with these free numbers and what it leaves."""
    seen, parts, arguments = assemble(terms, theta, data)
    if parts.telegraph is None:
        each, z, predicted, variance, gains = predict(seen.y, data.used, data.step_s, *arguments)
    else:
        each, z, predicted, variance, gains = follow_telegraph(
            parts.telegraph, seen.y, data.used, data.step_s, *arguments
        )
    each = np.where(data.used, each + seen.log_slope, 0.0)
    y = _placed(seen, z, predicted, variance)
    return Fit(
        data=data,
        terms=tuple(terms),
        theta=theta,
        log_likelihood=float(np.sum(each)),
        z=z,
        predicted=predicted,
        variance=variance,
        each=each,
        gains=gains,
        states=arguments[3],
        mean=arguments[0],
        y=y,
        innovation=(y - predicted) * (1 - parts.kept),
        white=sqrt(max(float(np.median(arguments[1])), _LEAST_WHITE)),
    )


def _placed(seen: Seen, z: Floats, predicted: Floats, variance: Floats) -> Floats:
    """Return the readings, one that was clipped, or may be of either range, where z has it within its interval.

    Such a reading is not the middle of what it may have been: as it stands, it would be an innovation of its own law,
    and the values that it hides a hole. Rounded ones stay.
    """
    if seen.low is None or seen.high is None:
        return seen.y
    bounded = seen.high > seen.low
    low, high = (np.where(bounded, ends, seen.y) for ends in (seen.low, seen.high))
    with np.errstate(invalid="ignore"):  # both ends may be open
        central = np.abs((high - seen.y) - (seen.y - low)) <= _MIDDLE * np.minimum(high - seen.y, seen.y - low)
    hidden = bounded & ~central
    return np.where(hidden, np.clip(predicted + z * np.sqrt(variance), seen.low, seen.high), seen.y)


def steps_for(data: Data) -> int:
    """Return how many steps a climb may take; the likelihood of a long record is steep."""
    return 40 if data.n <= _LONG else 15


def refit(terms: Sequence[Term], data: Data, start: Floats | None = None) -> Fit:
    """Fit all terms together, from their starts."""
    theta = np.concatenate([term.start for term in terms]) if start is None else start
    theta, _ = climb(terms, theta, data, iterations=steps_for(data))
    return residuals(terms, theta, data)


def fit_base(data: Data) -> Fit:
    """Fit the base model: without shocks from the spectrum's best starts, then with shocks if they earn their keep."""
    box = base_box(data)
    starts = spectral_starts(data)[: 3 if data.n < _SHORT else 2]

    def from_these(thetas: Sequence[Floats]) -> Climb:
        return race([Climb([Base(start, shocks=False, box=box)], start, data) for start in thetas], steps_for(data))[0]

    first = from_these(starts)
    best = max(first, from_these([with_drift(first.theta, data)]), key=lambda one: one.value).theta
    fit = residuals([Base(best, shocks=False, box=box)], best, data)
    shocked = _with_shocks(fit)
    if shocked is None or shocked.log_likelihood < fit.log_likelihood + _SHOCK_GAIN:
        return fit
    # A handful of events may be one step, which slow shocks imitate: then the base is the one without, and a check of
    # the residuals has the step to find.
    few = np.exp(shocked.theta[6]) * data.span_s < _FEW_SHOCKS
    slow = shocked.theta[_SHOCK_DECAY] > shocked.base.box[_SHOCK_DECAY][1] - _AT_BOUND
    if (few or slow) and _with_step(fit) > shocked.log_likelihood:
        return fit
    if slow:  # one step among many shocks draws the decay of all of them out
        quick = shocked.theta.copy()
        quick[_SHOCK_DECAY] = log(data.interval_s)
        quicker = refit(shocked.terms, data, quick)
        if _with_step_beside(quicker) > shocked.log_likelihood:
            return quicker
    return shocked


def _with_step(fit: Fit) -> float:
    """Return the log-likelihood with the one step that the residuals show most clearly, less what its place costs.

    All is fitted again: a large step has widened whatever the fit without it could move by.
    """
    data = fit.data
    at = int(np.argmax(np.abs(fit.z)))
    shape = (np.arange(fit.z.size) >= at).astype(np.float64)
    left = fit.whitened(shape)
    size = float(left @ fit.z) / max(float(left @ left), 1e-300)
    start = spectral_starts(replace(data, y=data.y - size * shape))[0]
    step = Step(float(data.t_s[at]), size, log(fit.z.size))
    return refit([*fit.terms, step], data, np.append(start, size)).log_likelihood - step.cost_nats


def _with_step_beside(fit: Fit) -> float:
    """Return the same of a fit with shocks, one of which may be the step: one of the readings that are off by most."""
    data, tries = fit.data, list[tuple[float, int, float]]()
    off = np.where(data.used, np.abs(fit.innovation) / np.sqrt(fit.variance), 0.0)
    for at in np.argsort(-off)[:_TAKEN_FOR_SHOCKS].tolist():
        left = fit.whitened((np.arange(off.size) >= at).astype(np.float64))
        size, along = max(float(left @ left), 1e-300), float(left @ fit.z)
        tries.append((along**2 / size, at, along / size))
    _, at, size = max(tries)
    step = Step(float(data.t_s[at]), size, log(off.size))
    return refit([*fit.terms, step], data, np.append(fit.theta, size)).log_likelihood - step.cost_nats


def _with_shocks(fit: Fit) -> Fit | None:
    """Return the best fit with shocks, if the residuals of one without ask for any."""
    data, used = fit.data, fit.data.used
    z = fit.z[used]
    width = 1.4826 * float(np.median(np.abs(z)))
    out = np.abs(z) > -ndtri(0.005 / z.size) * width  # one clean record in a hundred has one
    kurtosis = float(np.mean((z / z.std()) ** 4)) - 3
    if not out.any() and kurtosis < _SUSPECT * sqrt(24 / z.size):
        return None
    # Shocks widened the noise of the fit without them; the core of its residuals tells by how much.
    theta = fit.theta.copy()
    theta[[1, 3, 4]] += log(min(width, 1.0))
    core = sqrt(float(np.median(fit.variance[used]))) * width
    large = max(float(np.std(z[out])) / width * core if out.any() else 0.0, 3 * core)
    rate = max(int(np.count_nonzero(out)), 1) / data.span_s
    some = data if data.n <= _LONG else data.first(_LONG)
    calm, jumps_per_s, jump = without_jumps(some)
    begins = [(theta, rate * more, large) for more in (1.0, 4.0)]
    if jump > 0:
        begins += [(start, jumps_per_s, jump) for start in (_fit_calm(calm), *usual_starts(some))]
    few = data if data.n <= _SHORT else data.first(_SHORT)
    few = few if data.n > _LONG or _has_its_share(out, few.n) else data  # all of a long record would take minutes
    starts = sorted((_best_decay(data, few, *begin) for begin in begins), key=lambda one: -one.value)[:_STARTERS]
    for part in (few, some, data):  # each on the shoulders of the last
        if part is few or part.n > few.n:
            thetas = [one.theta for one in starts]
            if part is not few:
                thetas += _begun_anew(thetas[0], part)
            starts, few = [Climb(starts[0].terms, theta, part) for theta in thetas], part
            starts = race(starts, steps_for(part))[:_FINALISTS]
    return residuals(starts[0].terms, starts[0].theta, data)


def _has_its_share(out: NDArray[np.bool_], count: int) -> bool:
    """Return whether half as many as are due of the readings that stand out are among the first so many.

    Without them shocks die out in a fit to those, and are not found again by climbing.
    """
    return bool(2 * np.count_nonzero(out[:count]) * out.size >= np.count_nonzero(out) * count)


def _begun_anew(theta: Floats, data: Data) -> list[Floats]:
    """Return starts with the shocks of another but processes of their own.

    What few readings do not show, a slow drift above all, has been left out by their fit, and is not found again by
    climbing: the likelihood is flat where a process is not there.
    """
    calm = theta.copy()
    calm[:5] = _fit_calm(without_jumps(data)[0])[:5]
    return [calm, with_drift(theta, data)]


def _best_decay(data: Data, few: Data, start: Floats, per_s: float, size: float) -> Climb:
    """Return the best of starts with shocks of that rate and size whose decays differ: it is the likelihood's ridge.

    Bounds are those of all the data, the likelihood is that of the first few.
    """
    bases = [base_start_with_shocks(data, start, per_s, size, steps * data.interval_s) for steps in _DECAYS]
    return max((Climb([base], base.start, few) for base in bases), key=lambda one: one.value)


def restart_base(fit: Fit) -> Fit:
    """Return the fit, or a better one that begins anew from the spectrum of what the terms in the mean leave.

    An effect that nobody knew of leads the base astray; once it is a term, the base may be off its best by far.
    """
    data = fit.data
    if not isinstance(fit.terms[0], Base):
        return fit
    mean = fit.mean - fit.theta[5]
    starts = [Climb(fit.terms, fit.theta, data)]
    starts[0].done = True
    for start in spectral_starts(replace(data, y=data.y - mean))[: 2 if data.n <= _LONG else 1]:
        theta = fit.theta.copy()
        theta[:5] = start[:5]
        starts.append(Climb(fit.terms, theta, data))
    best = race(starts, steps_for(data))[0]
    return residuals(fit.terms, best.theta, data) if best.value > fit.log_likelihood + _WORTH_A_RESTART else fit


def _fit_calm(calm: Data) -> Floats:
    """Return the base without shocks, fitted to readings that were calmed."""
    start = spectral_starts(calm)[0]
    return climb([Base(start, shocks=False, box=base_box(calm))], start, calm, iterations=15)[0]


def begin_with(fit: Fit, term: Term) -> list[Floats]:
    """Return free numbers to begin a fit with one more term; several where the base has imitated it."""
    theta = np.concatenate((fit.theta, term.start))
    if not isinstance(fit.terms[0], Base):
        return [theta]
    if isinstance(term, Smoothing):  # what was smoothed has another spectrum, and jumps had been larger
        sharp = replace(fit.data, y=sharpened(fit.data, term.kept).y)
        theta[:5] = spectral_starts(without_jumps(sharp)[0] if fit.base.shocks else sharp)[0][:5]
        if fit.base.shocks:
            theta[_SHOCK_SD] -= log(1 - term.kept)
    elif isinstance(term, DifferenceNoise):  # white noise, or a signal no longer than a reading, stood for it
        known = fit.mean - fit.theta[5]
        anew = theta.copy()
        start = spectral_starts(replace(fit.data, y=fit.data.y - known), rising=True)[0]
        anew[:5], anew[-1] = start[:5], start[-1]
        return [theta, anew]
    elif isinstance(term, Popcorn | HeavyTails) and term.beside:
        return [theta, np.concatenate((term.beside, term.start))]
    return [theta]
