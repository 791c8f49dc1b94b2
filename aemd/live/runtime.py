"""How `aemd status` and `aemd watch` find a running live view: a small file, there as long as the view is.

It holds the address with its token: then only its owner may read it, or, of a service, the service's group. The address
of a service's view without a token is everybody's on this machine, who could reach it anyway.
"""

import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

__all__ = ["Running", "announced", "find_running"]


@dataclass(frozen=True, slots=True)
class Running:
    """A live view that somebody announced."""

    pid: int
    url: str
    instrument: str


def _folders(environment: Mapping[str, str]) -> list[Path]:
    """Return where such files are, the one to write to first: systemd's for a service, the session's, a private one."""
    stated = [environment.get("RUNTIME_DIRECTORY", "").partition(":")[0]]
    stated.append(environment["XDG_RUNTIME_DIR"] + "/aemd" if environment.get("XDG_RUNTIME_DIR") else "")
    own = Path(tempfile.gettempdir()) / f"aemd-{os.getuid()}"
    return [*(Path(folder) for folder in stated if folder), own, Path("/run/aemd")]


@contextmanager
def announced(url: str, instrument: str, environment: Mapping[str, str] = os.environ) -> Iterator[Path | None]:
    """Let others of this user find the live view while inside; where no file can be written, they must be told."""
    path = _folders(environment)[0] / f"{os.getpid()}.json"
    mode = 0o600
    if environment.get("RUNTIME_DIRECTORY"):
        mode = 0o640 if "token=" in url else 0o644
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if path.parent.stat().st_uid != os.getuid():
            raise PermissionError  # in a shared folder anyone can make one of this name, and would get the token
        path.unlink(missing_ok=True)
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with open(handle, "w", encoding="utf-8") as file:  # noqa: PTH123 - of a handle
            json.dump(asdict(Running(os.getpid(), url, instrument)), file)
    except OSError:
        yield None
        return
    try:
        yield path
    finally:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def find_running(environment: Mapping[str, str] = os.environ) -> list[Running]:
    """Return the announced live views whose process is there, newest first."""
    found: dict[int, Running] = {}
    for folder in _folders(environment):
        for path in _newest_first(folder):
            try:
                if path.stat().st_uid not in {os.getuid(), 0} and folder != Path("/run/aemd"):
                    continue  # somebody else's: it could send us, and our token, anywhere
                running = Running(**json.loads(path.read_text(encoding="utf-8")))
            except (OSError, ValueError, TypeError):
                continue
            if Path(f"/proc/{running.pid}").exists():
                found.setdefault(running.pid, running)
    return list(found.values())


def _newest_first(folder: Path) -> list[Path]:
    try:
        return sorted(folder.glob("*.json"), key=lambda path: path.stat().st_mtime, reverse=True)
    except OSError:
        return []
