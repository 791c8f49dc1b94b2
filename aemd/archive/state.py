"""An estimator between two files: as bytes that another process can go on from, to the bit."""

import io
import pickle
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import numpy as np

from aemd.block import ESTIMATE, Block, Estimates
from aemd.config import EstimatorChoice
from aemd.errors import RecordingError
from aemd.estimate.protocol import Estimator

__all__ = ["Carried", "digest", "load_state", "save_state"]

_ALLOWED = ("aemd.estimate.", "aemd.config", "numpy", "filterpy.", "collections", "copyreg", "_codecs")
"""Packages whose classes a state may name: an unpickler would call anything, and states lie on disk."""
_ALLOWED_BUILTINS = {"object", "bytearray", "complex", "set", "frozenset", "slice", "range"}


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
    return pickle.dumps((choice, estimator), protocol=4)


def load_state(octets: bytes) -> tuple[EstimatorChoice, Estimator]:
    """Return what `save_state` was given; it goes on from there.

    Raises:
        RecordingError: these are not its bytes.
    """
    try:
        choice, estimator = _Unpickler(io.BytesIO(octets)).load()
    except (pickle.UnpicklingError, EOFError, AttributeError, ImportError, ValueError, TypeError) as error:
        raise RecordingError(f"an estimator's state is damaged: {error}; remove it to begin anew") from error
    return choice, estimator


def digest(state: bytes | None) -> str:
    """Return the SHA-256 of a state; "" for none."""
    return sha256(state).hexdigest() if state is not None else ""


class _Unpickler(pickle.Unpickler):
    """Loads arrays and estimators, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        allowed = name in _ALLOWED_BUILTINS if module == "builtins" else module.startswith(_ALLOWED)
        if not allowed or "." in name:
            raise pickle.UnpicklingError(f"it names {module}.{name}")
        return super().find_class(module, name)
