"""Make the recordings of this folder anew: `python replay_data/make.py FOLDER`.

Each is a history of a model with a seed, seen as a meter with a 20 ms aperture sees it 14.899 times a second, rounded
to the meter's 3 uV on its 10 V range, and estimated by AEM with its defaults. Time begins on 2026-01-01 at 00:00 UTC.
"""

import sys
from pathlib import Path

import numpy as np

from aemd.block import Batch, Event, Status, make_block
from aemd.config import name_estimator
from aemd.estimate.registry import make_estimator
from aemd.model import GaussMarkov, Level, Model, Shocks, Sine, SquareBurst, WhiteNoise
from aemd.pipeline import run
from aemd.record.description import Description
from aemd.record.writer import Recorder
from aemd.tables import export

START_NS = 1_767_225_600_000_000_000
INTERVAL_S = 0.06712
APERTURE_S = 0.02
STEPS_PER_V = 1e6 / 3
"""3 uV steps, the resolution of 1 PLC on the 10 V range."""
READINGS = 1500

NOISE = WhiteNoise(density_V_per_rt_hz=2.4e-6)
"""17 uV in 20 ms: 0.11 mV from peak to peak in some thousand readings, as in the paper's dynamic test."""
DRIFT = GaussMarkov(role="internal", rate_V_per_rt_s=2e-5)

MODELS = {
    "static": Model((Level(level_V=1e-3), DRIFT, Shocks(rate_per_s=0.1, sd_V=3e-3, decay_s=0.15), NOISE), seed=11),
    "dynamic": Model(
        (
            Sine(amplitude_V=2e-3, frequency_hz=0.2),
            DRIFT,
            Shocks(rate_per_s=0.05, sd_V=20e-3, decay_s=0.02),
            SquareBurst(amplitude_V=10e-3, frequency_hz=77.0, start_s=30.0, duration_s=4.5),
            SquareBurst(amplitude_V=10e-3, frequency_hz=18.0, start_s=60.0, duration_s=1.6),
            NOISE,
        ),
        seed=12,
    ),
    "gap": Model((Sine(amplitude_V=2e-3, frequency_hz=0.2), DRIFT, NOISE), seed=13),
}
LOST = slice(600, 640)
OVERLOADED = slice(900, 905)


def make(name: str, folder: Path) -> None:
    """Write NAME.mcap and its estimates, NAME.expected.csv."""
    model = MODELS[name]
    truth = model.realise().average(np.arange(READINGS) * INTERVAL_S, APERTURE_S)
    values_V = np.rint(truth.total * STEPS_PER_V) / STEPS_PER_V
    block = make_block(values_V, t0_ns=START_NS, interval_ns=INTERVAL_S * 1e9)
    events: tuple[Event, ...] = ()
    if name == "gap":
        events = (
            Event(int(block["t_ns"][LOST.start]), "gap", "40 readings taken out", LOST.start, LOST.stop - 1),
            Event(int(block["t_ns"][OVERLOADED.start]), "overload", "five readings replaced by an overload"),
        )
        block["value_V"][OVERLOADED] = np.nan
        block["status"][OVERLOADED] = Status.OVERLOAD_HIGH
        block["status"][LOST.stop] |= Status.GAP
        block = np.delete(block, LOST)
    choice = name_estimator("aem")
    description = Description(
        interval_s=INTERVAL_S,
        session={"origin": f"replay_data/make.py: {name}", "seed": str(model.seed)},
        estimator=choice.as_text(),
    )
    recorder = Recorder(folder / f"{name}.mcap", description)
    batches = (
        Batch(part, tuple(event for event in events if part["t_ns"][0] <= event.t_ns <= part["t_ns"][-1]))
        for part in (block[:500], block[500:])
    )
    run(batches, make_estimator("aem", choice.options, INTERVAL_S), [recorder])
    recorder.close("end")
    export(folder / f"{name}.mcap", folder / f"{name}.expected.csv")


if __name__ == "__main__":
    target = Path(sys.argv[1])
    for each in MODELS:
        make(each, target)
