"""The live view over HTTP: the page, its stream, and the state for programs. Standard library only.

    /         the page (and /page.js, /page.css)
    /stream   Server-Sent Events: ?span_s=60&columns=800
    /window   a stretch of the past: ?begin_ms=...&end_ms=...&columns=800
    /status   the state as JSON
    /health   200 `ok`, or 503 and the reason
    /metrics  for Prometheus

One way, plain HTTP, reconnected by every browser: so Server-Sent Events and no WebSocket. Each viewer has a thread that
waits for the feed and then writes to its socket; one that does not read fills its own socket, and is given up.
"""

import errno
import io
import math
import threading
import time
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from socket import AF_INET, AF_INET6, SO_SNDBUF, SOL_SOCKET, gaierror, gethostname, socket
from socketserver import TCPServer
from types import MappingProxyType
from typing import Any
from urllib.parse import parse_qs, urlsplit

from aemd.errors import UsageError
from aemd.live.access import Access, Address, Refusal
from aemd.live.feed import Feed, Place, to_json
from aemd.live.metrics import CONTENT_TYPE, as_metrics

__all__ = ["MOST_STREAMS", "Server"]

EVERYWHERE = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104 - read only
"""Addresses that stand for all of this machine's, and the one to reach them by from here."""
MOST_CONNECTIONS = 64  # each is a thread
MOST_STREAMS = 32
POLL_S = 0.5  # how soon `close` is heard
PATIENCE_S = 10.0  # for a request to arrive, and for a viewer to read
KEEP_ALIVE_S = 5.0  # a viewer that hears nothing for longer takes the line for dead
SEND_BUFFER_BYTES = 1 << 16  # a viewer that does not read holds no more of our past
MOST_COLUMNS = 4096
LONGEST_SPAN_S = 7 * 86400.0

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""The page is three files of ours: nothing inline, nothing evaluated, nothing from elsewhere."""
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Connection": "close",
}
ASSETS = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}


class Server:
    """Listens from the moment it is made; serves between `start` and `close`.

    Args:
        address: where; port 0 takes a free one.
        token: what a viewer must know; empty for none.
        hosts: further names of this machine.

    Raises:
        UsageError: the address cannot be listened on.
    """

    def __init__(self, address: Address, token: str, hosts: tuple[str, ...]) -> None:
        try:
            self._http = _Http(address)
        except OSError as error:
            raise UsageError(f"--live {address.authority}: {_obstacle(error)}") from error
        self.address = Address(address.host, self._http.server_port)
        self._token = token
        self._http.access = Access(self.address, token, hosts)
        self._thread = threading.Thread(target=self._http.serve_forever, name="aemd-http", args=(POLL_S,), daemon=True)

    @property
    def url(self) -> str:
        """What to open in a browser on this machine, the token included."""
        return self._url(EVERYWHERE.get(self.address.host, self.address.host))

    @property
    def url_elsewhere(self) -> str:
        """What to open on another machine that knows this one by its name; empty where `url` is the one to open."""
        return self._url(gethostname()) if self.address.host in EVERYWHERE else ""

    def _url(self, host: str) -> str:
        url = f"http://{Address(host, self.address.port).authority}/"
        return f"{url}?token={self._token}" if self._token else url

    def start(self, feed: Feed) -> None:
        """Begin to serve a feed."""
        self._http.feed = feed
        self._thread.start()

    def close(self) -> None:
        """Stop listening and serving; the feed must be closed before, so that the streams end. Twice is fine."""
        if self._thread.is_alive():
            self._http.shutdown()
            self._thread.join()
        self._http.server_close()


def _obstacle(error: OSError) -> str:
    """Return why an address cannot be listened on, and the way out."""
    if error.errno == errno.EADDRINUSE:
        return "is taken; name another port, or 0 for a free one"
    if error.errno == errno.EADDRNOTAVAIL or isinstance(error, gaierror):
        return "is no address of this machine; leave it out, or name 0.0.0.0 for other machines to look, too"
    return f"{(error.strerror or str(error)).lower()}; name another port, or 0 for a free one"


class _Http(ThreadingHTTPServer):
    """A thread a connection, of which there is a greatest number."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 32
    access: Access
    feed: Feed

    def __init__(self, address: Address) -> None:
        self.address_family = AF_INET6 if ":" in address.host else AF_INET
        self._free = threading.BoundedSemaphore(MOST_CONNECTIONS)
        self.free_streams = threading.BoundedSemaphore(MOST_STREAMS)
        super().__init__((address.host, address.port), _Handler)

    def server_bind(self) -> None:
        """Bind, without HTTPServer's question to the name service what we are called: it may take its time."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """Give the connection a thread, or hang up where there are enough."""
        if not self._free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve the connection, in its thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: a connection that breaks is its owner's business, and a log that strangers can fill is none."""


