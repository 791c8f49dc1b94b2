"""Which mechanisms are looked for, which are not yet, and how each is best tested."""

from collections.abc import Mapping

__all__ = ["COVERED", "EXPERIMENTS", "NOT_COVERED"]

_ALL = (
    "missing_samples",
    "replayed_block",
    "stuck_readings",
    "quantisation",
    "saturation",
    "range_switching",
    "timestamp_jitter",
    "clock_error",
    "latency",
    "mains_alias",
    "periodic_interference",
    "wandering_line",
    "periodic_glitch",
    "resonance",
    "flicker_noise",
    "random_walk",
    "difference_noise",
    "smoothing",
    "extra_gauss_markov",
    "popcorn_noise",
    "changing_noise",
    "signal_dependent_noise",
    "heavy_tails",
    "shock_law",
    "ring_down",
    "step",
    "thermal_drift",
    "warmup_drift",
    "supply_coupling",
    "nonlinearity",
    "dead_band",
    "reading_pattern",
)

COVERED = (
    "missing_samples",
    "replayed_block",
    "stuck_readings",
    "quantisation",
    "saturation",
    "timestamp_jitter",
    "clock_error",
    "mains_alias",
    "periodic_interference",
)
"""Mechanisms with a check of known law and a term."""

NOT_COVERED = tuple(name for name in _ALL if name not in COVERED)
"""Mechanisms of the catalogue that nothing here looks for; their absence from a report means nothing."""

EXPERIMENTS: Mapping[str, str] = {
    "mains_alias": "shift the reading rate by 0.1 Hz: a folded line moves by a multiple of it, a real one stays; "
    "or set the aperture to whole mains cycles",
    "periodic_interference": "shift the reading rate by 0.1 Hz: a real line stays where it is, a folded one moves",
}
"""The cheapest test of each name."""
