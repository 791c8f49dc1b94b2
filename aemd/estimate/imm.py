"""An interacting multiple model (IMM): input, slow and abrupt disturbance told apart by band and by abruptness."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le

from aemd.block import ESTIMATE, READING, Block, Estimates
from aemd.errors import ConfigError
from aemd.estimate import imm_kernels
from aemd.estimate.compiled import choose
from aemd.estimate.kalman import columns_of
from aemd.estimate.options import Count, Positive, check_bounds, discrete_phi

__all__ = ["Imm", "ImmOptions", "imm_model"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ImmOptions:
    """Options of IMM: what is known of the input, of the two disturbances and of the noise.

    `aemd tune` finds them in a stretch of readings. The defaults are for the sensor of the paper, in round numbers.
    """

    signal_V: tuple[Positive, ...] = (1.4e-3,)
    """Standard deviation of each part of the input, V."""
    signal_tau_s: tuple[Positive, ...] = (1.0,)
    """Time in which each part forgets (tau_s of the paper's eq. 2), s."""
    signal_hz: tuple[Annotated[float, Ge(0)], ...] = (0.0,)
    """Frequency that each part swings at, Hz; 0 is the first-order Markov process of eq. 2."""
    signal_is: tuple[Literal["input", "disturbance"], ...] = ()
    """What each part is, one for each in signal_V; none: all are the input. A disturbance, such as a line or a
    resonance of the table, is followed as the others are, and left out of the estimate."""
    drive_V: tuple[Positive, ...] = ()
    """Noise per reading that one source gives to each part at once, V; none: each part has only a noise of its own.
    What vibrates is shaken at one place, and only parts that move together can cancel between two resonances."""
    drive_rad: tuple[float, ...] = ()
    """Phase at which it does, one for each in drive_V, rad."""
    slow_V: Positive = 0.3e-3
    """Standard deviation of the slow part, V."""
    slow_tau_s: Positive = 150.0
    """Time in which the slow part forgets, s. Far beyond the length of a recording it is a random walk."""
    slow: Literal["disturbance", "input"] = "disturbance"
    """What the slow part is: the sensor's own drift, u_in, or part of the input, as where a reference is watched."""
    origin_V: float | None = None
    """What the input and the slow part vary about, V. Without one: the first reading, which may itself be disturbed.

    It is taken as known: sigma_V counts no error of it. One that was tuned beside a slow disturbance may be far off,
    since a constant of the input and one of the disturbance look the same."""
    noise_V: Positive = 0.0167e-3
    """Standard deviation of the reading's white noise, V: sigma_R."""
    disturbed_V: Positive = 30e-3
    """Standard deviation of the abrupt disturbance u_ex while there is one, V."""
    quiet_s: Positive = 5.0
    """Mean time between abrupt disturbances, s."""
    disturbed_s: Positive = 0.5
    """Mean time that one lasts, s."""
    longest_disturbance_s: Positive = 60.0
    """After this long in one disturbance the estimator starts afresh: it is the input that has changed. s."""
    lag: Annotated[int, Ge(0), Le(10_000)] = 0
    """Readings by which the estimate trails, so that it is made from those after it too. Each costs about as much time
    as a tenth of the filter."""
    variance_memory_s: Annotated[float, Gt(0)] = math.inf
    """Time over which a common factor of all these variances is followed, from how far the quiet readings were from
    their predictions, s; infinite: they are what is said here. For sensors whose noise comes and goes."""
    gate: Positive = 1e6
    """A reading further than this from its prediction, in standard deviations of the disturbed mode, is treated as one
    without a value."""
    restart_after: Count = 10_000
    """After more readings in a row than this without a value (lost or flagged), the estimator starts afresh."""

    def __post_init__(self) -> None:
        """Refuse what is out of bounds, or does not fit together.

        Raises:
            ValueError: a value breaks a rule.
        """
        check_bounds(self)
        for name in ("signal_V", "signal_tau_s", "signal_hz"):
            values, least = getattr(self, name), "at least 0" if name == "signal_hz" else "above 0"
            if not isinstance(values, tuple) or not values or not all(isinstance(v, float | int) for v in values):
                raise ValueError(f"{name} = {values!r}: must be a list of numbers, at least 1")
            if not all(0 <= value < math.inf and (value > 0 or name == "signal_hz") for value in values):
                raise ValueError(f"{name} = {list(values)}: must be finite and {least}")
        if not len(self.signal_V) == len(self.signal_tau_s) == len(self.signal_hz):
            raise ValueError(
                f"signal_V, signal_tau_s, signal_hz have {len(self.signal_V)}, {len(self.signal_tau_s)} and "
                f"{len(self.signal_hz)} values: must have as many"
            )
        if len(self.signal_is) not in {0, len(self.signal_V)} or not set(self.signal_is) <= {"input", "disturbance"}:
            raise ValueError(
                f"signal_is = {list(self.signal_is)}: must be 'input' or 'disturbance', as many as signal_V, "
                f"{len(self.signal_V)}, or none"
            )
        if self.signal_is and "input" not in self.signal_is:
            raise ValueError(f"signal_is = {list(self.signal_is)}: at least one must be 'input'")
        if len(self.drive_V) != len(self.drive_rad) or len(self.drive_V) not in {0, len(self.signal_V)}:
            raise ValueError(
                f"drive_V, drive_rad have {len(self.drive_V)} and {len(self.drive_rad)} values: must have as many as "
                f"signal_V, {len(self.signal_V)}, or none"
            )
        if not all(0 < value < math.inf for value in self.drive_V) or not all(map(math.isfinite, self.drive_rad)):
            raise ValueError(
                f"drive_V = {list(self.drive_V)}, drive_rad = {list(self.drive_rad)}: must be finite, drive_V above 0"
            )
        if self.origin_V is not None and not math.isfinite(self.origin_V):
            raise ValueError(f"origin_V = {self.origin_V!r}: must be a finite number of volts")


class Imm:
    """Estimate the input with two Kalman filters that share one state model and differ in the noise of a reading.

        z = origin + s + u_in + w                   the quiet mode, w of variance noise_V^2
        z = origin + s + u_in + u_ex + w            the disturbed one, u_ex of variance disturbed_V^2

    s is a sum of Markov processes, each of first order (eq. 2 of the paper) or swinging at a frequency of its own. u_in
    is a slower one, and those of them that are said to be disturbances. What tells them apart is the band that each is
    in, so where the bands overlap they cannot be told apart, and the estimate splits a reading between them in the
    ratio of their spectra. u_ex is told by its size: the mode is a Markov chain, the modes' estimates are mixed before
    each reading with the chain's probabilities, and weighed after it with their likelihoods (Blom and Bar-Shalom, IEEE
    Trans. Automatic Control 33, 780, 1988). In the disturbed mode a reading has next to no weight, so the input is
    carried on by its own model until the readings agree with it again.

    value_V         the mean over both modes, given the readings up to `lag` after it
    sigma_V         half the 95 % interval over 1.96; that of a Gaussian is its standard deviation
    u_V             what is left of the reading without the input and its noise: u_in + u_ex
    log_likelihood  of the mixture, one step ahead

    A reading without a value, lost or flagged, is predicted over (COASTED) and sigma grows.
    """

    name = "imm"

    def __init__(self, options: ImmOptions, interval_s: float, few: int = 0) -> None:
        self.options = options
        self.interval_s = interval_s
        self._few = few
        self._pairs = (0,) * len(options.signal_V)
        self._model = imm_model(options, interval_s)
        self._state = imm_kernels.start_imm(self._model, options.lag)
        self.push(np.empty(0, dtype=READING))  # compiles now, or loads what was compiled, not at the first reading

    @property
    def lag(self) -> int:
        """Readings by which the estimate trails."""
        return self.options.lag

    def push(self, block: Block) -> Estimates:
        """Return the estimates that are ready."""
        estimates = np.empty(block.size, dtype=ESTIMATE)
        index, value_V, status = columns_of(block)
        t_ns = block["t_ns"].copy()
        run = choose(imm_kernels.run_imm, block.size, self._few)
        ready = run(self._pairs, self._state, self._model, index, t_ns, value_V, status, estimates)
        return estimates[:ready]

    def flush(self) -> Estimates:
        """Return the estimates that the lag still holds back."""
        estimates = np.empty(self.lag, dtype=ESTIMATE)
        drain = choose(imm_kernels.drain_imm, self.lag, self._few)
        return estimates[: drain(self._state, estimates)]


def imm_model(options: ImmOptions, interval_s: float) -> imm_kernels.ImmModel:
    """Return the numbers that the kernel needs: the step from one reading to the next of each continuous process.

    A process of standard deviation sigma that forgets in tau and swings at f: rho = exp(-T/tau), theta = 2 pi f T,
    Q = sigma^2 (1 - rho^2). A common drive adds its outer product to Q; before the first reading each part has the
    variance that it comes to alone. A mode that lasts t on average is left before the next reading with 1 - exp(-T/t).

    Raises:
        ConfigError: the interval cannot be, or a frequency is above half the reading rate.
    """
    rho = np.array([discrete_phi(tau_s, interval_s) for tau_s in options.signal_tau_s])
    theta = 2 * np.pi * np.array(options.signal_hz) * interval_s
    if theta.max() > 1.01 * np.pi:  # a meter may be that much slower than the one of the tuning; it folds to near half
        raise ConfigError(
            f"signal_hz = {max(options.signal_hz):g}: must be at most half the reading rate, {0.5 / interval_s:g} Hz"
        )
    signal, slow = np.array(options.signal_V) ** 2, options.slow_V**2
    drive, angle = (np.array(values or [0.0] * theta.size) for values in (options.drive_V, options.drive_rad))
    left = -np.expm1(-2 * interval_s / np.array(options.signal_tau_s))
    durations_s = np.array([options.quiet_s, options.disturbed_s])
    taken_from_reading = 0.0 if options.origin_V is not None else options.disturbed_V**2
    return imm_kernels.ImmModel(
        cos=rho * np.cos(theta),
        sin=rho * np.sin(theta),
        Q=signal * left,
        drive=np.column_stack([drive * np.cos(angle), drive * np.sin(angle)]).ravel(),
        start=signal + drive**2 / left,
        slow_phi=discrete_phi(options.slow_tau_s, interval_s),
        slow_Q=-slow * math.expm1(-2 * interval_s / options.slow_tau_s),
        slow_start=slow + taken_from_reading,
        R=options.noise_V**2 + np.array([0.0, options.disturbed_V**2]),
        # A mode that is never left, or always at once, would make the other impossible, and 0 be divided by.
        leave=np.clip(-np.expm1(-interval_s / durations_s), 1e-15, 1 - 1e-15),
        slow_is_input=int(options.slow == "input"),
        is_input=np.array([float(kind == "input") for kind in options.signal_is or ["input"] * theta.size]),
        origin=math.nan if options.origin_V is None else float(options.origin_V),
        gate=float(options.gate),
        restart_after=options.restart_after,
        longest_disturbance=math.ceil(options.longest_disturbance_s / interval_s),
        forgetting=-math.expm1(-interval_s / options.variance_memory_s),
    )
