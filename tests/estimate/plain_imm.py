"""IMM with numpy matrices, straight from the equations: slow, nothing unrolled, nothing kept from one step to the next.

Where the kernel carries the covariance of held inputs with the state along, this one carries the inputs themselves, as
further states.
"""

import math

import numpy as np
from scipy.optimize import brentq
from scipy.stats import norm

from aemd.block import ESTIMATE, NOT_A_VALUE, Block, Estimates, Status
from aemd.estimate.imm import ImmOptions


class PlainImm:
    """Readings one by one; no restarts."""

    def __init__(self, options: ImmOptions, interval_s: float) -> None:
        T, lag, m = interval_s, options.lag, len(options.signal_V)
        self.options, self.n = options, 2 * m + 1
        size = self.n + lag
        self.F, self.Q, P = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, size))
        for i, (sd, tau, hz) in enumerate(zip(options.signal_V, options.signal_tau_s, options.signal_hz, strict=True)):
            turn = 2 * np.pi * hz * T
            block = slice(2 * i, 2 * i + 2)
            self.F[block, block] = math.exp(-T / tau) * np.array(
                [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
            )
            self.Q[block, block] = sd**2 * (1 - math.exp(-2 * T / tau)) * np.eye(2)
            P[block, block] = sd**2 * np.eye(2)
        common = np.zeros(size)
        for i, (sd, angle) in enumerate(zip(options.drive_V, options.drive_rad, strict=True)):
            common[2 * i : 2 * i + 2] = sd * math.cos(angle), sd * math.sin(angle)
            P[2 * i, 2 * i] += sd**2 / (1 - math.exp(-2 * T / options.signal_tau_s[i]))
            P[2 * i + 1, 2 * i + 1] = P[2 * i, 2 * i]
        self.Q += np.outer(common, common)
        last = self.n - 1
        self.F[last, last] = math.exp(-T / options.slow_tau_s)
        self.Q[last, last] = options.slow_V**2 * (1 - math.exp(-2 * T / options.slow_tau_s))
        P[last, last] = options.slow_V**2 + (options.disturbed_V**2 if options.origin_V is None else 0)
        self.H = np.zeros(size)
        self.H[: self.n : 2] = 1  # first of each pair, and the slow part
        self.input = self.H.copy()
        if options.slow == "disturbance":
            self.input[last] = 0
        if lag:
            self.F[self.n] = self.input  # the input of the reading before
        for i in range(1, lag):
            self.F[self.n + i, self.n + i - 1] = 1
        stay = [1 - math.exp(-T / options.quiet_s), 1 - math.exp(-T / options.disturbed_s)]
        self.chain = np.array([[1 - stay[0], stay[0]], [stay[1], 1 - stay[1]]])
        self.mu = np.array([stay[1], stay[0]]) / sum(stay)
        self.x, self.P = [np.zeros(size)] * 2, [P, P]
        self.forgetting = 1 - math.exp(-T / options.variance_memory_s)
        self.factor, self.origin, self.index = 1.0, options.origin_V, None

    def step(self, F: np.ndarray) -> None:
        """Mix and predict."""
        joint = self.mu[:, None] * self.chain
        mu = joint.sum(axis=0)
        x, P = [], []
        for j in range(2):
            weight = joint[:, j] / mu[j]
            mean = weight[0] * self.x[0] + weight[1] * self.x[1]
            cov = sum(w * (p + np.outer(a - mean, a - mean)) for w, a, p in zip(weight, self.x, self.P, strict=True))
            x.append(F @ mean)
            P.append(F @ cov @ F.T + self.Q)
        self.mu, self.x, self.P = mu, x, P

    def run(self, block: Block) -> Estimates:
        """Return the estimates of all readings; the last ones as the end of the block leaves them."""
        o, lag = self.options, self.options.lag
        out = np.zeros(block.size, dtype=ESTIMATE)
        left = np.zeros(block.size)
        still = self.F.copy()
        still[self.n :] = np.eye(still.shape[0])[self.n :]
        for k, (index, t_ns, z, status) in enumerate(block.tolist()):
            self.step(self.F)  # moves the held inputs one place on
            for _ in range(0 if self.index is None else index - self.index - 1):
                self.step(still)
            self.index = index
            out[k]["index"], out[k]["t_ns"], out[k]["status"] = index, t_ns, status
            if status & NOT_A_VALUE:
                out[k]["status"] |= Status.COASTED
                out[k]["u_V"] = self.mu @ [x[self.n - 1] for x in self.x] if o.slow == "disturbance" else 0
            else:
                self.origin = z if self.origin is None else self.origin
                y, densities, innovation = z - self.origin, [], []
                for j in range(2):
                    R = o.noise_V**2 + (o.disturbed_V**2 / self.factor if j else 0)
                    S = self.H @ self.P[j] @ self.H + R
                    e = y - self.H @ self.x[j]
                    K = self.P[j] @ self.H / S
                    self.x[j], self.P[j] = self.x[j] + K * e, self.P[j] - np.outer(K, K) * S
                    densities.append(norm.pdf(e, scale=math.sqrt(S * self.factor)))
                    innovation.append(e * e / S)
                joint = self.mu * densities
                out[k]["log_likelihood"] = math.log(joint.sum())
                self.mu = joint / joint.sum()
                noise = 0.0
                for j in range(2):
                    R = o.noise_V**2 + (o.disturbed_V**2 / self.factor if j else 0)
                    noise += self.mu[j] * (y - self.H @ self.x[j]) * o.noise_V**2 / R
                left[k] = y - noise
                self.factor += self.forgetting * self.mu[0] * (innovation[0] - self.factor)
            if k >= lag:
                self._write(out[k - lag], lag, left[k - lag])
        for back in range(min(lag, block.size)):
            self._write(out[block.size - 1 - back], back, left[block.size - 1 - back])
        return out

    def _write(self, row: np.void, back: int, left: float) -> None:
        pick = self.input if back == 0 else np.eye(self.x[0].size)[self.n + back - 1]
        mean = np.array([pick @ x for x in self.x])
        sd = np.sqrt([self.factor * (pick @ P @ pick) for P in self.P])
        value = float(self.mu @ mean)

        def beyond(h: float) -> float:
            inside = norm.cdf((h - mean + value) / sd) - norm.cdf((-h - mean + value) / sd)
            return float(self.mu @ inside) - 0.95

        half = brentq(beyond, 0, 10 * (np.abs(mean - value) + sd).max())
        row["value_V"], row["sigma_V"] = self.origin + value, half / norm.ppf(0.975)
        if not row["status"] & Status.COASTED:
            row["u_V"] = left - value
