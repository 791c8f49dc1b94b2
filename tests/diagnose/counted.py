"""A term for tests that count the work of a race."""

from dataclasses import dataclass, field

import numpy as np


@dataclass
class Counted:
    """A wave that counts how often it is asked for, and over how many readings."""

    cost_nats: float
    cause: str
    asked: list[int] = field(default_factory=list)

    start = np.zeros(1)
    bounds = ((-10.0, 10.0),)

    def add(self, theta, data, parts):
        self.asked.append(data.n)
        parts.mean += theta[0] * np.sin(data.t_s)

    def parameters(self, data):
        return ()
