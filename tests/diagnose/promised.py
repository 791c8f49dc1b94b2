"""What a diagnosis promises of its extended model, and what model and estimator deliver on fresh readings of the kind.

    python -m tests.diagnose.promised [cause ...]

A line a mechanism and record. Promised, with the range of one more record in 95 %: the ratio of the estimate's errors
against the true input, extended over base, and the estimator's gain in nats a reading. Given: both, on a history of the
true model that the diagnosis never saw. With --discrepancies also what such a history lacks from either model. The last
lines count the ranges that held; of a promise that the estimator takes nothing up there is nothing to count.
"""

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from aemd.config import load_estimator
from aemd.diagnose import Diagnosis, diagnose, write_extended
from aemd.diagnose.promise import errors_of
from aemd.diagnose.result import Promise
from aemd.errors import AemdError
from aemd.simulate import read_model, simulate
from tests.diagnose.removed import BASE, CASES

__all__ = ["STRONG", "Delivered", "compared", "left", "made"]

INTERVAL_S, APERTURE_S = 0.06712, 0.02
RECORDS = 3
_FRESH = 10_000
"""Added to a seed: the history that the promise is tried on."""
_TERM = '[[terms]]\nterm = "{}"\n{}\n'
_EFFECT = '[[effects]]\neffect = "{}"\n{}\n'
STRONG = {
    "periodic_interference": _TERM.format("sine", 'role = "external"\namplitude_V = 2e-3\nfrequency_hz = 3.3'),
    "wandering_line": _TERM.format("wandering_line", "amplitude_V = 1e-3\nfrequency_hz = 4.1\nchirp_hz_per_s = 2e-4"),
    "resonance": _TERM.format("resonance", "frequency_hz = 4.0\nquality = 20.0\nsd_V = 8e-4"),
    "reading_pattern": _EFFECT.format("reading_pattern", "offsets_V = [4e-4, -4e-4]"),
    "changing_noise": _TERM.format("white_noise", "density_V_per_rt_hz = 4e-4\nstart_s = 100.0\nduration_s = 120.0"),
    "difference_noise": _EFFECT.format("difference_noise", "sd_V = 6e-4"),
}
"""Effects that an estimator must feel; the others are those of `removed`, just large enough to be found."""
_MODELS: Mapping[str, str] = {
    **{cause: case.true for cause, case in CASES.items()},
    **{cause: BASE + part for cause, part in STRONG.items()},
}


@dataclass(frozen=True, slots=True)
class Delivered:
    """What one fresh history gave."""

    ratio: float
    nats_per_reading: float

    def keeps(self, told: Promise) -> bool:
        """Tell whether both lie where the promise has them."""
        return all(self.within(told))

    def within(self, told: Promise) -> tuple[bool, bool]:
        """Tell whether the ratio of the errors lies where the promise has it, and whether the gain does."""
        ratio, nats = told.ratio, told.nats_per_reading
        return ratio.low <= self.ratio <= ratio.high, nats.low <= self.nats_per_reading <= nats.high


def made(place: Path, text: str, seed: int, seconds: float = 400.0) -> Diagnosis:
    """Simulate a model's text, diagnose it, and leave true.toml, base.toml and extended.toml in `place`."""
    (place / "true.toml").write_text(text)
    simulate(place / "true.toml", seconds=seconds, seed=seed, out=place / f"{seed}.mcap")
    diagnosis = diagnose(place / f"{seed}.mcap")
    write_extended(diagnosis, place / "extended.toml")
    write_extended(diagnosis, place / "base.toml", extended=False)
    return diagnosis


def compared(place: Path, seed: int, readings: int = 5000) -> Delivered:
    """Run the estimators of base.toml and extended.toml over a fresh history of true.toml."""
    true = replace(read_model(place / "true.toml"), seed=seed)
    options = [load_estimator(place / f"{name}.toml").options for name in ("base", "extended")]
    errors_V, nats = errors_of(options, true, readings, INTERVAL_S, APERTURE_S)
    return Delivered(float(errors_V[1] / errors_V[0]), nats)


def left(place: Path, seed: int, seconds: float) -> tuple[str, str]:
    """Return how many findings a fresh history of true.toml has under base.toml and under extended.toml."""
    fresh = place / f"fresh_{seed}.mcap"
    simulate(place / "true.toml", seconds=seconds, seed=seed, out=fresh)
    told = []
    for name in ("base", "extended"):
        try:
            told.append(
                ", ".join(
                    f"{item.cause} ({item.remark})" if item.remark else item.cause
                    for item in diagnose(fresh, model=place / f"{name}.toml").findings
                )
                or "nothing"
            )
        except AemdError as error:
            told.append(f"refused: {str(error).rsplit('/', 1)[-1]}")
    return told[0], told[1]


def main() -> None:
    """Print a line a mechanism and seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("causes", nargs="*", metavar="cause", help="mechanisms; all without any")
    parser.add_argument("--discrepancies", action="store_true", help="ask fresh readings about both models, too")
    parser.add_argument("--records", type=int, default=RECORDS, help="of each mechanism")
    given = parser.parse_args()
    held = list[tuple[bool, bool]]()
    print(f"{'mechanism':23}{'promised: error ratio':>24}{'given':>7}{'nats a reading':>26}{'given':>8}  found")
    for cause in given.causes or list(_MODELS):
        first = 10 * list(_MODELS).index(cause) + 3  # one seed gives all mechanisms the same drift, and the same luck
        seconds = CASES[cause].seconds if cause in CASES else 400.0
        for seed in range(first, first + given.records):
            with TemporaryDirectory() as folder:
                place = Path(folder)
                diagnosis = made(place, _MODELS[cause], seed, seconds)
                told = diagnosis.promise
                found = ", ".join(item.cause for item in diagnosis.findings) or "nothing"
                if told is None or not told.taken:
                    what = "nothing promised" if told is None else "the base's estimator stays"
                    print(f"{cause:23}{what:65}  {found}", flush=True)
                    continue
                gave = compared(place, seed + _FRESH, told.readings)
                held.append(gave.within(told))
                ratio, nats = told.ratio, told.nats_per_reading
                print(
                    f"{cause:23}{ratio.value:8.3f} ({ratio.low:.3f} to {ratio.high:.3f}){gave.ratio:7.3f}"
                    f"{nats.value:8.3f} ({nats.low:6.3f} to {nats.high:.3f}){gave.nats_per_reading:8.3f}"
                    f"  {found}{'' if gave.keeps(told) else '  BROKEN'}",
                    flush=True,
                )
                if given.discrepancies:
                    base, extended = left(place, seed + _FRESH, seconds)
                    print(f"{'':23}on fresh readings: under the base {base}; under the extended {extended}", flush=True)
    for number, what in enumerate(("error ratio", "gain in nats")):
        print(f"{sum(each[number] for each in held)} of {len(held)} ranges of the {what} hold a fresh record's")


if __name__ == "__main__":
    main()
