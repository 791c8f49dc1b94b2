"""Mechanisms that a second instrument can witness: a temperature that drifts, a supply that feeds a bridge."""

from dataclasses import dataclass, replace
from math import sqrt
from typing import Literal

import numpy as np
from numpy.random import Generator

from aemd.model.effect import Readings, Witness
from aemd.model.gauss_markov import GaussMarkov
from aemd.model.linear_process import LinearProcess
from aemd.model.term import Finite, NonNegative, Positive, Role, Times, Volts

__all__ = ["SupplyCoupling", "ThermalDrift", "ThermalDriftRealisation"]

_LOOK_S = 1e-6  # aperture of the instrument that witnesses the supply


@dataclass(frozen=True, slots=True, kw_only=True)
class ThermalDrift:
    """A coefficient times the temperature's deviation from its mean, after a first-order lag.

    The temperature is a Gauss-Markov process; a thermometer reads it without the lag, over the same apertures. With the
    coefficient 0 it is a temperature that drifts but does not matter.
    """

    term: Literal["thermal_drift"] = "thermal_drift"
    role: Role = "internal"
    coefficient_V_per_C: Finite
    """V/degree Celsius."""
    lag_s: NonNegative = 0.0
    """Time constant between thermometer and sensor, s."""
    sd_C: Positive
    """Standard deviation of the temperature, degrees Celsius."""
    tau_s: Positive
    """Time constant of the temperature, s."""
    mean_C: Finite = 23.0
    """Degrees Celsius."""
    witness: Literal["temperature"] = "temperature"
    """Name under which the thermometer is recorded."""

    def realise(self, rng: Generator) -> "ThermalDriftRealisation":
        """Return a history that begins in the stationary law."""
        return ThermalDriftRealisation(self, rng)


class ThermalDriftRealisation:
    """A linear process of the state (temperature, lagged temperature), or of the temperature alone without lag."""

    def __init__(self, drift: ThermalDrift, rng: Generator) -> None:
        if drift.lag_s > 0:
            self._process = followed(rng, drift.sd_C, drift.tau_s, drift.lag_s)
        else:
            warm = 1 / drift.tau_s
            drive = drift.sd_C * sqrt(2 * warm)
            self._process = LinearProcess(rng, np.array([[-warm]]), np.array([drive]), np.ones((2, 1)))
        self._drift = drift
        self.name = drift.witness
        """Of the thermometer's record."""
        self.temperature_C = np.empty(0)
        """The thermometer's readings with the last apertures."""

    def average(self, start_s: Times, aperture_s: float) -> Volts:
        """Return the mean over each aperture, V, shape (n,)."""
        temperature, lagged = self._process.average(start_s, aperture_s).T
        self.temperature_C = self._drift.mean_C + temperature
        return np.asarray(self._drift.coefficient_V_per_C * lagged)


@dataclass(frozen=True, slots=True, kw_only=True)
class SupplyCoupling:
    """What a supply does to readings, y (1 + g d) + c d' with d = supply - mean and d' the same after a lag.

    The gain g is a ratiometric sensor's that is read absolutely; the offset c is what an amplifier lets through of its
    supply. The supply is a Gauss-Markov process; a second meter reads it at the instant of each reading. With both
    coefficients 0 it is a supply that does not matter.
    """

    effect: Literal["supply_coupling"] = "supply_coupling"
    coefficient_per_V: Finite = 0.0
    """g, 1/V."""
    coefficient_V_per_V: Finite = 0.0
    """c, V/V."""
    lag_s: NonNegative = 0.0
    """Of the offset, time constant, s."""
    sd_V: Positive
    """Standard deviation of the supply, V."""
    tau_s: Positive
    """Time constant of the supply, s."""
    mean_V: Finite = 5.0
    """V."""
    witness: Literal["supply"] = "supply"
    """Name under which the supply is recorded."""

    def realise(self, rng: Generator) -> "SupplyCouplingRealisation":
        """Return a history that begins in the stationary law."""
        return SupplyCouplingRealisation(self, rng)


class SupplyCouplingRealisation:
    """Multiplies readings by what the supply was, adds what it lets through, and says what it was."""

    def __init__(self, coupling: SupplyCoupling, rng: Generator) -> None:
        self._coupling = coupling
        self._supply: LinearProcess | None = None
        if coupling.lag_s > 0:
            self._supply = followed(rng, coupling.sd_V, coupling.tau_s, coupling.lag_s)
        else:
            self._alone = GaussMarkov.from_sd(coupling.sd_V, coupling.tau_s).realise(rng)

    def apply(self, readings: Readings) -> Readings:
        """Return the readings with that gain, and the supply beside them."""
        if self._supply is None:
            deviation_V = lagged_V = self._alone.average(readings.stamp_s, _LOOK_S)
        else:
            deviation_V, lagged_V = self._supply.average(readings.stamp_s, _LOOK_S).T
        supply = Witness(readings.stamp_s, self._coupling.mean_V + deviation_V)
        gain = 1 + self._coupling.coefficient_per_V * deviation_V
        return replace(
            readings,
            value_V=readings.value_V * gain + self._coupling.coefficient_V_per_V * lagged_V,
            witnesses={**readings.witnesses, self._coupling.witness: supply},
        )


def followed(rng: Generator, sd: float, tau_s: float, lag_s: float) -> LinearProcess:
    """Return a first-order process and what a first-order lag makes of it, in the stationary law."""
    fade, follow = 1 / tau_s, 1 / lag_s
    return LinearProcess(
        rng, np.array([[-fade, 0.0], [follow, -follow]]), np.array([sd * sqrt(2 * fade), 0.0]), np.eye(2)
    )
