"""The meter on TCP ports and a serial line: one thread, any number of clients, who share the one meter."""

import errno
import logging
import os
import selectors
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from threading import Thread
from typing import Protocol

from aemd.errors import InstrumentError
from sim34410.bench import Bench
from sim34410.meter import Meter
from sim34410.serial_line import SerialLine
from sim34410.vxi11 import Vxi11Conversation, Vxi11Links

__all__ = ["serve_bench", "serve_meter"]

_LOG = logging.getLogger(__name__)
MOST_PORT = 65_535
_IDLE_S = 0.5
"""Longest pause between two looks at the meter, so that a long absence of clients does not pile up work."""
_BACKLOG_BYTES = 1 << 22
"""A client that leaves this much unread is not listened to until it has read; twice the largest block in ASCII."""


@contextmanager
def serve_bench(
    bench: Bench, host: str, *, port: int | None = None, vxi11_port: int | None = None, serial: bool = False
) -> Iterator[Mapping[str, str]]:
    """Serve the meter of `bench` from a thread of its own; port 0 takes a free one, None does without.

    A raw socket's client that goes away leaves the meter as it is, measuring or not; the last VXI-11 link has it clear
    itself (`Bench`). While the bench's faults have connections refused, nobody listens.

    Returns:
        A context whose value is the VISA resources by link (`socket`, `vxi11`, `serial`); leaving it ends the thread
        and closes every connection.

    Raises:
        InstrumentError: a port is taken, or the host is not this machine's.
    """
    with ExitStack() as stack:
        resources, doors = {}, []
        if port is not None:
            listener = stack.enter_context(_listen(host, port))
            doors.append(_Door(listener, lambda: bench.open_line("socket")))
            address, number = _name(listener)
            resources["socket"] = f"TCPIP0::{address}::{number}::SOCKET"
        if vxi11_port is not None:
            listener = stack.enter_context(_listen(host, vxi11_port))
            address, number = _name(listener)
            links = Vxi11Links(bench, number)
            doors.append(_Door(listener, lambda: Vxi11Conversation(links)))
            resources["vxi11"] = f"TCPIP0::{address},{number}::inst0::INSTR"
        server = _Server(bench, doors)
        if serial:
            line = stack.enter_context(SerialLine.opened(bench))
            resources["serial"] = line.resource
            server.add(line.master, line)
        thread = Thread(target=server.run, name="sim34410", daemon=True)
        thread.start()
        try:
            yield resources
        finally:
            server.stop()
            thread.join()


@contextmanager
def serve_meter(meter: Meter, host: str, port: int, clock: Callable[[], int]) -> Iterator[str]:
    """Serve `meter` on a raw socket alone, without faults; see `serve_bench`."""
    with serve_bench(Bench(meter, clock), host, port=port) as resources:
        yield resources["socket"]


def _listen(host: str, port: int) -> socket.socket:
    if not 0 <= port <= MOST_PORT:
        raise InstrumentError(f"cannot serve on {host} port {port}: must be 0 to {MOST_PORT}; 0 takes a free one")
    try:
        return socket.create_server((host, port))
    except OSError as error:
        is_the_ports = error.errno in (errno.EADDRINUSE, errno.EACCES)
        way_out = "0 takes a free one" if is_the_ports else "the host must be this computer's, such as 127.0.0.1"
        why = os.strerror(error.errno) if error.errno and error.errno > 0 else str(error.strerror)
        raise InstrumentError(f"cannot serve on {host} port {port}: {why.lower()}; {way_out}") from error


def _name(listener: socket.socket) -> tuple[str, int]:
    address, number = listener.getsockname()[:2]
    return "127.0.0.1" if address == "0.0.0.0" else address, number  # noqa: S104 - a client needs a real address


class Conversation(Protocol):
    """What one client says and hears, without a socket; a `Line` is one."""

    @property
    def is_closed(self) -> bool:
        """Whether the meter has hung up."""

    @property
    def wake_ns(self) -> int | None:
        """Host instant at which `take` may have more; None where it is not known."""

    def receive(self, received: bytes) -> None:
        """Take bytes from the client."""

    def take(self) -> bytes:
        """Return what is to be sent by now."""

    def close(self) -> None:
        """The client has gone."""


