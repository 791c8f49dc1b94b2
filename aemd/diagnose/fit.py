"""Maximum likelihood: starts from the spectrum, then the exact filter; and what is left of the readings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import log, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import ndtri

from aemd.diagnose.hypothesis import Base, Data, Parts, Term, base_box, base_start_with_shocks
from aemd.diagnose.kernels import log_densities, predict, whiten
from aemd.diagnose.telegraph import follow_telegraph
from aemd.diagnose.terms.noise import Smoothing

__all__ = ["Fit", "begin_with", "fit_base", "refit", "residuals", "restart_base", "score_log_likelihood"]

Floats = NDArray[np.float64]

_IMPOSSIBLE = 1e9  # nats a reading that what cannot be computed costs
_LONGEST_STEP = 1.5  # of any free number at once; most are logarithms
_CONVERGED = 1e-2  # nats that are not worth another step
_CONVERGED_PER_READING = 1e-6  # in a long record a hundredth of a nat is far below what can be told
_DIFFERENCE = 1e-5  # of a free number, for the derivatives
_SHOCK_GAIN = 6.0  # nats that three more numbers must bring; half of chi-square(3) at 0.7 %
_LARGE = 4.0  # usual changes that a change must be to be a jump
_HOPELESS = 20.0  # nats behind after some steps, from which a start is given up
_FEW_SHOCKS = 8.0  # expected in a record, below which they may be something else
_SHORT = 5_000  # readings below which likelihoods have several tops, and one more start is tried
_LONG = 20_000  # readings beyond which the mixture is first fitted to a part


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


def split(terms: Sequence[Term], theta: Floats) -> list[Floats]:
    """Return each term's free numbers."""
    return np.split(theta, np.cumsum([term.start.size for term in terms])[:-1])


def assemble(terms: Sequence[Term], theta: Floats, data: Data) -> tuple[float, Floats | None, tuple[Any, ...]]:
    """Return the share that a smoothing keeps, what jumps to and fro, and the filter's arguments after the data."""
    parts = Parts(np.zeros(data.y.size), np.zeros(data.y.size), np.ones(data.y.size))
    for term, numbers in zip(terms, split(terms, theta), strict=True):
        term.add(numbers, data, parts)
    states = np.array(parts.states, np.float64)
    arguments = (parts.mean, parts.noise_var, parts.scale, states, parts.shocks, parts.extras)
    return parts.kept, parts.telegraph, arguments


def sharpened(data: Data, kept: float) -> tuple[Floats, Floats | float]:
    """Return the readings before a smoothing, and the logarithm of the density's factor for each, shape (n,).

    After a gap the smoothed reading stands for itself.
    """
    if kept == 0.0:
        return data.y, 0.0
    direct = data.used.copy()
    direct[0] = False
    direct[1:] &= data.used[:-1] & (np.diff(data.slot) == 1)
    before = np.concatenate(([0.0], data.y[:-1]))
    return np.where(direct, (data.y - kept * before) / (1 - kept), data.y), np.where(direct, -np.log1p(-kept), 0.0)


def score_log_likelihood(terms: Sequence[Term], theta: Floats, data: Data) -> float:
    """Return the log-likelihood of the scaled readings."""
    return float(densities(terms, theta, data).sum())


def climb(terms: Sequence[Term], start: Floats, data: Data, iterations: int = 40) -> tuple[Floats, float]:
    """Return the free numbers of a local maximum of the likelihood, and its value.

    Each step is the score over the outer product of the readings' own scores (Berndt, Hall, Hall and Hausman 1974),
    damped as Levenberg and Marquardt damp least squares; the scores are differences of the readings' log densities, so
    a step costs one pass of the filter per free number.
    """
    low, high = np.array([bound for term in terms for bound in term.bounds], np.float64).reshape(-1, 2).T
    theta = np.clip(start, low, high)
    here = densities(terms, theta, data)
    value, damping, enough = float(here.sum()), 1e-3, max(_CONVERGED, _CONVERGED_PER_READING * data.n)
    if not theta.size:
        return theta, value
    for _ in range(iterations):
        scores = readings_scores(terms, theta, data, here, high)
        gradient, curvature = scores.sum(axis=0), scores.T @ scores
        pinned = ((theta <= low) & (gradient < 0)) | ((theta >= high) & (gradient > 0))
        gradient[pinned] = 0.0
        curvature[pinned], curvature[:, pinned] = 0.0, 0.0
        scale = np.diag(curvature) + 1e-6
        promised = 0.0
        while damping < 1e6:
            step = np.linalg.solve(curvature + np.diag(damping * scale), gradient)
            step *= min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), 1e-12))
            trial = np.clip(theta + step, low, high)
            promised = float(gradient @ (trial - theta))
            there = densities(terms, trial, data)
            if float(there.sum()) > value:
                break
            damping *= 10.0
            if promised < enough:
                return theta, value
        else:
            return theta, value
        gained = float(there.sum()) - value
        theta, here, value, damping = trial, there, value + gained, max(damping / 10.0, 1e-7)
        if gained < enough and promised < 10 * enough:
            break
    return theta, value


