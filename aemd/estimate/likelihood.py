"""What readings say of a kind of model and its parameters: the likelihood that tuning maximises, in its own units."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from aemd.block import ESTIMATE, NOT_A_VALUE, Block
from aemd.estimate.compiled import choose
from aemd.estimate.imm import ImmOptions, imm_model
from aemd.estimate.imm_kernels import run_imm, start_imm
from aemd.estimate.kalman import columns_of
from aemd.estimate.resonance import Resonances

__all__ = ["LEAST_RATE", "SHARP", "Kind", "Likelihood", "usable"]

Floats = NDArray[np.float64]

LEAST_RATE = 3.2  # of a swing, in noises over the length of the stretch: see Likelihood._options
SHARP = 1000.0  # factor of the logarithm of a frequency: see Likelihood
_ABSENT = 1e-2  # standard deviation of a part that is not there, in units of the noise: nothing, but not singular
_NO_VOLTAGE_V = 1e30  # the estimator puts such a reading aside too
_DRASTIC = 5.0  # least standard deviation of the abrupt disturbance in units of the noise: less is not told from noise


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of model: which parts there are besides noise and abrupt disturbance."""

    signal: tuple[Literal["markov", "swing"], ...]
    """Parts of the input: Markov processes of first order (eq. 2), or ones that swing at a frequency."""
    slow: bool
    """Whether there is a slow part."""
    order: int = 0
    """Of an autoregression whose resonances are the input's parts, in place of `signal`; 0: none."""

    def __str__(self) -> str:
        """Return its name."""
        signal = (f"resonances of order {self.order}",) if self.order else self.signal
        return " + ".join((*signal, "slow")[: len(signal) + self.slow]) or "noise"

    @property
    def parameters(self) -> int:
        """Number of free parameters."""
        return (
            5
            + 2 * self.slow
            + (self.order + 1 if self.order else 0)
            + sum({"markov": 2, "swing": 3}[part] for part in self.signal)
        )


