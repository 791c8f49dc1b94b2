"""Archives: many recordings at once, on one machine or a cluster, gone on with where they were left."""

from aemd.archive.places import is_pattern
from aemd.archive.replay import ArchiveSummary, replay_archive
from aemd.archive.table import ArchiveTable, diagnose_archive, tune_archive, write_page

__all__ = [
    "ArchiveSummary",
    "ArchiveTable",
    "diagnose_archive",
    "is_pattern",
    "replay_archive",
    "tune_archive",
    "write_page",
]
