"""The critic: what the base model gets wrong about a record, what that is consistent with, what fixing it is worth."""

from aemd.diagnose.catalogue import COVERED, NOT_COVERED
from aemd.diagnose.engine import criticise, diagnose
from aemd.diagnose.extend import model_of, write_extended
from aemd.diagnose.html import write_html
from aemd.diagnose.report import format_diagnosis
from aemd.diagnose.result import Diagnosis, Discrepancy, Finding, Gain, Value

__all__ = [
    "COVERED",
    "NOT_COVERED",
    "Diagnosis",
    "Discrepancy",
    "Finding",
    "Gain",
    "Value",
    "criticise",
    "diagnose",
    "format_diagnosis",
    "model_of",
    "write_extended",
    "write_html",
]
