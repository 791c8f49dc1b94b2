"""Which mechanisms are looked for, which are not, and how each is best tested.

The blind bench keeps a list of its own, tests/blind/envelope.py: what hides effects shares nothing with what finds
them, so a mechanism that is dropped here is missed there.
"""

from collections.abc import Mapping

__all__ = ["COVERED", "EXPERIMENTS", "NOT_COVERED", "experiment_for"]

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

COVERED = _ALL
"""Mechanisms with a check of known law and a term."""

NOT_COVERED = tuple(name for name in _ALL if name not in COVERED)
"""Mechanisms of the catalogue that nothing here looks for; their absence from a report means nothing."""

EXPERIMENTS: Mapping[str, str] = {
    "mains_alias": "shift the reading rate by 0.1 Hz: a folded line moves by a multiple of it, a real one stays; "
    "or set the aperture to whole mains cycles",
    "periodic_interference": "shift the reading rate by 0.1 Hz: a real line stays where it is, a folded one moves",
    "wandering_line": "read the speed of the motors nearby while recording: the line follows one of them, or the grid",
    "periodic_glitch": "stop what switches or saves at this period, or move it: the pulses go or move with it",
    "popcorn_noise": "cool the input stage by some degrees: the jumps come more rarely, and their size stays",
    "range_switching": "fix the range by hand and record again: offset and noise no longer follow the level",
    "latency": "change the input and the witness at once, by hand: the stamps' distance is the lag",
    "shock_law": "note the blows by hand for a minute: their direction is that of the readings, or it is not",
    "ring_down": "tap the bench once: it rings at this frequency after each tap and is silent otherwise",
    "resonance": "tap the bench once: a resonance rings at this frequency and dies away, a line does not",
    "flicker_noise": "record ten times as long: 1/f keeps its slope to the lowest frequency, one process levels off",
    "random_walk": "record ten times as long: a random walk keeps growing with the root of time, others level off",
    "difference_noise": "switch autozero off, or double the aperture: noise that neighbours share goes with its cause",
    "smoothing": "switch the meter's digital filter off and compare how neighbouring readings correlate",
    "extra_gauss_markov": "record ten times as long, and with a short circuit at the input: the meter's own stays",
    "changing_noise": "record a short circuit over the same hours of the day: noise from outside goes",
    "signal_dependent_noise": "record at two input levels: this noise grows with the level, others do not",
    "heavy_tails": "record a short circuit with the same cable: outliers that remain are the meter's",
    "step": "look in the log book at that time; reseat the connector and see whether the level returns",
    "thermal_drift": "change the witness (of a room, by 5 degrees) and let it go back: the reading follows with this "
    "lag, or it does not",
    "warmup_drift": "switch off for an hour, then on again: the same decay comes back, or it was the input",
    "supply_coupling": "change the witness by a known amount at a constant input",
    "nonlinearity": "apply three known levels, evenly spaced: a straight scale keeps their distances equal",
    "reading_pattern": "switch autozero off, or change the readings per trigger: the pattern changes with it",
}
"""The cheapest test of each name."""


def experiment_for(name: str, witness: str = "") -> str:
    """Return the cheapest test of a name, with the witness's own name where the mechanism has one."""
    text = EXPERIMENTS.get(name, "")
    return text.replace("the witness", f"the {witness.replace('_', ' ')}") if witness else text