def densities(terms: Sequence[Term], theta: Floats, data: Data) -> Floats:
    """Return the log density of each scaled reading, shape (n,)."""
    kept, telegraph, arguments = assemble(terms, theta, data)
    y, factor = sharpened(data, kept)
    if telegraph is None:
        each = log_densities(y, data.used, data.step_s, *arguments) + factor
    else:
        each = follow_telegraph(y, data.used, data.step_s, *arguments[:4], telegraph)[0] + factor
    return each if np.isfinite(each).all() else np.full(each.size, -_IMPOSSIBLE)


def readings_scores(terms: Sequence[Term], theta: Floats, data: Data, here: Floats, high: Floats) -> Floats:
    """Return the derivative of each reading's log density by each free number, shape (n, k)."""
    scores = np.empty((here.size, theta.size))
    for number in range(theta.size):
        aside = theta.copy()
        width = _DIFFERENCE if theta[number] + _DIFFERENCE <= high[number] else -_DIFFERENCE
        aside[number] += width
        scores[:, number] = (densities(terms, aside, data) - here) / width
    return scores


def residuals(terms: Sequence[Term], theta: Floats, data: Data) -> Fit:
    """Return the fit with these free numbers and what it leaves."""
    kept, telegraph, arguments = assemble(terms, theta, data)
    y, factor = sharpened(data, kept)
    if telegraph is None:
        each, z, predicted, variance, gains = predict(y, data.used, data.step_s, *arguments)
    else:
        each, z, predicted, variance, gains = follow_telegraph(y, data.used, data.step_s, *arguments[:4], telegraph)
    each = each + factor
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
        innovation=(y - predicted) * (1 - kept),
        white=float(np.sqrt(np.median(arguments[1]))),
    )


def refit(terms: Sequence[Term], data: Data, start: Floats | None = None) -> Fit:
    """Fit all terms together, from their starts."""
    theta = np.concatenate([term.start for term in terms]) if start is None else start
    theta, _ = climb(terms, theta, data, iterations=40 if data.n <= _LONG else 15)
    return residuals(terms, theta, data)


def fit_base(data: Data) -> Fit:
    """Fit the base model: without shocks from the spectrum's best starts, then with shocks if they earn their keep."""
    box = base_box(data)
    best, top = np.empty(0), -np.inf
    for start in _spectral_starts(data)[: 3 if data.n < _SHORT else 2]:
        theta, value = climb([Base(start, shocks=False, box=box)], start, data)
        if value > top:
            best, top = theta, value
    plain = Base(best, shocks=False, box=box)
    fit = residuals([plain], best, data)
    shocked = _with_shocks(fit)
    if shocked is None or shocked.log_likelihood < fit.log_likelihood + _SHOCK_GAIN:
        return fit
    # A handful of events may be one step, which slow shocks imitate: then the base is the one without, and a check of
    # the residuals has the step to find.
    if np.exp(shocked.theta[6]) * data.span_s < _FEW_SHOCKS and _with_step(fit) > shocked.log_likelihood:
        return fit
    return shocked


def _with_step(fit: Fit) -> float:
    """Return the log-likelihood with the one step that the residuals show most clearly."""
    z = np.abs(fit.z)
    at = int(np.argmax(z))
    shape = (np.arange(z.size) >= at).astype(np.float64)
    left = fit.whitened(shape)
    size = float(left @ left)
    return fit.log_likelihood + 0.5 * float(left @ fit.z) ** 2 / size if size > 0 else -np.inf


