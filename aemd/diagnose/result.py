"""What a diagnosis is, as frozen records whose fields are the JSON's keys."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

__all__ = ["Allan", "Diagnosis", "Discrepancy", "Finding", "Gain", "Likely", "Promise", "Value", "Verdict", "exact"]

Verdict = Literal["nothing_found", "explained", "unexplained"]


@dataclass(frozen=True, slots=True)
class Value:
    """A parameter with its 95 % interval."""

    value: float
    low: float
    high: float
    unit: str


def exact(value: float, unit: str) -> Value:
    """Return a value that is counted, not estimated."""
    return Value(value, value, value, unit)


@dataclass(frozen=True, slots=True)
class Gain:
    """What a term is worth on blocks that its fit never saw."""

    nats_per_reading: float
    nats_total: float
    low: float
    """Of the total: 95 % interval, nats."""
    high: float


@dataclass(frozen=True, slots=True)
class Finding:
    """One discrepancy with its name."""

    cause: str
    """The most probable name."""
    names: tuple[str, ...]
    """It, and those that the data cannot tell from it, most probable first."""
    probability: float
    """Of the first among the rivals that were fitted, each given the same prior odds."""
    p_value: float
    """Of the check that found it, over its whole grid."""
    d_nats: float
    """Log-likelihood that the term adds, less half a nat for each free number; 0 where no term is added."""
    parameters: Mapping[str, Value]
    gain: Gain
    rms_before: float
    """Root mean square of the one-step prediction's error without the term, V."""
    rms_after: float
    experiment: str
    """The cheapest one that would tell the names apart, or test the one."""
    remark: str = ""
    """What to say of it beyond its names: where none of the catalogue does, such as that a stated model's noise is of
    another size; where there is one, why it may not be it."""


@dataclass(frozen=True, slots=True)
class Discrepancy:
    """A check that the base model fails, and where simulations of it lie."""

    check: str
    observed: float
    simulated_low: float
    """2.5 % quantile of the statistic's law under the model under criticism."""
    simulated_high: float
    p_value: float


@dataclass(frozen=True, slots=True)
class Allan:
    """How steady the readings are over an averaging time, as they are and without what the findings account for."""

    averaging_s: float
    before_V: float
    after_V: float


@dataclass(frozen=True, slots=True)
class Likely:
    """A figure and the range in which 95 % of further records have it."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Promise:
    """What the extended model's estimator should deliver on a further record of the same kind."""

    error_before_V: float
    """Root mean square error of the estimate against the input over a record, a constant apart, by the base's
    estimator."""
    error_after_V: float
    """The same, by the extended model's."""
    ratio: Likely
    """Of the second to the first."""
    nats_per_reading: Likely
    """By which the estimator's own prediction of each reading becomes more probable."""
    readings: int
    """Of the record."""
    taken: bool = True
    """Whether the estimator takes it up; else it has no place for what was found, and the base's does as well."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The whole answer."""

    verdict: Verdict
    n: int
    rate_hz: float
    findings: tuple[Finding, ...]
    discrepancies: tuple[Discrepancy, ...]
    base_model: Mapping[str, Any]
    extended_model: Mapping[str, Any]
    seconds: float
    gain: Gain | None = None
    """Of the extended model over the base, all findings together; none where no term was added."""
    allan: tuple[Allan, ...] = ()
    """At 1, 10 and 100 s, as far as the record allows. Only what the findings predict can be taken off: a line, a step
    or a temperature's share can, additional noise cannot."""
    left_out: int = 0
    """Readings of the file behind the judged ones: of a very long record the beginning is judged."""
    promise: Promise | None = None
    """Of the extended model's estimator; none where no term was added, or the model has no input to estimate."""
    path: str = ""
    """The file."""
    covered: tuple[str, ...] = field(default=())
    """Mechanisms that were looked for."""
    not_covered: tuple[str, ...] = field(default=())
    """Mechanisms of the catalogue that were not looked for."""
