"""The methods that are compared, and the better one's parameters: never from the record that it is judged on."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from aemd.block import Estimates
from aemd.estimate import make_estimator
from aemd.estimate.imm import ImmOptions
from aemd.estimate.tune import noise_of, tune
from aemd.paper.oracle import oracle
from aemd.paper.protocol import INTERVAL_S, Condition, Record, make_record

__all__ = ["BETTER", "LAG", "METHODS", "PAPERS", "Parameters", "estimate", "tune_parameters"]

LAG = 15
"""Readings of lag in the rows that have one: a second."""

PAPERS = ("KF", "LMS", "REM", "AEM")
"""The paper's four, with its parameters and the documented defaults of everything that it leaves open."""

METHODS = (*PAPERS, "imm", "imm_lag15", "imm_one", "imm_one_lag15", "oracle", "oracle_lag15")
"""imm has parameters tuned on another record of the same test, imm_one a single set for all tests."""

BETTER = "imm"
"""The one that is judged: without lag, in every row."""

Parameters = Mapping[str, ImmOptions]
"""Options by condition, and the set for all of them under `one`."""

_NAMES = {"KF": "kalman", "LMS": "lms", "REM": "rem", "AEM": "aem"}


def tune_parameters(seed: int) -> dict[str, ImmOptions]:
    """Return the parameters found in the records of a seed, the paper's historical sample; the input varies about 0 V.

    The broadband test needs its noise from elsewhere: its input moves thirty times as far from reading to reading as
    the noise does, and the noise's share in that is far below the scatter of an estimate from 1,000 readings. It is
    taken from the static record of the same seed, as the paper takes R from static data by the Allan variance (after
    eq. 3).

    The one set for all tests has the input of the broadband test, the least special, and the slow part of the static.
    """
    static, dynamic, broadband = (make_record(name, seed).block for name in ("static", "dynamic", "broadband"))
    at_rest = tune([static], INTERVAL_S, origin_V=0.0).options
    moving = tune([broadband], INTERVAL_S, origin_V=0.0, noise_V=noise_of(static)).options
    return {
        "static": at_rest,
        "probe": at_rest,
        "dynamic": tune([dynamic], INTERVAL_S, origin_V=0.0).options,
        "broadband": moving,
        "one": replace(moving, slow_V=at_rest.slow_V, slow_tau_s=at_rest.slow_tau_s),
    }


def estimate(method: str, condition: Condition, record: Record, parameters: Parameters) -> Estimates:
    """Return a method's estimates of a record, one for each reading, array of ESTIMATE."""
    lag = LAG if method.endswith("lag15") else 0
    if method.startswith("oracle"):
        return oracle(condition, record, lag)
    if method.startswith("imm"):
        options = parameters["one" if method.startswith("imm_one") else condition]
        estimator = make_estimator("imm", replace(options, lag=lag), INTERVAL_S)
    else:
        estimator = make_estimator(_NAMES[method], {}, INTERVAL_S)
    return np.concatenate([estimator.push(record.block), estimator.flush()])
