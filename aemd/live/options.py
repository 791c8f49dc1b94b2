"""What a config's [live] may hold."""

import re
from dataclasses import dataclass

__all__ = ["LiveOptions"]

SHORTEST_TOKEN = 16


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """Who may look at the live page that `--live` serves."""

    token: str = ""
    """What a viewer must know. Empty: none on loopback, and elsewhere a new one at each start, which is printed."""
    hosts: tuple[str, ...] = ()
    """Further names by which this machine is reached, such as that of a proxy before it."""

    def __post_init__(self) -> None:
        if self.token and (len(self.token) < SHORTEST_TOKEN or not re.fullmatch(r"[A-Za-z0-9_.~-]+", self.token)):
            raise ValueError(
                f"token of {len(self.token)} characters: must be {SHORTEST_TOKEN} or more of A-Z a-z 0-9 - . _ ~"
            )
        for name in self.hosts:
            if not re.fullmatch(r"[A-Za-z0-9.-]+", name):
                raise ValueError(f"hosts: {name!r}: must be a name without port, such as meter.example.org")