class Likelihood:
    """Log-likelihood of some stretches for any kind and parameters, in the units of the search.

    The unit of voltage is the noise between neighbouring readings, the unit of time a reading, and parameters are
    logarithms, so that the search sees numbers near 1 whatever was measured. The logarithm of a frequency is multiplied
    by a thousand: the readings tell it that much more sharply than the rest, and the search goes astray in a ravine.
    """

    def __init__(
        self,
        stretches: Sequence[Block],
        origin_V: float,
        noise_V: float | None,
        slowest: float,
        *,
        walk: bool,
        resonances: Resonances | None = None,
    ) -> None:
        self.origin_V = origin_V
        self.slowest = slowest
        self.walk = walk
        values_V = [block["value_V"][usable(block)] for block in stretches]
        steps_V = np.abs(np.concatenate([np.diff(value_V) for value_V in values_V]))
        middling_V = float(np.median(steps_V)) / 0.6745 / math.sqrt(2)
        self.unit_V = middling_V or float(np.sqrt(np.mean(steps_V**2) / 2))  # coarse steps: most differences are 0
        self.values = [(value_V - origin_V) / self.unit_V for value_V in values_V]
        self.size = sum(map(len, self.values))
        self.noise = None if noise_V is None else noise_V / self.unit_V
        self.resonances = resonances
        self._columns = []
        for block in stretches:
            index, value_V, status = columns_of(block)
            self._columns.append((index, block["t_ns"].copy(), (value_V - origin_V) / self.unit_V, status))
        self._out = np.empty(max(map(len, stretches)), dtype=ESTIMATE)

    def __call__(self, kind: Kind, theta: Floats) -> float:
        """Return the log-likelihood of all stretches, each from its own start, in natural units of density 1/unit_V."""
        model = imm_model(self._options(kind, theta), 1.0)
        pairs = (0,) * model.cos.size
        total = 0.0
        for columns in self._columns:
            run = choose(run_imm, columns[0].size, few=0)
            ready = run(pairs, start_imm(model, 0), model, *columns, self._out)
            total += float(self._out["log_likelihood"][:ready].sum())
        return total

    def bounds(self, kind: Kind) -> list[tuple[float, float]]:
        """Return the logarithms between which each parameter is sought."""
        spread = max(float(np.ptp(value)) for value in self.values) + 1.0
        longest = math.log(100.0 * self.size)
        edge = math.log(self.slowest / (2 * math.pi))
        noise = (math.log(1e-3), math.log(10.0)) if self.noise is None else (math.log(self.noise),) * 2
        found = [noise, (0.0, math.log(100 * spread)), (math.log(2.0), longest), (math.log(0.15), longest)]
        found.append((math.log(50.0), math.log(1000.0)) if self.walk else (longest, longest))
        if kind.slow:
            returns = (longest + math.log(10.0),) * 2 if self.walk else (edge + math.log(10.0), longest)
            found += [(math.log(1e-4), math.log(10.0)), returns]
        if kind.order:
            found.append((math.log(1e-3), math.log(10.0)))
        for part in kind.signal:
            if part == "markov":
                found += [(math.log(1e-3), math.log(100.0)), (math.log(0.3), edge)]
            else:
                found += [
                    (math.log(1e-2), math.log(10 * spread)),
                    (math.log(LEAST_RATE / self.size), math.log(1e5)),  # 100 of our units, if the noise is least
                    (-SHARP * math.log(self.slowest), SHARP * math.log(0.5)),
                ]
        return found

    def options(
        self, kind: Kind, theta: Floats, interval_s: float, slow: Literal["disturbance", "input"]
    ) -> ImmOptions:
        """Return the options in SI units."""
        found = self._options(kind, theta)
        scaled: dict[str, Any] = {}
        for name, value in asdict(found).items():
            unit = (
                self.unit_V
                if name.endswith("_V")
                else float(interval_s)
                if name.endswith("_s")
                else 1 / float(interval_s)
            )
            if name.endswith(("_V", "_s", "_hz")) and name != "origin_V":
                scaled[name] = tuple(unit * part for part in value) if isinstance(value, tuple) else unit * value
        scaled["longest_disturbance_s"] = max(60.0, 20 * scaled["disturbed_s"])
        return replace(found, **scaled, origin_V=self.origin_V, slow=slow)

    def _options(self, kind: Kind, theta: Floats) -> ImmOptions:
        """Return the options in the units of the search.

        A Markov process is sought by its rate (rms step, well determined by the readings) and its time; a swing by its
        standard deviation and its rate, since its time may be endless. That rate is kept from 0, because N readings of
        noise sigma tell the frequency of a swing of amplitude A only to sqrt(24) sigma / (A N^1.5) radians per reading
        (Cramer and Rao). A filter of rate r remembers sqrt(2) sigma / r readings; over them the frequency's error grows
        to one of variance b^2 = 48 sigma^4 / (N^3 r^2) in phase and none in amplitude. It expects a variance of
        P = sqrt(2) sigma r in either, half of it from the noise and half as room for such errors. On the mean of both
        directions the room is filled at b^2 = P, which is r = 3.2 sigma / N; a lower rate would claim too much.
        """
        logarithm = iter(theta.tolist())
        number = map(math.exp, logarithm)
        noise, disturbed, quiet, lasting, memory = (next(number) for _ in range(5))
        slow_V, slow_tau = _ABSENT * noise, 10.0 * self.size
        if kind.slow:
            rate, slow_tau = next(number), next(number)
            slow_V = rate * math.sqrt(slow_tau / 2)
        parts: list[tuple[float, float, float]] = []
        for part in kind.signal:
            if part == "markov":
                rate, tau = next(number), next(number)
                parts.append((rate * math.sqrt(tau / 2), tau, 0.0))
            else:
                sd, rate, frequency = next(number), noise * next(number), math.exp(next(logarithm) / SHARP)
                parts.append((sd, max(2 * (sd / rate) ** 2, 1.0), frequency))
        drive: NDArray[np.complex128] = np.zeros(0, dtype=complex)
        if kind.order and self.resonances is not None:
            found = self.resonances
            drive = next(number) * found.error_V / self.unit_V * found.gain
            parts = [
                (_ABSENT * noise, *part) for part in zip(found.tau.tolist(), found.frequency.tolist(), strict=True)
            ]
        signal_V, signal_tau, signal_hz = zip(*(parts or [(_ABSENT * noise, 1.0, 0.0)]), strict=True)
        return ImmOptions(
            signal_V=signal_V,
            signal_tau_s=signal_tau,
            signal_hz=signal_hz,
            drive_V=tuple(np.abs(drive).tolist()),
            drive_rad=tuple(np.angle(drive).tolist()),
            slow_V=slow_V,
            slow_tau_s=slow_tau,
            origin_V=0.0,
            noise_V=noise,
            disturbed_V=_DRASTIC * noise + disturbed,
            quiet_s=quiet,
            disturbed_s=lasting,
            longest_disturbance_s=1e9,
            variance_memory_s=memory,
        )


def usable(block: Block) -> NDArray[np.bool_]:
    """Return which readings have a value: one that a meter can have read, so that no square of it overflows."""
    return np.asarray((block["status"] & NOT_A_VALUE == 0) & (np.abs(block["value_V"]) < _NO_VOLTAGE_V))
