"""All checks on the residuals of a fit, in one list."""

from aemd.diagnose.checks.spectrum import check_lines, make_periodogram
from aemd.diagnose.evidence import Evidence
from aemd.diagnose.fit import Fit

__all__ = ["check_all"]


def check_all(fit: Fit, line_frequency_hz: float | None) -> list[Evidence]:
    """Return the evidence of every check, significant or not."""
    periodogram = make_periodogram(fit)
    return [check_lines(fit, periodogram, line_frequency_hz)]
