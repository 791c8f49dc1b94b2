"""The errors a user can meet, by whose fault it is.

    AemdError              never raised itself
      UsageError           yours: the command line; exit code 2
      ConfigError          yours: a config or a model file; exit code 78
      InstrumentError      the instrument's or its link's; exit code 1
      RecordingError       a recording's, a table's or the disk's; exit code 1

Every message is one line of lower case: place, key, value, rule, way out. Anything else that escapes is a bug.
"""

from collections.abc import Collection
from difflib import get_close_matches

__all__ = ["AemdError", "ConfigError", "InstrumentError", "RecordingError", "UsageError", "not_among"]


class AemdError(Exception):
    """Base of every error that is reported to the user as one line."""

    exit_code = 1


class UsageError(AemdError):
    """The command line asks for something that cannot be."""

    exit_code = 2


class ConfigError(AemdError):
    """The config file, or a model file, says something that cannot be."""

    exit_code = 78


class InstrumentError(AemdError):
    """The instrument or the link to it failed, or it is not the instrument we speak to."""


class RecordingError(AemdError):
    """A recording or a table cannot be read or written."""


def not_among(word: str, known: Collection[str]) -> str:
    """Return the end of a message about an unknown word: the nearest known one, and all there are.

    >>> not_among("aen", ["rem", "aem"])
    "did you mean 'aem'? there are: aem, rem"
    """
    near = get_close_matches(word, known, n=1)
    return (f"did you mean {near[0]!r}? " if near else "") + f"there are: {', '.join(sorted(known)) or 'none'}"
