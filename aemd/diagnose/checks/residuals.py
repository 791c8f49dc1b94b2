"""All checks on the residuals of a fit, in one list."""

from collections.abc import Callable
from functools import partial

from aemd.diagnose.checks.bursts import check_teeth, check_tracks
from aemd.diagnose.checks.colour import check_colour, check_resonance
from aemd.diagnose.checks.folding import check_periodic_glitch
from aemd.diagnose.checks.moments import check_moments
from aemd.diagnose.checks.omnibus import check_course, check_echo, check_hump
from aemd.diagnose.checks.overall import check_variance
from aemd.diagnose.checks.ranges import check_hole, check_overlap, check_range_switching
from aemd.diagnose.checks.rings import check_ring_down
from aemd.diagnose.checks.shapes import check_pattern, check_step, check_warm_up
from aemd.diagnose.checks.shocks import check_shock_law
from aemd.diagnose.checks.spectrum import check_lines, make_periodogram
from aemd.diagnose.checks.telegraph import check_popcorn
from aemd.diagnose.checks.tracks import check_wandering_line
from aemd.diagnose.checks.witnessed import check_witness
from aemd.diagnose.evidence import Evidence
from aemd.diagnose.fit import Fit

__all__ = ["Check", "check_each"]

Check = Callable[[Fit], list[Evidence]]

_CERTAIN = 1e-12
"""p of a line or a band that is there beyond all doubt."""


def check_each(fit: Fit, line_frequency_hz: float | None) -> list[tuple[Evidence, Check]]:
    """Return the evidence of every check, significant or not, and with each the check, to be run on another fit."""

    def lines(fit: Fit) -> list[Evidence]:
        return [check_lines(fit, make_periodogram(fit), line_frequency_hz)]

    def glitch(fit: Fit) -> list[Evidence]:
        return [check_periodic_glitch(fit, lines(fit)[0].observed)]

    (line,), (band,) = lines(fit), _band(fit)
    found = [
        (line, lines),
        (check_wandering_line(fit), _alone(check_wandering_line)),
        (check_periodic_glitch(fit, line.observed), glitch),
        (check_pattern(fit), _alone(check_pattern)),
        (band, _band),
    ]
    found += [(item, check) for check in _CHECKS for item in check(fit)]
    # A level that jumps has no line and no band; while there are some the costly search for it would be in vain.
    if len(fit.terms) == 1 or min(line.p_value, band.p_value) > _CERTAIN:
        found.append((check_popcorn(fit), _alone(check_popcorn)))
    for name in sorted(fit.data.witnesses):
        witness = partial(check_witness, name=name)
        found += [(item, witness) for item in witness(fit)]
    return found


def _alone(check: Callable[[Fit], Evidence]) -> Check:
    return lambda fit: [check(fit)]


_band = _alone(check_resonance)
_CHECKS: tuple[Check, ...] = (
    check_colour,
    *map(_alone, (check_step, check_warm_up, check_hole, check_overlap, check_range_switching)),
    check_moments,
    check_variance,
    check_shock_law,
    check_ring_down,
    *map(_alone, (check_hump, check_echo, check_course, check_tracks, check_teeth)),
)
