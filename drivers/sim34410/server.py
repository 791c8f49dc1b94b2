"""The meter on a TCP port: one thread, any number of clients, who share the one meter."""

import logging
import selectors
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Thread

from aemd.errors import InstrumentError
from sim34410.meter import Meter
from sim34410.session import Session

__all__ = ["serve_meter"]

_LOG = logging.getLogger(__name__)
MOST_PORT = 65_535
_IDLE_S = 0.5
"""Longest pause between two looks at the meter, so that a long absence of clients does not pile up work."""
_BACKLOG_BYTES = 1 << 22
"""A client that leaves this much unread is not listened to until it has read; twice the largest block in ASCII."""


@contextmanager
def serve_meter(meter: Meter, host: str, port: int, clock: Callable[[], int]) -> Iterator[str]:
    """Serve `meter` on a TCP socket from a thread of its own; port 0 takes a free one.

    A client that goes away leaves the meter as it is, measuring or not, as the raw socket of the real one does.

    Returns:
        A context whose value is the VISA resource; leaving it ends the thread and closes every connection.

    Raises:
        InstrumentError: the port is taken, or the host is not this machine's.
    """
    with _listen(host, port) as listener:
        server = _Server(meter, listener, clock)
        thread = Thread(target=server.run, name="sim34410", daemon=True)
        thread.start()
        address, number = listener.getsockname()[:2]
        try:
            yield f"TCPIP0::{'127.0.0.1' if address == '0.0.0.0' else address}::{number}::SOCKET"  # noqa: S104
        finally:
            server.stop()
            thread.join()


def _listen(host: str, port: int) -> socket.socket:
    if not 0 <= port <= MOST_PORT:
        raise InstrumentError(f"cannot serve on {host} port {port}: must be 0 to {MOST_PORT}; 0 takes a free one")
    try:
        return socket.create_server((host, port))
    except OSError as error:
        raise InstrumentError(f"cannot serve on {host} port {port}: {error.strerror}; 0 takes a free one") from error


class _Client:
    def __init__(self, connection: socket.socket, meter: Meter) -> None:
        self.connection = connection
        self.session = Session(meter)
        self.unsent = bytearray()
        self.wanted = selectors.EVENT_READ


class _Server:
    def __init__(self, meter: Meter, listener: socket.socket, clock: Callable[[], int]) -> None:
        self._meter = meter
        self._clock = clock
        self._listener = listener
        self._listener.settimeout(0)
        self._clients: set[_Client] = set()
        self._stopper, self._stopped = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ)
        self._selector.register(self._stopped, selectors.EVENT_READ)

    def stop(self) -> None:
        """Have `run` return."""
        self._stopper.send(b".")

    def run(self) -> None:
        """Serve until stopped."""
        try:
            while not self._served_once():
                pass
        finally:
            for client in list(self._clients):
                self._drop(client)
            self._selector.close()
            self._stopper.close()
            self._stopped.close()

    def _served_once(self) -> bool:
        """Wait for something to happen and deal with it; return whether to stop."""
        ready = self._selector.select(self._pause_s())
        if not ready:
            self._meter.advance()
        for key, events in ready:
            if key.fileobj is self._stopped:
                return True
            if key.fileobj is self._listener:
                self._accept()
            elif events & selectors.EVENT_READ:
                self._receive(key.data)
        for client in list(self._clients):
            if client.session.waiting:  # by time, or because another client's command ended the wait
                client.unsent += client.session.handle(b"")
            self._send(client)
        return False

    def _pause_s(self) -> float:
        wakes = [client.session.wake_ns for client in self._clients]
        until_ns = min((wake for wake in wakes if wake is not None), default=None)
        if until_ns is None:
            return _IDLE_S
        return min(max((until_ns - self._clock()) * 1e-9, 0.0), _IDLE_S)

    def _accept(self) -> None:
        try:
            connection, address = self._listener.accept()
        except OSError:  # the client has already gone
            return
        connection.settimeout(0)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = _Client(connection, self._meter)
        self._clients.add(client)
        self._selector.register(connection, selectors.EVENT_READ, client)
        _LOG.info("client connected address=%s:%d", *address[:2])

    def _receive(self, client: _Client) -> None:
        try:
            received = client.connection.recv(65_536)
        except BlockingIOError:
            return
        except OSError:
            received = b""
        if received:
            client.unsent += client.session.handle(received)
        else:
            self._drop(client)

    def _send(self, client: _Client) -> None:
        if client not in self._clients:
            return
        try:
            if client.unsent:
                del client.unsent[: client.connection.send(client.unsent)]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
            return
        wanted = selectors.EVENT_READ if len(client.unsent) < _BACKLOG_BYTES else 0
        wanted |= selectors.EVENT_WRITE if client.unsent else 0
        if wanted != client.wanted:
            self._selector.modify(client.connection, wanted, client)
            client.wanted = wanted

    def _drop(self, client: _Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self._selector.unregister(client.connection)
            client.connection.close()
            _LOG.info("client gone clients=%d", len(self._clients))
