"""Each of the catalogue's mechanisms, strong, in a simulation: the true model stands, and without its part it is named.

    python -m tests.diagnose.removed [cause ...]

One line a mechanism: the verdict with the true model stated; what is named first with the part taken out, its D in
nats, and whether the interval of its size holds the size it was given. The last line counts.
"""

import argparse
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from aemd.diagnose import Diagnosis, diagnose
from aemd.errors import AemdError
from aemd.simulate import simulate

__all__ = ["BASE", "CASES", "FAST", "Case", "Outcome", "run_case"]

CALM = """
[[terms]]
term = "level"
level_V = 0.01
[[terms]]
term = "gauss_markov"
rate_V_per_rt_s = 2e-3
tau_s = 0.5
[[terms]]
term = "gauss_markov"
role = "internal"
rate_V_per_rt_s = 1.8e-4
tau_s = 60.0
[[terms]]
term = "white_noise"
density_V_per_rt_hz = 1e-4
"""
SHOCKS = """
[[terms]]
term = "shocks"
rate_per_s = 0.05
sd_V = 8e-3
decay_s = 0.3
"""
BASE = CALM + SHOCKS


@dataclass(frozen=True, slots=True)
class Case:
    """A model with a mechanism, the same without it, and what the report should say of its size."""

    true: str
    less: str = BASE
    size: tuple[str, float] = ("", 0.0)
    """A reported parameter and its true value; no name where there is nothing to be right about."""
    seconds: float = 400.0


def _term(name: str, text: str, size: tuple[str, float] = ("", 0.0), base: str = BASE, seconds: float = 400.0) -> Case:
    return Case(f'{base}[[terms]]\nterm = "{name}"\n{text}\n', base, size, seconds)


def _effect(name: str, text: str, size: tuple[str, float] = ("", 0.0), base: str = BASE) -> Case:
    return Case(f'{base}[[effects]]\neffect = "{name}"\n{text}\n', base, size)


_WARM = '[[terms]]\nterm = "thermal_drift"\ncoefficient_V_per_C = 1e-3\nsd_C = 1.0\ntau_s = 20.0\n'
_OFTEN = BASE.replace("rate_per_s = 0.05", "rate_per_s = 0.2")

CASES: Mapping[str, Case] = {
    "missing_samples": _effect("missing_samples", "fraction = 0.01\ncounted = false"),
    "replayed_block": _effect("replayed_block", "first_index = 2000\nreadings = 50", ("dwell_s", 50 * 0.06712)),
    "stuck_readings": _effect("stuck_readings", "fraction = 0.02\nmean_readings = 10.0"),
    "quantisation": _effect("quantiser", "step_V = 1e-3", ("step_V", 1e-3)),
    "saturation": _effect("saturation", "low_V = -1.0\nhigh_V = 0.0125", ("level_V", 0.0125)),
    "range_switching": _effect("range_switching", "threshold_V = 0.011\noffset_V = 5e-4", ("offset_V", 5e-4)),
    "timestamp_jitter": _effect("timestamp_jitter", "sd_s = 0.003", ("sd_s", 0.003)),
    "clock_error": _effect("clock_error", "error_ppm = 500.0", ("ratio", 1.0005)),
    "latency": Case(BASE + _WARM + '[[effects]]\neffect = "latency"\nlag_s = 2.0\n', BASE + _WARM, ("lag_s", 2.0)),
    "mains_alias": _term("sine", 'role = "external"\namplitude_V = 3.5e-3\nfrequency_hz = 60.0', ("mains_hz", 60.0)),
    "periodic_interference": _term(
        "sine", 'role = "external"\namplitude_V = 1.3e-4\nfrequency_hz = 4.1', ("frequency_hz", 4.1)
    ),
    "wandering_line": _term(
        "wandering_line",
        "amplitude_V = 1.4e-4\nfrequency_hz = 4.1\nchirp_hz_per_s = 1.5e-4",
        ("chirp_hz_per_s", 1.5e-4),
    ),
    "periodic_glitch": _term(
        "periodic_pulse", "amplitude_V = 1e-3\nperiod_s = 7.3\nwidth_s = 0.3", ("amplitude_V", 1e-3)
    ),
    "resonance": _term("resonance", "frequency_hz = 4.0\nquality = 20.0\nsd_V = 1.6e-4", ("quality", 20.0)),
    "flicker_noise": _term("flicker_noise", "amplitude_V = 2e-4\nlow_hz = 1e-3\nhigh_hz = 7.0", ("amplitude_V", 2e-4)),
    "random_walk": _term(
        "gauss_markov", 'role = "internal"\nrate_V_per_rt_s = 1.5e-4', ("rate_V_per_rt_s", 1.5e-4), seconds=2000.0
    ),
    "difference_noise": _effect("difference_noise", "sd_V = 2e-4", ("sd_V", 2e-4)),
    "smoothing": _effect("smoothing", "kept = 0.1", ("fraction", 0.1)),
    "extra_gauss_markov": _term(
        "gauss_markov", 'role = "internal"\nrate_V_per_rt_s = 5e-4\ntau_s = 6.0', ("tau_s", 6.0), seconds=2000.0
    ),
    "popcorn_noise": _term(
        "popcorn_noise", "step_V = 2e-3\ndwell_low_s = 5.0\ndwell_high_s = 5.0", ("step_V", 2e-3), CALM
    ),
    "changing_noise": _term(
        "white_noise", "density_V_per_rt_hz = 8e-5\nstart_s = 100.0\nduration_s = 120.0", ("ratio", (1 + 0.64) ** 0.5)
    ),
    "signal_dependent_noise": _effect("signal_dependent_noise", "fraction = 0.06", ("fraction", 0.06)),
    "heavy_tails": _effect("heavy_tails", "sd_V = 6e-4\ndof = 3.0"),
    "shock_law": Case(_OFTEN + "positive_fraction = 0.98\n", _OFTEN, ("fraction", 0.98), 800.0),
    "ring_down": Case(
        _OFTEN + "ring_fraction = 0.1\nring_hz = 3.0\nring_decay_s = 1.0\n", _OFTEN, ("frequency_hz", 3.0)
    ),
    "step": _term("step", "time_s = 150.0\nstep_V = 5e-3", ("step_V", 5e-3)),
    "thermal_drift": _term(
        "thermal_drift",
        "coefficient_V_per_C = 3e-3\nlag_s = 5.0\nsd_C = 1.0\ntau_s = 60.0",
        ("coefficient_V_per_C", 3e-3),
    ),
    "warmup_drift": _term("warm_up", "amplitude_V = 1.5e-2\ntau_s = 20.0", ("amplitude_V", 1.5e-2)),
    "supply_coupling": _effect(
        "supply_coupling", "coefficient_per_V = 0.4\nsd_V = 0.1\ntau_s = 2.0\nmean_V = 5.0", ("coefficient_per_V", 0.4)
    ),
    "nonlinearity": _effect(
        "nonlinearity", "coefficient_per_V = 40.0\ncentre_V = 0.01", ("coefficient_per_V", 40.0), CALM
    ),
    "dead_band": _effect("dead_band", "width_V = 1e-3\nlevel_V = 0.0105", ("width_V", 1e-3)),
    "reading_pattern": _effect("reading_pattern", "offsets_V = [1e-4, -1e-4]", ("amplitude_V", 1e-4)),
}
"""By mechanism, in the catalogue's order."""