def _with_shocks(fit: Fit) -> Fit | None:
    """Return the best fit with shocks, if the residuals of one without ask for any."""
    data, used = fit.data, fit.data.used
    z = fit.z[used]
    width = 1.4826 * float(np.median(np.abs(z)))
    out = np.abs(z) > -ndtri(0.005 / z.size) * width  # one clean record in a hundred has one
    kurtosis = float(np.mean((z / z.std()) ** 4)) - 3
    if not out.any() and kurtosis < 4 * sqrt(24 / z.size):
        return None
    # Shocks widened the noise of the fit without them; the core of its residuals tells by how much.
    theta = fit.theta.copy()
    theta[[1, 3, 4]] += log(min(width, 1.0))
    core = sqrt(float(np.median(fit.variance[used]))) * width
    large = max(float(np.std(z[out])) / width * core if out.any() else 0.0, 3 * core)
    rate = max(int(np.count_nonzero(out)), 1) / data.span_s
    some = data if data.n <= _LONG else data.only(np.arange(data.y.size) < _LONG)
    calm, jumps_per_s, jump = _without_jumps(some)
    begins = [(theta, rate * more, large) for more in (1.0, 4.0)]
    if jump > 0:
        begins += [(start, jumps_per_s, jump) for start in (fit_calm(calm), *_usual_starts(some))]
    few = data if data.n <= _SHORT else data.only(np.arange(data.y.size) < _SHORT)
    starts: list[Base] = []
    for decay_steps in (0.3, 2.0, 6.0, 20.0):  # the best of each decay, or the starts are all of one kind
        alike = [
            base_start_with_shocks(data, start, per_s, size, decay_steps * data.interval_s)
            for start, per_s, size in begins
        ]
        alike.sort(key=lambda base: -score_log_likelihood([base], base.start, few))
        starts += alike[: 3 if data.n <= _SHORT else 1]
    tried = [climb([base], base.start, some, iterations=8) for base in starts]
    top = max(value for _, value in tried)
    tried = [climb([starts[0]], found, some, iterations=25) for found, value in tried if value > top - _HOPELESS]
    found, _ = max(tried, key=lambda item: item[1])
    if some is not data:
        found, _ = climb([starts[0]], found, data)
    return residuals([starts[0]], found, data)


def restart_base(fit: Fit) -> Fit:
    """Return the fit, or a better one that begins anew from the spectrum of what the terms in the mean leave.

    An effect that nobody knew of leads the base astray; once it is a term, the base may be off its best by far.
    """
    data = fit.data
    if not isinstance(fit.terms[0], Base):
        return fit
    mean = fit.mean - fit.theta[5]
    best, top = fit.theta, fit.log_likelihood
    for start in _spectral_starts(replace(data, y=data.y - mean))[:2]:
        theta = fit.theta.copy()
        theta[:5] = start[:5]
        found, value = climb(fit.terms, theta, data, iterations=8)
        if value > top - _HOPELESS:
            found, value = climb(fit.terms, found, data)
        if value > top + _CONVERGED:
            best, top = found, value
    return fit if best is fit.theta else residuals(fit.terms, best, data)


def fit_calm(calm: Data) -> Floats:
    """Return the base without shocks, fitted to readings that were calmed."""
    start = _spectral_starts(calm)[0]
    return climb([Base(start, shocks=False, box=base_box(calm))], start, calm, iterations=15)[0]


def _usual_starts(data: Data) -> list[Floats]:
    """Return starts for the base that share the usual change between readings out among signal and noise."""
    usual = 1.4826 * float(np.median(np.abs(np.diff(data.y))))
    step = data.interval_s
    return [
        np.array(
            [
                log(tau_steps * step),
                log(share * usual / sqrt(step)),
                log(min(1000 * step, data.span_s)),
                log(0.1 * usual / sqrt(step)),
                log(sqrt(1 - share**2) * usual / sqrt(2)),
                0.0,
            ]
        )
        for tau_steps in (3.0, 15.0, 75.0)
        for share in (0.3, 0.7, 0.95)
    ]


