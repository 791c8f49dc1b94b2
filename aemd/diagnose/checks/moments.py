"""Whether the residuals keep their variance and their tails, and whether these follow the clock or the reading."""

from collections.abc import Callable
from dataclasses import replace
from math import exp, log, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.stats import kurtosistest, norm

from aemd.diagnose.checks.gains import LONG, MOST_OF_ONE, gain_of, tail_of_one
from aemd.diagnose.checks.tails import gain_of_tails, tail_of_gain
from aemd.diagnose.climb import assemble
from aemd.diagnose.evidence import Evidence, bonferroni, two_sided, weighted_chi2_tail
from aemd.diagnose.fit import Fit
from aemd.diagnose.hypothesis import Base, Term
from aemd.diagnose.naming import left_out
from aemd.diagnose.terms.lines import amplitude_cost
from aemd.diagnose.terms.noise import ChangingNoise, HeavyTails, SignalDependentNoise, SwellingNoise
from aemd.diagnose.terms.shapes import Nonlinearity
from aemd.diagnose.terms.witnessed import SupplyCoupling, odds_against
from aemd.model import RangeSwitching

__all__ = ["check_moments", "tail_of_growth"]

Floats = NDArray[np.float64]
Outcome = tuple[Evidence, Callable[[], list[Term]]]
"""Evidence, and what makes the terms that could explain it."""

_LEVERAGE = 20.0
"""Times its usual size, at which a shape is cut."""
_LIMIT = 16.0
"""Of a squared residual, where a stretch of others is sought."""
_EDGES = 150
"""Places that begin and end are tried at before they are refined."""
_LEAST = 20
"""Readings within such a stretch, and beside it."""
_LEAST_LEFT = 0.05
"""Of the base's white noise, beside a noise that grows with the reading."""
_MOST_OF_GROWTH = 2.115
"""Nats that 19 records of 20 gain at most by a noise that grows; see `tail_of_growth`."""
_WORTH_A_FIT = 0.01
"""p from which the look-alikes are prepared; far above the level of any finding."""


def kuiper_tail(range_: float) -> float:
    """Return the probability that a Brownian bridge has a larger range (Kuiper 1960).

    >>> round(kuiper_tail(1.747), 3)
    0.05
    """
    j = np.arange(1, 20)
    terms = 2 * (4 * j**2 * range_**2 - 1) * np.exp(-2 * j**2 * range_**2)
    return float(np.clip(terms.sum(), 0.0, 1.0)) if range_ > 0.5 else 1.0


def check_moments(fit: Fit) -> list[Evidence]:
    """Run the tests of variance, tails and scale; where one fails, each names all that the others look for.

    They share their look-alikes: a gain that flickers makes tails, and a noise that follows a slow reading changes.
    """
    tests = (_changing_noise, _tails, _signal_dependent_noise, _nonlinearity)
    outcomes = [test(fit) for test in tests]
    if min(evidence.p_value for evidence, _ in outcomes) > _WORTH_A_FIT:
        return [evidence for evidence, _ in outcomes]
    terms = (*(term for _, make in outcomes for term in make()), *_gains(fit))
    return [replace(item, terms=terms) if item.p_value <= _WORTH_A_FIT else item for item, _ in outcomes]


def _gains(fit: Fit) -> list[Term]:
    """Return a gain for each witness that the residuals' squares follow: what it scales is louder at times, too."""
    used = fit.data.used
    squares, made = fit.z[used] ** 2, list[Term]()
    for name, values in sorted(fit.data.witnesses.items()):
        apart = values[used] - values[used].mean()
        slope = float(apart @ (squares - squares.mean())) / max(float(apart @ apart), 1e-300)
        cost = amplitude_cost(1, fit.data.n) + odds_against("supply_coupling", name)
        made.append(SupplyCoupling(name, slope / 2, cost))
    return made


def _changing_noise(fit: Fit) -> Outcome:
    """Sum z^2 - 1 along the record: the range of that walk is that of a Brownian bridge if the variance stays.

    The range and not the largest excursion, so that noise that comes and goes counts as much as noise that stays. The
    walk's ends are not quite the likeliest instants, least where one is near an end of the record: both are tried.
    """
    used = fit.data.used
    squares = fit.z[used] ** 2
    walk = np.concatenate(([0.0], np.cumsum(squares - squares.mean()))) / (sqrt(squares.size) * float(squares.std()))
    low, high = int(np.argmin(walk)), int(np.argmax(walk))
    begin, end = min(low, high), max(low, high)
    range_ = float(walk[high] - walk[low])

    def terms() -> list[Term]:
        windows = dict.fromkeys(((begin, end), likeliest_window(squares)))
        return [term for window in windows for term in _louder(fit, squares, *window)]

    evidence = Evidence(
        check="range of the summed squares of the residuals, in units of a Brownian bridge",
        p_value=kuiper_tail(range_),
        observed=range_,
        low=0.94,
        high=1.86,
    )
    return evidence, terms


