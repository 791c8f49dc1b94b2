"""What a diagnosis promises of its extended model, and what its estimator delivers on fresh readings of the same kind.

    python -m tests.diagnose.promised

One line a mechanism: the promised gain in nats a reading and ratio of the prediction's error; then, on three histories
that the diagnosis never saw, the gain of the extended estimator's own predictions over the base's, and the ratio of
their errors against the true input.
"""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from aemd.block import READING
from aemd.config import load_estimator
from aemd.diagnose import diagnose, write_extended
from aemd.estimate.imm import Imm
from aemd.simulate import read_model, simulate
from tests.diagnose.removed import BASE

__all__ = ["compared"]

INTERVAL_S, APERTURE_S = 0.06712, 0.02
LEARNT = 300
"""Readings in which an estimator may settle."""
_TERM = '[[terms]]\nterm = "{}"\n{}\n'
_EFFECT = '[[effects]]\neffect = "{}"\n{}\n'
CASES = {
    "periodic_interference": _TERM.format("sine", 'role = "external"\namplitude_V = 2e-3\nfrequency_hz = 3.3'),
    "wandering_line": _TERM.format("wandering_line", "amplitude_V = 1e-3\nfrequency_hz = 4.1\nchirp_hz_per_s = 2e-4"),
    "resonance": _TERM.format("resonance", "frequency_hz = 4.0\nquality = 20.0\nsd_V = 8e-4"),
    "reading_pattern": _EFFECT.format("reading_pattern", "offsets_V = [4e-4, -4e-4]"),
    "changing_noise": _TERM.format("white_noise", "density_V_per_rt_hz = 4e-4\nstart_s = 100.0\nduration_s = 120.0"),
    "difference_noise": _EFFECT.format("difference_noise", "sd_V = 6e-4"),
}


def compared(place: Path, seed: int) -> tuple[float, float]:
    """Return the ratio of errors against the true input, extended over base, and the gain in nats a reading.

    `place` holds true.toml, base.toml and extended.toml.
    """
    true = replace(read_model(place / "true.toml"), seed=seed)
    start_s = np.arange(5000) * INTERVAL_S
    block = np.zeros(start_s.size, READING)
    block["index"] = np.arange(start_s.size)
    block["value_V"] = true.realise().read(start_s, APERTURE_S).value_V
    signal_V = true.realise().average(start_s, APERTURE_S).signal_V
    error, nats = [], []
    for name in ("base", "extended"):
        made = Imm(load_estimator(place / f"{name}.toml").options, INTERVAL_S).push(block)
        error.append(float(np.sqrt(np.mean((made["value_V"] - signal_V)[LEARNT:] ** 2))))
        nats.append(float(made["log_likelihood"][LEARNT:].mean()))
    return error[1] / error[0], nats[1] - nats[0]


def main() -> None:
    """Print a line a mechanism."""
    print(f"{'mechanism':24}{'found':24}{'promised nats':>14}{'rms':>7}{'delivered nats':>24}{'error ratio':>22}")
    for cause, part in CASES.items():
        with TemporaryDirectory() as folder:
            place = Path(folder)
            (place / "true.toml").write_text(BASE + part)
            simulate(place / "true.toml", seconds=300, seed=3, out=place / "a.mcap")
            diagnosis = diagnose(place / "a.mcap")
            write_extended(diagnosis, place / "extended.toml")
            write_extended(diagnosis, place / "base.toml", extended=False)
            told = [compared(place, seed) for seed in (11, 12, 13)]
        found = ", ".join(item.cause for item in diagnosis.findings) or "nothing"
        promised = sum(item.gain.nats_per_reading for item in diagnosis.findings)
        rms = np.prod([item.rms_after / item.rms_before for item in diagnosis.findings])
        nats, ratios = (" ".join(f"{item[at]:.3f}" for item in told) for at in (1, 0))
        print(f"{cause:24}{found:24}{promised:14.3f}{rms:7.3f}{nats:>24}{ratios:>22}", flush=True)


if __name__ == "__main__":
    main()