def _without_jumps(data: Data) -> tuple[Data, float, float]:
    """Return the readings with their large changes cut off, how many jumps there were per second, and their size.

    Where shocks dwarf everything, what is fitted without them describes nothing. A jump and the steep part of its decay
    are large changes both; cut to what is usual, their sum leaves a record of the rest, good enough to begin with.
    """
    change = np.diff(data.y)
    usual = 1.4826 * float(np.median(np.abs(change[data.used[1:] & data.used[:-1]])))
    large = np.abs(change) > _LARGE * usual
    calm = np.concatenate(([0.0], np.cumsum(np.clip(change, -_LARGE * usual, _LARGE * usual))))
    first = large & ~np.concatenate(([False], large[:-1]))
    if not first.any():
        return data, 0.0, 0.0
    size = float(np.sqrt(np.mean(change[first] ** 2)))
    return replace(data, y=calm), int(np.count_nonzero(first)) / data.span_s, size


def begin_with(fit: Fit, term: Term) -> Floats:
    """Return free numbers to begin a fit with one more term."""
    theta = np.concatenate((fit.theta, term.start))
    if isinstance(term, Smoothing) and isinstance(fit.terms[0], Base):  # what was smoothed has another spectrum
        y, _ = sharpened(fit.data, term.kept)
        theta[:5] = _spectral_starts(replace(fit.data, y=y))[0][:5]
    return theta


def _spectral_starts(data: Data) -> list[Floats]:
    """Return starts for the base, best first: pairs of time constants, their levels by weighted least squares.

    Whittle's approximation on averaged bins of the periodogram; it judges nothing, it only says where to begin.
    """
    slots = data.slot[data.used]
    even = np.interp(np.arange(slots[-1] + 1), slots, data.y[data.used])
    step = data.interval_s
    n = even.size
    line = np.linspace(even[: max(n // 20, 1)].mean(), even[-max(n // 20, 1) :].mean(), n)  # what leaks the most
    taper = np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2
    power = np.abs(np.fft.rfft((even - line) * taper))[1:] ** 2 / np.sum(taper**2) * step  # two-sided, units^2 s
    f = np.fft.rfftfreq(n, step)[1:]
    edges = np.unique(np.geomspace(1, f.size + 1, 61).astype(int)) - 1
    counts = np.diff(edges)
    # The logarithm's mean and not the power's, so that a line does not pull its bin up; Euler's constant makes it even.
    bins = np.exp(np.add.reduceat(np.log(np.maximum(power, 1e-300)), edges[:-1]) / counts + np.euler_gamma)
    centre = np.add.reduceat(f, edges[:-1]) / counts
    counts = counts * 0.5  # the taper correlates neighbours
    taus = np.geomspace(step, 3 * data.span_s, 12)
    shapes = [_markov_spectrum(centre, tau, step) for tau in taus]
    white = np.full(centre.size, step)
    found: list[tuple[float, Floats]] = []
    typical = max(data.span_s, step)
    for fast, slow in combinations(range(taus.size), 2):
        design = np.column_stack((shapes[fast], shapes[slow], white))
        model = bins.copy()
        levels = np.ones(3)
        for _ in range(4):
            weight = np.sqrt(counts) / np.maximum(model, 1e-12 * bins.max())
            levels, _ = nnls(design * weight[:, None], bins * weight)
            model = np.maximum(design @ levels, 1e-9 * bins.max())
        cost = float(np.sum(counts * (np.log(model) + bins / model)))
        rate_s, rate_d = (sqrt(max(level, 1e-8 / typical)) for level in levels[:2])
        noise = sqrt(max(levels[2], 1e-3))
        found.append((cost, np.array([log(taus[fast]), log(rate_s), log(taus[slow]), log(rate_d), log(noise), 0.0])))
    found.sort(key=lambda item: item[0])
    kept: list[Floats] = []
    for _, theta in found:  # starts that differ
        if all(np.abs(theta[[0, 2]] - other[[0, 2]]).max() > 1.5 for other in kept):
            kept.append(theta)
    return kept


def _markov_spectrum(f: Floats, tau_s: float, step_s: float) -> Floats:
    """Return the two-sided spectrum of a sampled first-order process of unit rate, s (units^2 s for rate 1)."""
    phi = np.exp(-step_s / tau_s)
    sd2 = tau_s / 2
    return np.asarray(sd2 * step_s * (1 - phi**2) / (1 - 2 * phi * np.cos(2 * np.pi * f * step_s) + phi**2))