def likeliest_window(squares: Floats) -> tuple[int, int]:
    """Return begin and end of the stretch whose mean square differs most from the rest's by the normal likelihood.

    Args:
        squares: of residuals, shape (n,); large ones are limited, as they are a matter of tails.
    """
    n = squares.size
    total = np.concatenate(([0.0], np.cumsum(np.minimum(squares, _LIMIT))))

    def worth(begin: NDArray[np.int64], end: NDArray[np.int64]) -> Floats:
        inside = end - begin
        sums = total[end] - total[begin], total[n] - total[end] + total[begin]
        counts = inside, n - inside
        nats = [
            -0.5 * m * np.log(np.maximum(part, 1e-9) / np.maximum(m, 1)) for part, m in zip(sums, counts, strict=True)
        ]
        return np.asarray(np.where(np.minimum(*counts) >= _LEAST, nats[0] + nats[1], -np.inf))

    edges = np.unique(np.linspace(0, n, _EDGES).astype(np.int64))
    first, second = np.triu_indices(edges.size, 1)
    best = int(np.argmax(worth(edges[first], edges[second])))
    begin, end = int(edges[first[best]]), int(edges[second[best]])
    near = np.arange(-(n // _EDGES) - 1, n // _EDGES + 2)
    for _ in range(2):  # an end of the record stays one
        begins = np.clip(begin + near, 0, end) if begin else np.zeros(1, np.int64)
        begin = int(begins[np.argmax(worth(begins, np.full(begins.size, end)))])
        ends = np.clip(end + near, begin, n) if end < n else np.full(1, n)
        end = int(ends[np.argmax(worth(np.full(ends.size, begin), ends))])
    return begin, end


def _louder(fit: Fit, squares: Floats, begin: int, end: int) -> list[Term]:
    """Return a noise that changes from one reading to another, and what else is louder or fainter there."""
    inside = float(squares[begin:end].mean())
    outside = float(np.concatenate((squares[:begin], squares[end:], [1.0])).mean())
    t_s = np.append(fit.data.t_s[fit.data.used], fit.data.span_s)
    cost = amplitude_cost(1, fit.data.n) + 2 * log(fit.data.n / max(end - begin, 1) + 1)
    # What is measured is all of the innovation; the white noise in it has to change by more.
    share = float(np.median(fit.variance[fit.data.used])) / fit.white**2
    wanted = max(1 + (inside / outside - 1) * share, 0.05)
    window = float(t_s[begin]), float(t_s[end])
    return [
        ChangingNoise(*window, sqrt(wanted), cost),
        ChangingNoise(*window, sqrt(max(inside / outside, 0.05)), cost, everything=True),
        SwellingNoise((window[0] + window[1]) / 2, (window[1] - window[0]) / 3, sqrt(wanted), cost),
    ]


def _tails(fit: Fit) -> Outcome:
    """Compare the residuals' fourth moment with the normal law's (Anscombe and Glynn 1983), and fit tails to them."""
    z = fit.z[fit.data.used]
    score = float(kurtosistest(z).statistic)
    gain, fitted = gain_of_tails(fit)

    def terms() -> list[Term]:
        excess = max(float(np.mean((z / z.std()) ** 4)) - 3, 0.05)
        core = sqrt(float(np.median(fit.variance[fit.data.used])))
        sizes = ((0.01, 3.0), (0.05, 2.0), (min(0.2, excess), 1.2))
        cost = amplitude_cost(2, fit.data.n)
        begun = [HeavyTails(fraction, ratio * core, cost) for fraction, ratio in sizes]
        return [*begun, fitted] if fitted else list(begun)

    evidence = Evidence(
        check="kurtosis of the residuals: score in deviations",
        p_value=bonferroni(min(float(norm.sf(score)), tail_of_gain(gain)), 2),
        observed=score,
        low=-1.96,
        high=1.96,
    )
    return evidence, terms


def _limited(shape: Floats) -> Floats:
    """Return a shape cut to some times its usual size.

    Where a few shocks dwarf everything, a score would be the sum of a few residuals, and no central limit holds for it.
    The weights are known before the residual, cut or not, so the score's mean stays zero.
    """
    bound = _LEVERAGE * float(np.median(np.abs(shape)))
    return np.clip(shape, -bound, bound)


def _signal_dependent_noise(fit: Fit) -> Outcome:
    """Regress z^2 on the square of the predicted reading, which the readings before it alone decide."""
    data, used = fit.data, fit.data.used
    reading = (fit.predicted + data.origin_V / data.unit_V)[used]
    shape = _limited(reading**2 / fit.variance[used])
    shape = shape - shape.mean()
    size = max(float(np.sqrt(np.sum(shape**2))), 1e-300)
    squares = fit.z[used] ** 2
    raw = float(shape @ (squares - squares.mean())) / size
    score = raw / float(squares.std())

    grows = SignalDependentNoise(sqrt(max(raw, 0.1) / size), amplitude_cost(1, data.n))
    gain = gain_of_growth(fit, grows)

    def terms() -> list[Term]:
        return [grows]

    check = "noise that grows with the reading"
    if gain is not None:
        return Evidence(f"{check}: nats gained", tail_of_growth(gain), gain, 0.0, _MOST_OF_GROWTH), terms
    p_value = max(weighted_chi2_tail(shape / size, raw), float(norm.sf(score)))
    return Evidence(f"{check}: score in deviations", p_value, score, -1.96, 1.96), terms


def gain_of_growth(fit: Fit, begun: SignalDependentNoise) -> float | None:
    """Return the log-likelihood that a noise adds which grows with the reading; None where it is not sought.

    With what the filter leaves out of it, the skewness of single readings: of a fast input in much noise, whose square
    no prediction tells, that is the most of it.

    The base has taken it for white noise, of which a climb begins with as much less. The score's size is by leverages
    that had to be limited, so it may begin far too loud beside shocks.
    """
    if fit.data.n > LONG or assemble(fit.terms, fit.theta, fit.data)[1].extras[0] != 0:
        return None
    used = fit.data.used
    power = float(np.mean((fit.predicted[used] + fit.data.origin_V / fit.data.unit_V) ** 2))
    starts = []
    for term in (begun, replace(begun, fraction=begun.fraction / 3)):
        theta = np.append(fit.theta, term.start)
        if isinstance(fit.terms[0], Base):
            theta[4] += 0.5 * log(max(1 - term.fraction**2 * power / exp(2 * theta[4]), _LEAST_LEFT))
        starts.append((term, theta))
    gain, theta = gain_of(fit, starts)
    return gain + left_out([*fit.terms, begun], theta, fit.data) if gain > 0 else gain


def tail_of_growth(gain: float) -> float:
    """Return the probability that such a noise adds so much to a record that has none, nats.

    A variance ends at none, and the skewness is that of all of it at most: of two numbers, of which both are above
    nothing in a quarter of the records at most, and one alone in half of them.

    >>> round(tail_of_growth(2.115), 3)
    0.05
    """
    return 0.5 * tail_of_one(gain) + 0.25 * exp(-gain) if gain > 0 else 1.0


def gain_of_bend(fit: Fit, begun: Nonlinearity) -> float | None:
    """Return the log-likelihood that a bent scale adds to a fit, all else fitted again; None where it is not sought.

    Not beside a noise that grows with the reading, nor a bend that is stated and met by its slope: they are skew, of
    which the filter knows nothing, and a bend is the next best thing. Nor where ranges switch: a bend that moves
    readings across the switch gains by each, and no normal law says how much.
    """
    stated = getattr(fit.terms[0], "stated", None)
    if stated is not None and any(isinstance(effect, RangeSwitching) for effect in stated.effects):
        return None
    if any(term.cause == "range_switching" for term in fit.terms):
        return None
    skew = assemble(fit.terms, fit.theta, fit.data)[1].extras[:2].any()
    if skew or fit.data.n > LONG or any(isinstance(term, Nonlinearity) for term in fit.terms):
        return None
    return gain_of(fit, [(begun, np.append(fit.theta, begun.start))])[0]


def _nonlinearity(fit: Fit) -> Outcome:
    """Test for y = x + b x^2: it shifts the prediction by x^2, and makes the noise of x count 1 + 2 b x times.

    Both parts of the score are sums whose terms the readings before them decide, so they have mean zero and add their
    variances. Slow parts of x^2 are the drift's business; whitening takes them out. The likelihood sees more than this
    score does: that noise is bent as well, and the large shocks, which are too few for a sum's normal law.
    """
    data, used = fit.data, fit.data.used
    state = np.where(used, fit.predicted - fit.mean, 0.0)
    shift = _limited(fit.whitened(state**2))
    share = 1 - fit.white**2 / fit.variance
    louder = _limited(np.where(used, 4 * state * np.maximum(share, 0.0), 0.0))
    louder[used] -= louder[used].mean()
    squares = np.where(used, fit.z**2 - 1, 0.0)
    variance = float(np.sum(shift**2) + 0.25 * np.sum(louder**2) * float(np.mean(squares[used] ** 2)))
    raw = float(shift @ fit.z + 0.5 * (louder @ squares))
    score = raw / sqrt(max(variance, 1e-300))
    bent = Nonlinearity(raw / max(variance, 1e-300), amplitude_cost(1, data.n))
    gain = gain_of_bend(fit, bent)

    def terms() -> list[Term]:
        return [bent]

    if gain is not None:
        check, p_value, observed, low, high = "nats gained by the bend", tail_of_one(gain), gain, 0.0, MOST_OF_ONE
    else:
        check, p_value, observed, low, high = "score in deviations", two_sided(score), score, -1.96, 1.96
    return Evidence(f"residuals against a bent scale: {check}", p_value, observed, low, high), terms