class _Arriving(io.RawIOBase):
    """A request as it comes: all of it within the patience, or whoever sends a letter now and then keeps a thread."""

    def __init__(self, connection: socket) -> None:
        self._connection = connection
        self._until_s = time.monotonic() + PATIENCE_S

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Take what has come.

        Raises:
            TimeoutError: it is too late.
        """
        self._connection.settimeout(max(self._until_s - time.monotonic(), 1e-3))
        return self._connection.recv_into(buffer)


class _Handler(BaseHTTPRequestHandler):
    """One connection, one request."""

    server: _Http
    protocol_version = "HTTP/1.1"
    timeout = PATIENCE_S

    def version_string(self) -> str:
        """Return the Server header: not which Python."""
        return "aemd"

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the base class's name
        """Say nothing: a log that strangers can fill is none."""

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:  # noqa: ARG002 - the base class's
        """Refuse in plain text what is no request that we know."""
        self.close_connection = True
        status = 405 if code == HTTPStatus.NOT_IMPLEMENTED else code
        self._send(status, f"{'only GET is answered here' if status == 405 else message}\n".encode())

    def setup(self) -> None:
        """Bound what the kernel keeps for a viewer that does not read."""
        self.request.setsockopt(SOL_SOCKET, SO_SNDBUF, SEND_BUFFER_BYTES)
        super().setup()
        self.rfile = io.BufferedReader(_Arriving(self.connection))

    def do_GET(self) -> None:
        """Answer."""
        self.close_connection = True
        self.connection.settimeout(PATIENCE_S)  # the request has used up some of the time that it had
        try:
            url = urlsplit(self.path)
            query = {key: values[-1] for key, values in parse_qs(url.query).items()}
            self.server.access.check(self.headers, query.get("token"))
            self._answer(url.path, query)
        except Refusal as refusal:
            self._send(refusal.status, f"{refusal}\n".encode())
        except ValueError:  # of an address, in the request line or in a header
            self._send(400, b"this is no address\n")
        except (ConnectionError, TimeoutError):
            return  # the viewer is gone, or has stopped reading: its connection ends here

    do_HEAD = do_GET

    def _answer(self, path: str, query: dict[str, str]) -> None:
        feed = self.server.feed
        if path in ASSETS:
            if path == "/" and "token" in query and self.server.access.needs_token:
                self._send(303, b"", headers={"Location": "/", "Set-Cookie": self.server.access.cookie()})
                return
            name, kind = ASSETS[path]
            self._send(200, files("aemd.live").joinpath(name).read_bytes(), kind)
        elif path == "/status":
            self._send(200, to_json(feed.status()), "application/json")
        elif path == "/health":
            complaint = feed.complaint()
            self._send(503 if complaint else 200, f"{complaint or 'ok'}\n".encode())
        elif path == "/metrics":
            self._send(200, as_metrics(feed.status()).encode(), CONTENT_TYPE)
        elif path == "/window":
            begin_ms, end_ms = _number(query, "begin_ms", 0, 1e14), _number(query, "end_ms", 0, 1e14)
            if not 0 < end_ms - begin_ms <= LONGEST_SPAN_S * 1e3:
                raise Refusal(400, "begin_ms, end_ms: must be a stretch of up to seven days")
            columns = round(_number(query, "columns", 16, MOST_COLUMNS, 800))
            self._send(200, feed.window(int(begin_ms * 1e6), int(end_ms * 1e6), columns), "application/json")
        elif path == "/stream":
            span_s = _number(query, "span_s", 1, LONGEST_SPAN_S, 60)
            self._stream(feed, round(span_s * 1e9), round(_number(query, "columns", 16, MOST_COLUMNS, 800)))
        else:
            raise Refusal(404, "there are: / /stream /window /status /health /metrics")

    def _stream(self, feed: Feed, span_ns: int, columns: int) -> None:
        """Send what is new, up to ten times a second, for as long as the viewer reads it."""
        if not self.server.free_streams.acquire(blocking=False):
            raise Refusal(503, f"{MOST_STREAMS} views are open; close one")
        feed.watching(1)
        try:
            self._begin(200, "text/event-stream", {})
            place, tick = Place(), -1
            while not feed.is_closed and self.command != "HEAD":
                if (now := feed.wait(tick, KEEP_ALIVE_S)) == tick:
                    self.wfile.write(b":\n\n")
                    continue
                tick = now
                frame, place = feed.frame(span_ns, columns, place)
                self.wfile.write(b"data: " + frame + b"\n\n")
        finally:
            feed.watching(-1)
            self.server.free_streams.release()

    def _send(
        self,
        status: int,
        body: bytes,
        kind: str = "text/plain; charset=utf-8",
        headers: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self._begin(status, kind, {"Content-Length": str(len(body)), **headers})
        if self.command != "HEAD":
            self.wfile.write(body)

    def _begin(self, status: int, kind: str, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in ({"Content-Type": kind} | HEADERS | headers).items():
            self.send_header(name, value)
        self.end_headers()


def _number(query: dict[str, str], name: str, least: float, most: float, default: float | None = None) -> float:
    """Return a number of a query.

    Raises:
        Refusal: it is none, or out of bounds, or missing.
    """
    text = query.get(name, "" if default is None else str(default))
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise Refusal(400, f"{name} = {text[:40]}: must be a number from {least:g} to {most:g}")
    return value
