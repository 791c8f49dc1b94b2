"""All checks on the residuals of a fit, in one list."""

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

__all__ = ["check_all"]

_CERTAIN = 1e-12


def check_all(fit: Fit, line_frequency_hz: float | None) -> list[Evidence]:
    """Return the evidence of every check, significant or not."""
    line, band = check_lines(fit, make_periodogram(fit), line_frequency_hz), check_resonance(fit)
    found = [
        line,
        check_wandering_line(fit),
        check_periodic_glitch(fit, line.observed),
        check_pattern(fit),
        band,
        *check_colour(fit),
        check_step(fit),
        check_warm_up(fit),
        check_hole(fit),
        check_overlap(fit),
        check_range_switching(fit),
        *check_moments(fit),
        *check_variance(fit),
        *check_shock_law(fit),
        *check_ring_down(fit),
        check_hump(fit),
        check_echo(fit),
        check_course(fit),
        check_tracks(fit),
        check_teeth(fit),
    ]
    # A level that jumps has no line and no band; while there are some the costly search for it would be in vain.
    if len(fit.terms) == 1 or min(line.p_value, band.p_value) > _CERTAIN:
        found.append(check_popcorn(fit))
    for name in sorted(fit.data.witnesses):
        found += check_witness(fit, name)
    return found
