"""Archives: many recordings at once, on one machine or a cluster, gone on with where they were left."""

from aemd.archive.places import is_pattern
from aemd.archive.replay import ArchiveSummary, replay_archive

__all__ = ["ArchiveSummary", "is_pattern", "replay_archive"]
