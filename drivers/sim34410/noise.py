"""The meter's own noise: white, by aperture and range, as the data sheet has it.

The data sheet gives, for each number of power line cycles, a resolution in parts per million of the range and, per
group of ranges, an rms noise adder in percent of the range. The rms noise of a reading is taken as the larger of the
two; on the 10 V and 1000 V ranges, where the adder is twice the resolution, as the resolution alone.
"""

from functools import lru_cache
from math import sqrt

import numpy as np

__all__ = ["LIMITS_V", "NPLC", "RANGES_V", "RESOLUTION", "noise_sd"]

NPLC = (0.001, 0.002, 0.006, 0.02, 0.06, 0.2, 1.0, 2.0, 10.0, 100.0)
"""Integration times of the family, power line cycles; the 34410A has those from 0.006 on."""

RESOLUTION = (30e-6, 15e-6, 6e-6, 3e-6, 1.5e-6, 0.7e-6, 0.3e-6, 0.2e-6, 0.1e-6, 0.03e-6)
"""Of each of them, as a fraction of the range (user's guide, page 51)."""

RANGES_V = (0.1, 1.0, 10.0, 100.0, 1000.0)
"""Full scales."""

LIMITS_V = (0.12, 1.2, 12.0, 120.0, 1000.0)
"""Largest reading of each range: 120 % of it, and 1000 V on the last."""

_ADDER_100_MV = (600e-6, 600e-6, 600e-6, 300e-6, 200e-6, 150e-6, 10e-6, 10e-6, 5e-6, 0.0)
_ADDER_1_AND_100_V = (40e-6, 40e-6, 40e-6, 30e-6, 20e-6, 15e-6, 1e-6, 1e-6, 0.0, 0.0)
_FRACTION = {
    0.1: np.maximum(RESOLUTION, _ADDER_100_MV),
    1.0: np.maximum(RESOLUTION, _ADDER_1_AND_100_V),
    10.0: np.asarray(RESOLUTION),
    100.0: np.maximum(RESOLUTION, _ADDER_1_AND_100_V),
    1000.0: np.asarray(RESOLUTION),
}


@lru_cache(maxsize=64)
def noise_sd(cycles: float, *, autozero: bool) -> tuple[float, ...]:
    """Return the standard deviation of a reading's noise in each of RANGES_V, V.

    Args:
        cycles: aperture in power line cycles; between the table's rows the interpolation is linear in the logarithms,
            beyond its ends the noise stays.
        autozero: a zero with noise of its own is subtracted from each reading, which costs a factor sqrt(2).
    """
    log_nplc, log_cycles = np.log(NPLC), np.log(cycles)
    factor = sqrt(2) if autozero else 1.0
    return tuple(
        factor * range_V * float(np.exp(np.interp(log_cycles, log_nplc, np.log(_FRACTION[range_V]))))
        for range_V in RANGES_V
    )
