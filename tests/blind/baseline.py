"""What thirty lines can do: three sigma and a periodogram. A benchmark that it does well is too easy."""

import numpy as np

from tests.blind.plant import Record

__all__ = ["suspect"]

LEVEL = 0.003 / 3  # of each of its three tests, on white noise


def suspect(record: Record) -> list[str]:
    """Return the names it gives, most often none."""
    readings = record.value_V - np.median(record.value_V)
    differences = np.diff(readings)  # a poor man's whitening
    differences = differences - differences.mean()
    names = []
    power = np.abs(np.fft.rfft(differences * np.hanning(differences.size))) ** 2
    smooth = np.convolve(np.pad(power, 50, mode="edge"), np.ones(101) / 101, mode="valid")
    if np.max(power[2:-2] / smooth[2:-2]) > np.log(power.size / LEVEL) * 1.3:  # the window correlates neighbours
        names.append("periodic_interference")
    sigma = 1.4826 * np.median(np.abs(differences))
    beyond = np.count_nonzero(np.abs(differences) > 3 * sigma)
    if beyond > 0.0027 * differences.size + 3.1 * np.sqrt(0.0027 * differences.size) + 1:
        names.append("heavy_tails")
    halves = np.array_split(differences, 2)
    if abs(np.log(halves[0].var() / halves[1].var())) > 3.3 * np.sqrt(2 * 3 / differences.size):
        names.append("changing_noise")
    return names
