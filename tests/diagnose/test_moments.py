"""Where a noise that changes is said to begin and to end."""

import numpy as np
from scipy.stats import norm

from aemd.diagnose.checks.moments import likeliest_window


def log_likelihood(z: np.ndarray, begin: int, end: int) -> float:
    """Of normal numbers of one deviation from begin to end and another beside it, each the likeliest."""
    beside = np.concatenate((z[:begin], z[end:]))
    return sum(float(norm.logpdf(part, scale=np.sqrt(np.mean(part**2))).sum()) for part in (z[begin:end], beside))


def test_a_stretch_is_the_likeliest_of_all():
    n, least = 100, 20
    z = np.random.default_rng(5).standard_normal(n) * np.where(np.arange(n) < 30, 0.5, 1.0)
    tries = [(b, e) for b in range(n) for e in range(b + least, n + 1) if n - e + b >= least]

    assert likeliest_window(z**2) == max(tries, key=lambda one: log_likelihood(z, *one))


def test_a_change_near_the_record_s_beginning_is_not_dragged_to_its_middle():
    """The walk of summed squares turns where it is farthest from even, and not where the likelihood is largest."""
    n = 6_000
    z = np.random.default_rng(6).standard_normal(n) * np.where(np.arange(n) < n // 6, 0.75, 1.0)

    begin, end = likeliest_window(z**2)

    assert begin == 0
    assert abs(end - n // 6) < 100
