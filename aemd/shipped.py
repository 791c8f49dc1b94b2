"""Files that come with aemd: beside this module when installed, in config/ in a checkout."""

from importlib.resources import files
from pathlib import Path

__all__ = ["read_shipped"]


def read_shipped(name: str) -> str:
    """Return the text of a file of config/."""
    package = files("aemd")
    installed = package.joinpath("share", name)
    if installed.is_file():
        return installed.read_text(encoding="utf-8")
    return Path(str(package)).parent.joinpath("config", name).read_text(encoding="utf-8")
