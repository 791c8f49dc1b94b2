"""The other end of the live view, for programs: find a running one, ask for its state, read its stream."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPException, HTTPResponse
from typing import Any
from urllib.parse import SplitResult, urlencode, urlsplit

from aemd.display import format_quantity
from aemd.errors import InstrumentError, UsageError
from aemd.live.access import Address
from aemd.live.runtime import find_running

__all__ = ["StatusSummary", "ask_status", "find_url", "format_bytes", "frames", "summarise"]

PATIENCE_S = 10.0  # twice what a stream is silent at most


@dataclass(frozen=True, slots=True)
class StatusSummary:
    """A running acquisition's state as a person wants it."""

    health: str
    readings: int
    rate_hz: float
    lost: int
    not_written: int
    gaps: int
    overloads: int
    file: str
    file_size: str
    disk_free: str
    window: int
    last: str
    estimate: str
    running_s: float
    page: str


def find_url(url: str | None) -> str:
    """Return the address of the live view that is meant.

    Raises:
        UsageError: what was given is no address, or several are running.
        InstrumentError: none is running.
    """
    if url is not None:
        parts = _split(url)
        if parts.scheme != "http" or not parts.hostname:
            raise UsageError(f"{url}: must be an address such as http://127.0.0.1:8410/")
        return url
    running = find_running()
    if len(running) > 1:
        which = ", ".join(f"{one.url} ({one.instrument})" for one in running)
        raise UsageError(f"several are running; name one: {which}")
    if running:
        return running[0].url
    default = f"http://{Address().authority}/"
    try:
        _open(default, "health", {}).close()
    except InstrumentError as error:
        raise InstrumentError(
            "no live view is running here; start one with `aemd acquire --live`, or name its address"
        ) from error
    return default


def ask_status(url: str) -> dict[str, Any]:
    """Return the state that a live view tells.

    Raises:
        InstrumentError: nobody answers there, or it is no live view of ours, or it refuses.
    """
    try:
        with _open(url, "status", {}) as answer:
            state: dict[str, Any] = json.loads(answer.read())
            _ = state["instrument"], state["estimate"]["value_V"]  # is it one of ours?
    except (ValueError, KeyError, TypeError, HTTPException, OSError) as error:
        raise InstrumentError(f"{_without_token(url)}: this is no live view of aemd") from error
    return state | {"url": _without_token(url)}


def frames(url: str, span_s: float, columns: int) -> Iterator[dict[str, Any]]:
    """Yield what comes down the stream, and nothing from time to time while nothing comes, until the acquisition ends.

    Raises:
        InstrumentError: nobody answers, or what comes makes no sense.
    """
    with _open(url, "stream", {"span_s": span_s, "columns": columns}) as answer:
        try:
            for line in answer:
                if line.startswith(b"data: "):
                    yield json.loads(line.removeprefix(b"data: "))
                elif line.startswith(b":"):
                    yield {}
        except (ConnectionError, HTTPException, TimeoutError):
            return
        except ValueError as error:
            raise InstrumentError(f"{_without_token(url)}: this is no live view of aemd") from error


def summarise(state: dict[str, Any]) -> StatusSummary:
    """Return the state with its quantities written out."""

    def said(value: float | None, digits: int) -> str:
        return format_quantity(math.nan if value is None else value, state["unit"], digits)

    estimate, last = state["estimate"], state["last"]
    return StatusSummary(
        health=state["health"],
        readings=state["readings"],
        rate_hz=state["rate_hz"],
        lost=state["lost"],
        not_written=state["not_written"],
        gaps=state["gaps"],
        overloads=state["overloads"],
        file=state["file"] or "-",
        file_size=format_bytes(state["file_bytes"]),
        disk_free=format_bytes(state["disk_free_bytes"]),
        window=estimate["window"],
        last=said(last["value"], 7),
        estimate=f"{said(estimate['value'], 7)} ± {said(estimate['sigma'], 3).lstrip('+')}",
        running_s=state["uptime_s"],
        page=state["url"],
    )


def format_bytes(count: int) -> str:
    """Write a size with a decimal prefix.

    >>> format_bytes(999), format_bytes(46_200), format_bytes(80_900_000_000)
    ('999 B', '46.2 kB', '80.9 GB')
    """
    power = min(4, int(math.log10(count) // 3)) if count > 0 else 0
    return f"{count / 1000**power:.{1 if power else 0}f} {('B', 'kB', 'MB', 'GB', 'TB')[power]}"


def _split(url: str) -> SplitResult:
    try:
        parts = urlsplit(url)
        _ = parts.port
    except ValueError as error:
        raise UsageError(f"{url}: must be an address such as http://127.0.0.1:8410/") from error
    return parts


def _without_token(url: str) -> str:
    return url.partition("?")[0]


def _open(url: str, what: str, query: dict[str, Any]) -> HTTPResponse:
    """Ask, with the token of the URL, and return the answer.

    Raises:
        InstrumentError: nobody answers, or the answer is a refusal.
    """
    parts = _split(url)
    token = parts.query.removeprefix("token=")
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    connection = HTTPConnection(parts.hostname or "", parts.port or 80, timeout=PATIENCE_S)
    try:
        connection.request("GET", f"{parts.path.rstrip('/')}/{what}?{urlencode(query)}", headers=headers)
        answer = connection.getresponse()
    except (OSError, HTTPException) as error:
        why = (getattr(error, "strerror", None) or str(error) or "no answer").lower()
        raise InstrumentError(f"{_without_token(url)}: {why}; is `aemd acquire --live` running there?") from error
    if answer.status not in {200, 503}:
        reason = answer.read(200).decode(errors="replace").strip()
        raise InstrumentError(f"{_without_token(url)}: refused with {answer.status}: {reason.partition(chr(10))[0]}")
    return answer
