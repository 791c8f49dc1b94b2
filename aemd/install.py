"""Puts the systemd unit and what goes with it in place; starts nothing: it says what to run next.

For the system: the unit, its user, the meter's group and udev rule, a config to fill in. For one's own account: the
unit without what only root may ask for, and the config.
"""

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from aemd.errors import RecordingError, UsageError
from aemd.shipped import read_shipped

__all__ = ["InstallSummary", "Placement", "install", "plan_system", "plan_user"]

HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # noqa: S108 - what ProtectHome and PrivateTmp hide
USER_KEYS = frozenset(
    [
        *("Description", "StartLimitIntervalSec", "Type", "ExecStart", "Restart", "RestartSec"),
        *("RestartPreventExitStatus", "SuccessExitStatus", "WatchdogSec", "TimeoutStartSec", "TimeoutStopSec"),
        *("CacheDirectory", "Environment", "UMask", "NoNewPrivileges", "LockPersonality"),
    ]
)
"""Of the unit's settings, those that a user's own service manager honours without further rights."""


@dataclass(frozen=True, slots=True)
class Placement:
    """One file to be put in place."""

    path: Path
    text: str
    is_config: bool = False
    """Whether it is the owner's once it is there, and never overwritten."""


@dataclass(frozen=True, slots=True)
class InstallSummary:
    """What an installation did, or would do."""

    written: tuple[str, ...]
    kept: tuple[str, ...]
    """Configs that were there already."""
    next: tuple[str, ...]
    """Commands to run now, in order."""


def plan_system(root: Path = Path("/"), command: Path | None = None) -> tuple[Placement, ...]:
    """Return the files of a service of the system, below `root` (another than / for who makes packages).

    Raises:
        UsageError: aemd is installed where a hardened service cannot see it.
    """
    command = _this_command() if command is None else command
    if any(command.is_relative_to(place) for place in HIDDEN):
        raise UsageError(
            f"{command}: a system service sees nothing below {Path(*command.parts[:2])}; install aemd elsewhere, such"
            " as with `python3 -m venv /opt/aemd`, and run this from there, or use --user"
        )
    unit = read_shipped("aemd.service").replace("/usr/bin/env aemd", _quoted(command))
    return (
        Placement(root / "etc/systemd/system/aemd.service", unit),
        Placement(root / "etc/sysusers.d/aemd.conf", read_shipped("aemd.sysusers")),
        Placement(root / "etc/udev/rules.d/60-aemd.rules", read_shipped("60-aemd.rules")),
        Placement(root / "etc/aemd/aemd.toml", read_shipped("bench.toml"), is_config=True),
    )


def plan_user(environment: Mapping[str, str] = os.environ, command: Path | None = None) -> tuple[Placement, ...]:
    """Return the files of a service of one's own account; recordings go to ~/aemd.

    Raises:
        UsageError: there is no home folder.
    """
    home = environment.get("HOME", "")
    if not Path(home).is_absolute():
        raise UsageError("--user: $HOME is not set to a folder; set it, or use --system")
    folder = Path(environment.get("XDG_CONFIG_HOME") or Path(home) / ".config")
    config = folder / "aemd" / "aemd.toml"
    lines = []
    for line in read_shipped("aemd.service").splitlines():
        key, equals, _ = line.partition("=")
        if line.startswith("[") or (equals and key in USER_KEYS):
            lines.append(line)
    unit = "\n".join(lines).replace("\n[", "\n\n[")
    acquire = f"{_quoted(_this_command() if command is None else command)} acquire {_quoted(config)} --out %h/aemd"
    unit = unit.replace("/usr/bin/env aemd acquire /etc/aemd/aemd.toml --out /var/lib/aemd", acquire)
    unit += "\nWantedBy=default.target\n"
    return (
        Placement(folder / "systemd/user/aemd.service", unit),
        Placement(config, read_shipped("bench.toml"), is_config=True),
    )


def install(plan: tuple[Placement, ...], *, user: bool, dry_run: bool) -> InstallSummary:
    """Write the files, but for configs that are there; nothing in a dry run.

    Raises:
        RecordingError: a file cannot be written.
    """
    kept = tuple(each.path for each in plan if each.is_config and each.path.exists())
    written = tuple(each for each in plan if each.path not in kept)
    for each in () if dry_run else written:
        try:
            each.path.parent.mkdir(parents=True, exist_ok=True)
            each.path.write_text(each.text)
        except OSError as error:
            why = (error.strerror or str(error)).lower()
            way_out = "see who owns it" if user else "use sudo, or --user for your own account"
            raise RecordingError(f"{each.path}: cannot be written: {why}; {way_out}") from error
    config = next(each.path for each in plan if each.is_config)
    return InstallSummary(
        written=tuple(str(each.path) for each in written),
        kept=tuple(str(path) for path in kept),
        next=_next_steps(config, user=user),
    )


def _next_steps(config: Path, *, user: bool) -> tuple[str, ...]:
    edit = f"edit {config}: set resource to where your meter is"
    if user:
        return (
            edit,
            "systemctl --user daemon-reload",
            "systemctl --user enable --now aemd",
            "loginctl enable-linger  # so that it goes on when you log out",
        )
    return (
        edit,
        "systemd-sysusers",
        "udevadm control --reload && udevadm trigger",
        "systemctl daemon-reload",
        "systemctl enable --now aemd",
    )


def _this_command() -> Path:
    """Return the command of this installation."""
    return Path(sys.executable).parent / "aemd"


def _quoted(path: Path) -> str:
    """Write a path as a unit file needs it (systemd.service(5), "Command lines")."""
    text = str(path).replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{text}"' if any(char in text for char in " \"'\\;") else text
