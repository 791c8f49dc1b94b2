"""From readings to estimates: the paper's filters and their rivals, without clock, file, thread or logger."""

from aemd.estimate.protocol import Estimator
from aemd.estimate.registry import ESTIMATORS, make_estimator, options_of

__all__ = ["ESTIMATORS", "Estimator", "make_estimator", "options_of"]