class _Door:
    """A port; it is shut, so that connections are refused, and opened again, on the same number."""

    def __init__(self, listener: socket.socket, greet: Callable[[], Conversation]) -> None:
        self.listener: socket.socket | None = listener
        self.greet = greet
        self._address = listener.getsockname()
        listener.settimeout(0)

    def shut(self) -> None:
        if self.listener is not None:
            self.listener.close()
            self.listener = None

    def open(self) -> socket.socket:
        if self.listener is None:
            self.listener = socket.create_server(self._address[:2])
            self.listener.settimeout(0)
        return self.listener


class _Client:
    def __init__(self, channel: "socket.socket | int", conversation: Conversation) -> None:
        self.channel = channel
        self.conversation = conversation
        self.unsent = bytearray()
        self.wanted = selectors.EVENT_READ


class _Server:
    def __init__(self, bench: Bench, doors: list[_Door]) -> None:
        self._bench = bench
        self._doors = doors
        self._clients: set[_Client] = set()
        self._stopper, self._stopped = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._stopped, selectors.EVENT_READ)
        for door in doors:
            self._selector.register(door.open(), selectors.EVENT_READ, door)
        self._are_open = True
        self._open_or_shut()  # the plug may be out from the beginning

    def add(self, channel: "socket.socket | int", conversation: Conversation) -> None:
        """Take a client: a socket, or a file that is read and written."""
        client = _Client(channel, conversation)
        self._clients.add(client)
        self._selector.register(channel, selectors.EVENT_READ, client)

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
            for door in self._doors:
                door.shut()
            self._selector.close()
            self._stopper.close()
            self._stopped.close()

    def _served_once(self) -> bool:
        """Wait for something to happen and deal with it; return whether to stop."""
        ready = self._selector.select(self._pause_s())
        with self._bench.lock:
            self._bench.advance()
            self._open_or_shut()
            for key, events in ready:
                if key.fileobj is self._stopped:
                    return True
                if isinstance(key.data, _Door):
                    self._accept(key.data)
                elif events & selectors.EVENT_READ:
                    self._receive(key.data)
            for client in list(self._clients):
                if client.conversation.is_closed:
                    self._drop(client)
                else:
                    client.unsent += client.conversation.take()
                    self._send(client)
        return False

    def _pause_s(self) -> float:
        with self._bench.lock:
            wakes = [self._bench.wake_ns, *(client.conversation.wake_ns for client in self._clients)]
        until_ns = min((wake for wake in wakes if wake is not None), default=None)
        if until_ns is None:
            return _IDLE_S
        return min(max((until_ns - self._bench.clock()) * 1e-9, 0.0), _IDLE_S)

    def _open_or_shut(self) -> None:
        if self._bench.is_open == self._are_open:
            return
        if self._are_open:
            for door in self._doors:
                if door.listener is not None:
                    self._selector.unregister(door.listener)
                    door.shut()
        else:
            try:
                listeners = [door.open() for door in self._doors]
            except OSError:  # while it was shut somebody took the number, for a connection of theirs: at the next look
                return
            for door, listener in zip(self._doors, listeners, strict=True):
                self._selector.register(listener, selectors.EVENT_READ, door)
        self._are_open = not self._are_open

    def _accept(self, door: _Door) -> None:
        if door.listener is None:
            return
        try:
            connection, address = door.listener.accept()
        except OSError:  # the client has already gone
            return
        try:
            conversation = door.greet()
        except ConnectionRefusedError:  # the plug was pulled since this look began
            connection.close()
            return
        connection.settimeout(0)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.add(connection, conversation)
        _LOG.info("client connected address=%s:%d", *address[:2])

    def _receive(self, client: _Client) -> None:
        if client not in self._clients:
            return
        try:
            channel = client.channel
            received = os.read(channel, 65_536) if isinstance(channel, int) else channel.recv(65_536)
        except BlockingIOError:
            return
        except OSError:
            received = b""
        if received:
            client.conversation.receive(received)
        else:
            self._drop(client)

    def _send(self, client: _Client) -> None:
        try:
            if client.unsent:
                channel = client.channel
                unsent = client.unsent
                del unsent[: os.write(channel, unsent) if isinstance(channel, int) else channel.send(unsent)]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
            return
        wanted = selectors.EVENT_READ if len(client.unsent) < _BACKLOG_BYTES else 0
        wanted |= selectors.EVENT_WRITE if client.unsent else 0
        if wanted != client.wanted:
            self._selector.modify(client.channel, wanted, client)
            client.wanted = wanted

    def _drop(self, client: _Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self._selector.unregister(client.channel)
            client.conversation.close()
            if not isinstance(client.channel, int):
                client.channel.close()
            _LOG.info("client gone clients=%d", len(self._clients))
