"""AEM and its parts as loops written straight from the equations: slow, and nothing in closed form."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from aemd.block import ESTIMATE, NOT_A_VALUE, Block, Estimates, Status
from aemd.estimate.aem import AemOptions

UNKNOWN = 10**9  # a hole that cannot be too long: nothing came before it


def slopes_between_all_pairs(curve: Sequence[float]) -> list[float]:
    """The paper's k_s: slope between any two points of the curve, per reading."""
    return [(curve[j] - curve[i]) / (j - i) for i in range(len(curve)) for j in range(i + 1, len(curve))]


def spread(readings: Sequence[float], options: AemOptions) -> float:
    """Delta k_s of eq. 17, by fitting a polynomial and looking at all pairs."""
    place = np.arange(len(readings)) - (len(readings) - 1) / 2
    middle = float(np.mean(readings))  # for precision only: an offset has no slope
    fit = np.polynomial.Polynomial.fit(place, np.subtract(readings, middle), options.fit_order)
    slopes = slopes_between_all_pairs(fit(place).tolist())
    return (max(slopes) - min(slopes)) / options.slope_unit_V


@dataclass
class Moments:
    """Mean and variance of x_0 .. x_v, covariance of x_i with x_{i-1}, given a window and a disturbance."""

    x: list[float]
    P: list[float]
    C: list[float] = field(default_factory=list)


def e_step(z: Sequence[float], u: float, x0: float, P0: float, phi: float, options: AemOptions) -> Moments:
    """Kalman filter over the window, and the Rauch-Tung-Striebel smoother if asked for."""
    Q, R = options.sigma_Q_V**2, options.sigma_R_V**2
    x, P, C = [x0], [P0], []
    for reading in z:
        m, M = phi * x[-1], phi * phi * P[-1] + Q
        K = M / (M + R)
        C.append(R / (M + R) * phi * P[-1])
        x.append(m + K * (reading - u - m))
        P.append(M * R / (M + R))
    if options.e_step == "smoothed":
        for i in range(len(z) - 1, -1, -1):
            M = phi * phi * P[i] + Q
            G = phi * P[i] / M
            C[i] = G * P[i + 1]
            x[i] += G * (x[i + 1] - phi * x[i])
            P[i] += G * G * (P[i + 1] - M)
    return Moments(x, P, C)


def expected_likelihood(
    z: Sequence[float], u: float, given: Moments, x0: float, P0: float, phi: float, options: AemOptions
) -> float:
    """Eq. 6 to 11, with the constants of eq. 7 in its unit."""
    Q, R, v, unit = options.sigma_Q_V**2, options.sigma_R_V**2, len(z), options.likelihood_unit_V
    total = -(1 + (v + 2) * 2) / 2 * math.log(2 * math.pi) - 0.5 * v * math.log(Q / unit**2 + R / unit**2)
    total -= 0.5 * ((given.x[0] - x0) ** 2 + given.P[0]) / P0
    for i in range(1, v + 1):
        step = (given.x[i] - phi * given.x[i - 1]) ** 2
        step += given.P[i] + phi * phi * given.P[i - 1] - 2 * phi * given.C[i - 1]
        total -= 0.5 * step / Q
        total -= 0.5 * ((z[i - 1] - given.x[i] - u) ** 2 + given.P[i]) / R
    return total


@dataclass
class Passes:
    """Result of the passes over one window: last moments, every disturbance and every expected likelihood."""

    given: Moments
    u: list[float]
    Q: list[float]


def maximise(z: Sequence[float], x0: float, P0: float, phi: float, options: AemOptions) -> Passes:
    """E step, M step (eq. 15) and stop rule (eq. 16), one after the other."""
    given = e_step(z, 0.0, x0, P0, phi, options)
    us, Qs = [0.0], [expected_likelihood(z, 0.0, given, x0, P0, phi, options)]
    while len(us) <= options.r_max:
        us.append(float(np.mean([reading - x for reading, x in zip(z, given.x[1:], strict=True)])))
        given = e_step(z, us[-1], x0, P0, phi, options)
        Qs.append(expected_likelihood(z, us[-1], given, x0, P0, phi, options))
        if options.stop_rule == "likelihood":
            stop = abs(Qs[-1] - Qs[-2]) < options.delta * abs(Qs[-1])
        else:
            stop = abs(us[-1] - us[-2]) < options.delta * options.sigma_R_V / math.sqrt(len(z))
        if stop:
            break
    return Passes(given, us, Qs)


def aem(block: Block, options: AemOptions, phi: float) -> Estimates:
    """AEM over a block whose first reading has a value, on a list of steps where a lost reading is one as well."""
    out = np.zeros(block.size, dtype=ESTIMATE)
    Q, R = options.sigma_Q_V**2, options.sigma_R_V**2
    readings: dict[int, float | None] = {}  # by number; None where the value lacks
    x, P, u = {}, {}, 0.0  # estimates by number
    start, windowed, blind, hole = 0, False, 0, UNKNOWN
    previous = int(block["index"][0]) - 1
    for row, reading in zip(out, block, strict=True):
        k, z = int(reading["index"]), float(reading["value_V"])
        status = int(reading["status"])
        for lost in range(previous + 1, k):
            readings[lost], x[lost], P[lost] = None, phi * x[lost - 1], phi * phi * P[lost - 1] + Q
            blind, hole = blind + 1, hole + 1
        previous = k
        possible = not status & NOT_A_VALUE and abs(z) <= options.gate * options.prior_sigma_V
        if possible and hole > options.restart_after:
            if hole < UNKNOWN:
                status |= Status.RESTARTED
            start, windowed, hole, u = k, False, 0, 0.0
            x[k - 1], P[k - 1] = 0.0, options.prior_sigma_V**2
        m, M = phi * x[k - 1], phi * phi * P[k - 1] + Q
        S = M + R
        usable = not status & NOT_A_VALUE and abs(z - m - u) <= options.gate * math.sqrt(S)
        readings[k] = z if usable else None
        row["index"], row["t_ns"] = k, reading["t_ns"]
        if usable:
            hole = 0
            row["log_likelihood"] = -0.5 * (math.log(2 * math.pi * S) + (z - m - u) ** 2 / S)

        def last(count: int, k: int = k, start: int = start) -> list[float] | None:
            """The last readings, if there are so many after that of the start, all with a value."""
            values = [readings[i] for i in range(k - count + 1, k + 1)] if k - count + 1 > start else [None]
            return None if None in values else [value for value in values if value is not None]

        v = options.windows[0]
        if recent := last(options.fit_history):
            row["spread"] = spread(recent, options)
            v = next((w for w, t in zip(options.windows, options.thresholds, strict=False) if row["spread"] <= t), None)
            v = v or options.windows[-1]
        window = last(v) if recent else None
        if window is not None:
            P0 = P[k - v] if options.prior == "stored" else Q
            passes = maximise(window, x[k - v], P0, phi, options)
            x[k], P[k], u = passes.given.x[-1], passes.given.P[-1], passes.u[-1]
            row["window"], row["passes"] = v, len(passes.u) - 1
            windowed, blind = True, 0
        elif usable and not (options.holes == "coast" and windowed and blind < options.restart_after):
            K = M / S
            x[k], P[k], u = m + K * (z - m), M * R / S, 0.0
            windowed, blind = False, 0
            status |= Status.START_UP
        else:
            hole += not usable
            x[k], P[k] = m, M
            blind += 1
            status |= Status.COASTED
        row["value_V"], row["sigma_V"], row["u_V"], row["status"] = x[k], math.sqrt(P[k]), u, status
    return out
