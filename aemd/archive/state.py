"""An estimator between two files: as bytes that another process can go on from, to the bit.

They are JSON, of the same text that a recording keeps of its estimator: states lie on disk, and what is read from there
must not be able to call anything.
"""

import json
from dataclasses import dataclass
from hashlib import sha256

import numpy as np

from aemd.block import ESTIMATE, READING, Block, Estimates
from aemd.config import EstimatorChoice, choose_estimator
from aemd.errors import ConfigError, RecordingError
from aemd.estimate import state
from aemd.estimate.protocol import Estimator
from aemd.estimate.registry import make_estimator
from aemd.record.description import read_parameters

__all__ = ["Carried", "digest", "load_state", "save_state"]


@dataclass(frozen=True, slots=True)
class Carried:
    """An estimator that does not know of an end: what it holds back comes with the next file."""

    estimator: Estimator

    @property
    def name(self) -> str:
        """The word that chooses it."""
        return self.estimator.name

    @property
    def lag(self) -> int:
        """Readings by which the estimate trails."""
        return self.estimator.lag

    def push(self, block: Block) -> Estimates:
        """Return the estimates that are ready."""
        return self.estimator.push(block)

    def flush(self) -> Estimates:
        """Return nothing."""
        return np.empty(0, ESTIMATE)


def save_state(choice: EstimatorChoice, estimator: Estimator) -> bytes:
    """Return the estimator as it is now."""
    return json.dumps({"estimator": choice.as_text(), "state": state.save_state(estimator)}).encode()


def load_state(octets: bytes, interval_s: float) -> tuple[EstimatorChoice, Estimator]:
    """Return what `save_state` was given; it goes on from there.

    Args:
        octets: of `save_state`.
        interval_s: between the readings of the file that follows: that of the whole run.

    Raises:
        RecordingError: these are not its bytes.
    """
    try:
        told = json.loads(octets)
        name, options = read_parameters(told["estimator"])
        choice = choose_estimator({"name": name, **options}, "it")
        estimator = make_estimator(choice.name, choice.options, interval_s)
        estimator.push(np.empty(0, READING))
        state.load_state(estimator, told["state"])
    except (ConfigError, KeyError, AttributeError, ValueError, TypeError, RecursionError) as error:
        raise RecordingError(f"an estimator's state is damaged: {error}; remove it to begin anew") from error
    return choice, estimator


def digest(octets: bytes | None) -> str:
    """Return the SHA-256 of a state; "" for none."""
    return sha256(octets).hexdigest() if octets is not None else ""
