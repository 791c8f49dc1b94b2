"""What happened once: the hump or the wave that the residuals show best, rivals from outside of what acts all the time.

Searches for what to hold against a name, and no checks of their own: they have no p-value, and find nothing alone.
"""

from math import log, pi, sqrt

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from aemd.diagnose.checks.shapes import settled_response
from aemd.diagnose.checks.spectrum import regress
from aemd.diagnose.fit import Fit
from aemd.diagnose.terms.lines import amplitude_cost
from aemd.diagnose.terms.packets import Packet, waves
from aemd.diagnose.terms.shapes import Hump

__all__ = ["best_hump", "best_packets"]

_WIDTHS = (4, 12, 36, 108)
"""Readings."""
_PACKET_WIDTHS = (4, 10, 25, 60, 150)
"""Readings."""
_FINER = 2
"""Frequencies and places for each that is independent."""
_EDGES = 5
"""Instants, on either side of the half of a bell's rise, at one of which a wave that begins may."""


def best_hump(fit: Fit) -> Hump | None:
    """Return the hump whose response in the residuals is the largest in deviations, over places and widths."""
    n = fit.data.y.size
    step = settled_response(fit, min(n, 20 * _WIDTHS[-1]))
    best: tuple[float, Hump] | None = None
    for width in _WIDTHS:
        if 4 * width > n:
            break
        pulse = step - np.concatenate((np.zeros(2 * width), step[: -2 * width]))
        size = sqrt(float(np.sum(pulse**2)))
        scores = fftconvolve(fit.z, pulse[::-1])[pulse.size - 1 :][:n] / size
        at = int(np.argmax(np.abs(scores)))
        cost = amplitude_cost(1, fit.data.n) + log(n / width) + log(len(_WIDTHS))
        if best is None or abs(scores[at]) > best[0]:
            centre_s = float(fit.data.t_s[min(at + width, n - 1)])
            hump = Hump(centre_s, width * fit.data.interval_s, float(scores[at]) / size, cost)
            best = float(abs(scores[at])), hump
    return best[1] if best else None


def best_packets(fit: Fit) -> list[Packet]:
    """Return the waves that come once and fit the residuals best, under a bell and with a beginning of their own.

    Their frequencies are high enough for the filter to have settled: it passes them nearly as they are.

    Whatever their width, bells cover the record with n/2 cells of time and frequency. A beginning is told to a reading,
    and costs log n beside the frequencies and widths that a wave after a shock costs, whose beginning is known.
    """
    data = fit.data
    n, interval_s = data.y.size, data.interval_s
    z = np.where(data.used, fit.z, 0.0)
    widths = [width for width in _PACKET_WIDTHS if 8 * width < n]
    best = max((_bell_power(z, width) for width in widths), default=None)
    if best is None:
        return []
    _, width, at, turns = best
    hz, bell_s = turns / interval_s, width * interval_s
    cost = amplitude_cost(2, data.n) + log(2 * len(widths))
    found = [_packet(fit, at, hz, bell_s, cost + log(data.n / 2), begins=False)]
    edges = [at + round(place * width / 2) for place in range(-_EDGES, _EDGES + 1)]
    tries = [
        (begun, decay)
        for begun in {edge for edge in edges if 0 <= edge < n - 4}
        for decay in (0.7 * width, 1.5 * width, 3.0 * width)
    ]
    power = {(begun, decay): _fading_power(z, begun, decay, turns) for begun, decay in tries}
    rough, decay = max(power, key=power.__getitem__)
    near = {at: _fading_power(z, at, decay, turns) for at in range(max(rough - width, 0), min(rough + width, n - 4))}
    begun = max(near, key=near.__getitem__, default=rough)
    trials = sum(2 * width for width in widths)
    found += [
        _packet(fit, edge, hz, decay * interval_s, cost + log(data.n) + log(trials), begins=True)
        for edge in range(max(begun - 1, 0), begun + 2)
    ]
    return found


def _bell_power(z: NDArray[np.float64], width: int) -> tuple[float, int, int, float]:
    """Return the largest power of the residuals under a bell over its energy; its width, place, and turns a reading."""
    length, hop = 6 * width, max(width // _FINER, 1)
    bell = np.exp(-0.5 * ((np.arange(length) - length / 2) / width) ** 2)
    spans = sliding_window_view(z, length)[::hop]
    power = np.abs(np.fft.rfft(spans * bell, _FINER * length, axis=1)) ** 2 / np.sum(bell**2)
    power[:, : _FINER * 3] = 0.0  # slower than the bell itself
    place, line = np.unravel_index(int(np.argmax(power)), power.shape)
    return float(power[place, line]), width, int(place) * hop + length // 2, float(line) / (_FINER * length)


def _fading_power(z: NDArray[np.float64], begun: int, decay: float, turns: float) -> float:
    """Return the power of the residuals under a wave that begins at a reading and fades, over its energy."""
    after = np.arange(min(round(5 * decay), z.size - begun))
    wave = np.exp(-after / decay - 2j * pi * turns * after)
    return float(np.abs(z[begun : begun + after.size] @ wave) ** 2 / np.sum(np.abs(wave) ** 2))


def _packet(fit: Fit, at: int, hz: float, width_s: float, cost: float, *, begins: bool) -> Packet:
    """Return the wave there, its amplitudes fitted to the residuals."""
    at_s = float(fit.data.t_s[min(at, fit.data.y.size - 1)])
    (a, b), _ = regress(fit, [*waves(fit.data.t_s - at_s, hz, width_s, begins=begins)])
    return Packet(at_s, width_s, hz, (float(a), float(b)), begins, cost)