FAST = ("periodic_interference", "step", "quantisation")
"""What `make test` asks."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What was said of a case."""

    true: str
    """Verdict and names with the true model stated, or the refusal."""
    names: tuple[str, ...] = ()
    """Found with the part taken out, in the order of the report."""
    d_nats: float = 0.0
    size: str = "-"
    """within, outside, counted, or - where nothing of that size is reported."""
    seconds: float = 0.0
    answers: Mapping[str, Diagnosis] = field(default_factory=dict)


def run_case(cause: str, case: Case, folder: Path, seed: int = 3) -> Outcome:
    """Simulate a case and ask about it twice."""
    begun = time.process_time()
    true, less, out = folder / f"{cause}.toml", folder / f"{cause}_less.toml", folder / f"{cause}_{seed}.mcap"
    true.write_text(case.true)
    less.write_text(case.less)
    simulate(true, seconds=case.seconds, seed=seed, out=out)
    answers = {}
    try:
        answers["true"] = diagnose(out, model=true)
        told = answers["true"].verdict
        told += "".join(f" {item.cause}" for item in answers["true"].findings)
    except AemdError as error:
        told = f"refused: {str(error).removeprefix(f'{true}: ')}"
    answers["less"] = found = diagnose(out, model=less)
    first = next((item for item in found.findings if item.cause == cause), None)
    size, d_nats = "-", 0.0
    if first is not None:
        d_nats = first.d_nats
        value = first.parameters.get(case.size[0])
        if value is not None:
            size = (
                "within"
                if value.low <= case.size[1] <= value.high
                else f"outside ({value.low:.4g} to {value.high:.4g})"
            )
            if value.low == value.high:
                size = (
                    "counted"
                    if abs(value.value - case.size[1]) <= 1e-3 * abs(case.size[1])
                    else f"off, {value.value:.6g}"
                )
    names = tuple(item.cause for item in found.findings)
    return Outcome(told, names, d_nats, size, time.process_time() - begun, answers)


def main() -> None:
    """Print a line a mechanism."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("causes", nargs="*", metavar="cause", help="mechanisms; all without any")
    parser.add_argument("--seed", type=int, default=3)
    asked = parser.parse_args()
    stands = named = 0
    causes = asked.causes or list(CASES)
    print(f"{'mechanism':24}{'true model':20}{'without it, named':40}{'D':>7}  {'size':10}{'CPU s':>7}")
    with TemporaryDirectory() as folder:
        for cause in causes:
            found = run_case(cause, CASES[cause], Path(folder), asked.seed)
            stands += found.true == "nothing_found"
            named += cause == (found.names or ("",))[0]
            told = ", ".join(found.names) or "nothing"
            print(
                f"{cause:24}{found.true:20}{told:40}{found.d_nats:7.0f}  {found.size:10}{found.seconds:7.1f}",
                flush=True,
            )
    print(f"{stands} of {len(causes)} true models stand; {named} of {len(causes)} named first without their part")


if __name__ == "__main__":
    main()
