"""The topics of the recording, live, over Foxglove's WebSocket protocol: for who has that viewer. Extra `foxglove`.

The same topics, message types and bytes as in the recording. The SDK's server asks nobody for a password and answers
any page in the user's browser, so it is for loopback alone; from elsewhere, `ssh -L 8765:localhost:8765 HOST`.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aemd.errors import UsageError
from aemd.live.access import Address
from aemd.live.feed import About
from aemd.live.health import Sources
from aemd.live.inbox import Inbox
from aemd.record.schema import (
    COLUMNS,
    ENCODING,
    EVENT,
    FILTERED,
    HEADER_BYTES,
    RAW,
    SCHEMA_DATA,
    SCHEMAS,
    encode_event,
    make_layout,
)

__all__ = ["DEFAULT_FOXGLOVE", "Foxglove", "encode_rows"]

DEFAULT_FOXGLOVE = Address(port=8765)  # where Foxglove looks first
TICK_S = 0.05
BACKLOG_MESSAGES = 1 << 14  # for a viewer that is slow; the SDK then drops the oldest


class Foxglove:
    """Serves the topics to Foxglove and kin; takes from its inbox in a thread of its own.

    Args:
        address: where to listen; loopback.

    Raises:
        UsageError: the package is missing, or the address is not loopback or cannot be listened on.
    """

    def __init__(self, address: Address) -> None:
        if not address.is_loopback:
            raise UsageError(
                f"--foxglove {address.authority}: has no password, so on loopback only; reach it by a tunnel:"
                f" ssh -L {address.port}:localhost:{address.port} HOST"
            )
        try:
            import foxglove  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise UsageError("--foxglove: needs the package foxglove-sdk; pip install aemd[foxglove]") from error
        self.inbox = Inbox()
        self._context = context = foxglove.Context()  # its channels hold it weakly
        self._channels = {
            topic: foxglove.Channel(
                topic,
                schema=foxglove.Schema(name=name, encoding=ENCODING, data=SCHEMA_DATA),
                message_encoding=ENCODING,
                context=context,
            )
            for topic, name in SCHEMAS.items()
        }
        try:
            self._server: Any = foxglove.start_server(
                name="aemd",
                host=address.host,
                port=address.port,
                context=context,
                message_backlog_size=BACKLOG_MESSAGES,
            )
        except RuntimeError as error:
            why = str(error).rpartition(":")[2].strip().lower()
            raise UsageError(
                f"--foxglove {address.authority}: {why}; name another port, or 0 for a free one"
            ) from error
        self.url_elsewhere = ""
        self.url = f"ws://{Address(address.host, self._server.port).authority}"

    @contextmanager
    def showing(self, about: About, sources: Sources) -> Iterator[None]:  # noqa: ARG002 - of every view
        """Pass on what comes while inside."""
        closed = threading.Event()

        def run() -> None:
            while not closed.wait(TICK_S):
                self.pass_on()

        thread = threading.Thread(target=run, name="aemd-foxglove", daemon=True)
        thread.start()
        try:
            yield
        finally:
            closed.set()
            thread.join()

    def pass_on(self) -> None:
        """Send what is in the inbox to whoever listens; where nobody does, it costs nothing."""
        for batch, estimates in self.inbox.take():
            self._send(RAW, batch.readings)
            self._send(FILTERED, estimates)
            for event in batch.events:
                self._channels[EVENT].log(encode_event(event), log_time=event.t_ns)

    def _send(self, topic: str, records: NDArray[np.void]) -> None:
        channel: Any = self._channels[topic]
        if not channel.has_sinks():
            return
        for payload, t_ns in zip(encode_rows(topic, records), records["t_ns"].tolist(), strict=True):
            channel.log(payload, log_time=t_ns)

    def close(self) -> None:
        """Stop listening. Twice is fine."""
        if self._server is not None:
            self._server.stop()
            self._server = None


def encode_rows(topic: str, records: NDArray[np.void]) -> list[bytes]:
    """Return the payload that each reading or estimate, shape (n,), has in a recording."""
    layout = make_layout(SCHEMA_DATA, SCHEMAS[topic], COLUMNS[SCHEMAS[topic]])
    assert layout is not None, topic  # noqa: S101 - of our own schema
    rows = layout.make_rows(len(records), 0)
    for name, column in COLUMNS[SCHEMAS[topic]].items():
        rows[name] = records[column]
    octets = np.ascontiguousarray(rows).view(np.uint8).reshape(len(records), -1)[:, HEADER_BYTES:]
    return [row.tobytes() for row in octets]
