"""What is measured of an estimate of which the truth is known."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from aemd.block import Estimates
from aemd.paper.protocol import INTERVAL_S, SIGNAL_HZ, Condition, Record

__all__ = ["MEASURES", "Measured", "measure"]

INTERVAL_WIDTH = 1.959963984540054  # half a 95 % interval of a Gaussian, in standard deviations


@dataclass(frozen=True, slots=True)
class Measured:
    """The figures of one method on one record; NaN where there is nothing to measure."""

    variance_mV2: float
    """Of the estimate about its mean: the paper's figure, which a filter that prints a constant wins."""
    mse_mV2: float
    """Mean squared error against the truth."""
    gain: float
    """Of the estimate over that of the truth, all readings; see `measure`."""
    gain_undisturbed: float
    """The same over the readings without an abrupt disturbance."""
    phase_rad: float
    """By which the estimate leads."""
    coverage_quiet: float
    """Share of the readings without an abrupt disturbance whose truth is within 1.96 sigma of the estimate."""
    coverage_disturbed: float
    """The same of the others."""
    passes: float
    """Expectation-maximisation passes per reading; 0 where there are none."""


MEASURES = tuple(field.name for field in fields(Measured))


def measure(condition: Condition, record: Record, estimates: Estimates) -> Measured:
    """Return the figures of one method on one record.

    Gain and phase are those of the least-squares sine of 0.2 Hz in the estimate, over that in the truth. A broadband
    input has no frequency of its own: there the gain is the regression of the estimate on the truth. A static one has
    no gain.
    """
    value_V, truth_V, quiet = estimates["value_V"], record.truth_V, ~record.disturbed
    error_V = value_V - truth_V
    covered = np.abs(error_V) <= INTERVAL_WIDTH * estimates["sigma_V"]
    response = _response(condition, value_V, truth_V, np.ones(quiet.size, dtype=bool))
    return Measured(
        variance_mV2=1e6 * float(np.var(value_V)),
        mse_mV2=1e6 * float(np.mean(error_V**2)),
        gain=float(np.abs(response)),
        gain_undisturbed=float(np.abs(_response(condition, value_V, truth_V, quiet))),
        phase_rad=float(np.angle(response)) if condition != "broadband" else np.nan,
        coverage_quiet=float(np.mean(covered[quiet])),
        coverage_disturbed=float(np.mean(covered[record.disturbed])),
        passes=float(np.mean(estimates["passes"])),
    )


def _response(
    condition: Condition, value_V: NDArray[np.float64], truth_V: NDArray[np.float64], where: NDArray[np.bool_]
) -> complex:
    if condition == "static":
        return complex(np.nan)
    if condition == "broadband":
        return complex(value_V[where] @ truth_V[where] / (truth_V[where] @ truth_V[where]))
    angle = 2 * np.pi * SIGNAL_HZ * INTERVAL_S * np.flatnonzero(where)
    basis = np.column_stack([np.cos(angle), np.sin(angle), np.ones(angle.size)])
    (cosines, sines, _), *_ = np.linalg.lstsq(basis, np.column_stack([value_V[where], truth_V[where]]), rcond=None)
    estimate, truth = cosines - 1j * sines
    return complex(estimate / truth)
