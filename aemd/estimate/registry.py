"""The estimators by name, and the way from options to an estimator and back."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from aemd.errors import ConfigError, not_among
from aemd.estimate.aem import Aem, AemOptions
from aemd.estimate.compiled import FEW
from aemd.estimate.imm import Imm, ImmOptions
from aemd.estimate.kalman import Kalman, KalmanOptions
from aemd.estimate.lms import Lms, LmsOptions
from aemd.estimate.protocol import Estimator
from aemd.estimate.reference import Filterpy
from aemd.estimate.rem import Rem, RemOptions
from aemd.estimate.state import count_numbers

__all__ = ["ESTIMATORS", "make_estimator", "options_of"]

ESTIMATORS: dict[str, tuple[type[Any], type[Any]]] = {
    "aem": (AemOptions, Aem),
    "rem": (RemOptions, Rem),
    "kalman": (KalmanOptions, Kalman),
    "lms": (LmsOptions, Lms),
    "filterpy": (KalmanOptions, Filterpy),
    "imm": (ImmOptions, Imm),
}
"""Name -> its options (a frozen dataclass) and its class, made from options and the interval in seconds."""


MOST_NUMBERS_PER_S = 6000
"""That are worth no compiler: what a reading costs as written grows with the numbers that are carried from one to the
next, by up to 7 us each. That is 4 % of a core at worst; as shipped, at 15 readings/s, it is 0.3 %."""
SLOW_HZ = 50.0


def make_estimator(name: str, options: Any, interval_s: float, *, is_live: bool = False) -> Estimator:
    """Return a new estimator.

    Args:
        name: key of ESTIMATORS.
        options: its options object, or a mapping of fields to values; what is missing has its default.
        interval_s: between readings, s.
        is_live: it gets readings as they come, so at a slow rate it is spared the compiler; the bits are the same.

    Raises:
        ConfigError: no such estimator, no such option, or a value out of bounds.

    >>> make_estimator("kalman", {"sigma_R_V": 1e-6}, 1 / 15).name
    'kalman'
    """
    if name not in ESTIMATORS:
        raise ConfigError(f"no estimator {name!r}; {not_among(name, ESTIMATORS)}")
    options_type, estimator_type = ESTIMATORS[name]
    if isinstance(options, Mapping):
        unknown = [key for key in options if key not in options_type.__dataclass_fields__]
        if unknown:
            known = ", ".join(options_type.__dataclass_fields__)
            raise ConfigError(f"estimator {name!r}: {unknown[0]}: no such option; there are: {known}")
        # A table of a config file has lists where the options have tuples.
        values = {key: tuple(value) if isinstance(value, list) else value for key, value in options.items()}
        try:
            options = options_type(**values)
        except ValueError as error:
            raise ConfigError(f"estimator {name!r}: {error}") from error
    if type(options) is not options_type:
        raise ConfigError(f"estimator {name!r}: takes {options_type.__name__}, not {type(options).__name__}")
    if is_live and interval_s * SLOW_HZ >= 1:
        live: Estimator = estimator_type(options, interval_s, FEW)
        if count_numbers(live) <= MOST_NUMBERS_PER_S * interval_s:
            return live
    estimator: Estimator = estimator_type(options, interval_s)
    return estimator


def options_of(estimator: Any) -> dict[str, Any]:
    """Return all options of an estimator as plain values; `make_estimator` makes its exact copy from them.

    The interval is not among them: it is `estimator.interval_s`.
    """
    return asdict(estimator.options)
