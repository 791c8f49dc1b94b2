"""Over real sockets: who is refused and how, what viewers that do not read can and cannot do, and what is told."""

import http.client
import json
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aemd.errors import UsageError
from aemd.live import server as server_module
from aemd.live.access import Access, Address, Refusal, make_token, parse_address
from aemd.live.server import MOST_CONNECTIONS, MOST_STREAMS, Server
from tests.live.conftest import Bench

TOKEN = "correct-horse-battery-staple"


@pytest.fixture(autouse=True)
def _closed_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "POLL_S", 0.02)


@contextmanager
def serving(bench: Bench, host: str = "127.0.0.1", token: str = "", hosts: tuple[str, ...] = ()) -> Iterator[Server]:
    server = Server(Address(host, 0), token, hosts)
    bench.feed.start()
    server.start(bench.feed)
    try:
        yield server
    finally:
        bench.feed.close()
        server.close()
        deadline = time.monotonic() + 60
        while server._http._free._value < MOST_CONNECTIONS and time.monotonic() < deadline:
            time.sleep(0.001)  # until each connection's thread has closed it


def ask(server: Server, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.address.port, timeout=60)
    with suppress(BrokenPipeError):
        connection.request(method, path, headers={key.replace("_", "-"): value for key, value in headers.items()})
    answer = connection.getresponse()
    body = b"" if path.startswith("/stream") and answer.status == 200 else answer.read()
    connection.close()
    return answer.status, {key.lower(): value for key, value in answer.getheaders()}, body


PATHS = ("/", "/page.js", "/stream", "/window?begin_ms=1&end_ms=2", "/status", "/health", "/metrics")


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("host", ["evil.example", "localhost.evil.example", "127.0.0.1.evil.example:8410", "", "a@b:c"])
def test_a_host_that_is_not_ours_is_refused_everywhere(path: str, host: str, bench: Bench) -> None:
    with serving(bench) as server:
        assert ask(server, path, Host=host)[0] == 403


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:9999", "127.0.0.1:1", "[::1]:8410", "127.0.0.1"])
def test_a_tunnels_end_and_every_name_of_loopback_are_ours(host: str, bench: Bench) -> None:
    with serving(bench) as server:
        assert ask(server, "/health", Host=host)[0] == 200


def test_on_loopback_another_machines_address_is_no_host_of_ours(bench: Bench) -> None:
    with serving(bench) as server:
        assert ask(server, "/health", Host="192.168.1.5:8410")[0] == 403


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://127.0.0.1:1", "file://"])
@pytest.mark.parametrize("path", ["/status", "/stream", "/"])
def test_another_origin_is_refused(origin: str, path: str, bench: Bench) -> None:
    with serving(bench) as server:
        assert ask(server, path, Origin=origin)[0] == 403


def test_an_origin_that_is_no_address_is_refused(bench: Bench) -> None:
    with serving(bench) as server:
        assert ask(server, "/status", Origin="http://[")[0] == 400


def test_our_own_origin_passes(bench: Bench) -> None:
    with serving(bench) as server:
        assert ask(server, "/status", Origin=f"http://127.0.0.1:{server.address.port}")[0] == 200


def test_another_sites_picture_of_us_is_refused_and_its_link_to_us_is_not(bench: Bench) -> None:
    with serving(bench) as server:
        assert ask(server, "/stream", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="no-cors")[0] == 403
        assert ask(server, "/", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate")[0] == 200


@pytest.mark.parametrize("path", PATHS)
def test_without_the_token_nothing_is_told(path: str, bench: Bench) -> None:
    with serving(bench, token=TOKEN) as server:
        for headers in ({}, {"Cookie": f"aemd-{server.address.port}=no"}, {"Authorization": "Bearer no"}):
            status, _, body = ask(server, path, **headers)
            assert status == 401
            assert TOKEN.encode() not in body
        assert ask(server, f"{path}{'&' if '?' in path else '?'}token={TOKEN}x")[0] == 401


def test_the_token_in_the_address_becomes_a_cookie_that_scripts_cannot_read(bench: Bench) -> None:
    with serving(bench, token=TOKEN) as server:
        status, headers, _ = ask(server, f"/?token={TOKEN}")
        cookie = headers["set-cookie"]

        assert (status, headers["location"]) == (303, "/")
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        assert ask(server, "/status", Cookie=cookie.split(";")[0])[0] == 200
        assert ask(server, "/status", Authorization=f"Bearer {TOKEN}")[0] == 200
        assert ask(server, f"/metrics?token={TOKEN}")[0] == 200


def test_no_token_opens_for_a_wrong_host(bench: Bench) -> None:
    with serving(bench, token=TOKEN) as server:
        assert ask(server, f"/status?token={TOKEN}", Host="evil.example")[0] == 403


def test_where_others_can_reach_us_there_is_no_page_without_a_token(bench: Bench) -> None:
    with pytest.raises(ValueError, match="needs a token"):
        Access(Address("0.0.0.0", 8410), "")
    with serving(bench, host="0.0.0.0", token=TOKEN, hosts=("meter.example.org",)) as server:
        assert ask(server, "/status")[0] == 401
        for host in ("192.168.1.5:8410", "meter.example.org", socket.gethostname()):
            assert ask(server, f"/status?token={TOKEN}", Host=host)[0] == 200
        assert ask(server, f"/status?token={TOKEN}", Host="evil.example")[0] == 403


@given(word=st.text(max_size=60))
def test_no_word_but_the_token_is_the_token(word: str) -> None:
    access = Access(Address(), TOKEN)
    headers = {"Host": "localhost", "Cookie": word, "Authorization": word}
    with pytest.raises(Refusal):
        access.check(headers, word)


def test_tokens_are_long_and_differ() -> None:
    assert make_token() != make_token()
    assert re.fullmatch(r"[A-Za-z0-9_-]{24}", make_token())


@pytest.mark.parametrize("path", [*PATHS, "/nothing"])
def test_every_answer_forbids_what_the_page_does_not_need(path: str, bench: Bench) -> None:
    with serving(bench) as server:
        headers = ask(server, path)[1]

    policy = dict(part.split(" ", 1) for part in headers["content-security-policy"].split("; "))
    assert policy["default-src"] == policy["frame-ancestors"] == policy["form-action"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["cache-control"] == "no-store"
    assert not [name for name in headers if name.startswith("access-control")]
    assert "python" not in headers["server"].lower()


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "TRACE"])
def test_there_is_nothing_to_change_here(method: str, bench: Bench) -> None:
    with serving(bench) as server:
        assert ask(server, "/status", method)[0] == 405


@pytest.mark.parametrize(
    "query", ["begin_ms=x&end_ms=2", "begin_ms=5&end_ms=1", "begin_ms=0&end_ms=1e13", "begin_ms=nan&end_ms=1", ""]
)
def test_a_stretch_that_makes_no_sense_is_refused(query: str, bench: Bench) -> None:
    with serving(bench) as server:
        assert ask(server, f"/window?{query}")[0] == 400
        assert ask(server, "/stream?columns=1000000000")[0] == 400


@pytest.mark.parametrize(
    "request_",
    [b"\x00\xff\r\n\r\n", b"GET / HTTP/9\r\n\r\n", b"GET /" + b"a" * 70000, b"GET http://[ HTTP/1.1\r\n\r\n"],
)
def test_nonsense_gets_a_refusal_and_the_next_one_an_answer(request_: bytes, bench: Bench) -> None:
    with serving(bench) as server:
        client = socket.create_connection(("127.0.0.1", server.address.port), timeout=60)
        with client, suppress(ConnectionError):
            client.sendall(request_)
            client.shutdown(socket.SHUT_WR)
            client.recv(1000)
        assert ask(server, "/health")[0] == 200


def test_health_is_503_with_the_reason_when_the_meter_is_silent(bench: Bench) -> None:
    bench.read([1.0])
    with serving(bench) as server:
        assert ask(server, "/health")[::2] == (200, b"ok\n")
        bench.now_ns += 6 * 10**9
        bench.feed.tick()

        status, _, body = ask(server, "/health")

    assert status == 503
    assert body.startswith(b"acquisition: no reading for 6 s")


def read_frames(server: Server, count: int, path: str = "/stream?span_s=60&columns=200") -> list[dict[str, Any]]:
    connection = http.client.HTTPConnection("127.0.0.1", server.address.port, timeout=60)
    connection.request("GET", path)
    answer = connection.getresponse()
    found: list[dict[str, Any]] = []
    while len(found) < count:
        line = answer.readline()
        if line.startswith(b"data: "):
            found.append(json.loads(line[6:]))
    connection.close()
    return found


def test_the_stream_brings_readings_as_they_come(bench: Bench) -> None:
    bench.read([1.0, 2.0])
    with serving(bench) as server:
        first, second = read_frames(server, 2)

    assert first["fresh"]
    assert first["now"]["value_V"] == 2.0
    assert first["status"]["readings"] == 2
    assert {"histogram", "allan"} < first.keys()
    assert "status" not in second


@contextmanager
def stuck_viewers(server: Server, count: int) -> Iterator[None]:
    """Ask for the stream, and never read it."""
    with ExitStack() as stack:
        for _ in range(count):
            client = stack.enter_context(socket.socket())
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            client.connect(("127.0.0.1", server.address.port))
            client.sendall(b"GET /stream?span_s=600&columns=4000 HTTP/1.1\r\nHost: localhost\r\n\r\n")
        yield


def test_viewers_that_do_not_read_delay_neither_the_pipeline_nor_other_viewers(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("aemd.live.server.PATIENCE_S", 60.0)
    values = list(range(400))
    with serving(bench) as server, stuck_viewers(server, 6):
        worst = 0.0
        for start in range(0, 400, 4):
            began = time.perf_counter()
            bench.read([float(value) for value in values[start : start + 4]], tick=False)
            worst = max(worst, time.perf_counter() - began)
            bench.feed.tick()
        seen = read_frames(server, 1)[0]

    assert worst < 30.0  # whoever waited for one of them would wait for all its patience
    assert seen["now"]["index"] == 399


def test_who_does_not_read_is_given_up(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aemd.live.server.PATIENCE_S", 3.0)  # their requests have to arrive within it, too
    with serving(bench) as server, stuck_viewers(server, 2):
        deadline = time.monotonic() + 60
        while bench.feed.status()["viewers"] < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
        there = bench.feed.status()["viewers"]
        while bench.feed.status()["viewers"] and time.monotonic() < deadline:
            bench.read([0.0] * 100)  # what fills their sockets
            time.sleep(0.01)
        left = bench.feed.status()["viewers"]

    assert (there, left) == (2, 0)


def test_there_is_a_greatest_number_of_streams_and_a_closed_one_makes_room(bench: Bench) -> None:
    with serving(bench) as server:
        clients = []
        for _ in range(MOST_STREAMS):
            client = socket.create_connection(("127.0.0.1", server.address.port), timeout=60)
            client.sendall(b"GET /stream HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert b"200" in client.recv(15)
            clients.append(client)
        assert ask(server, "/stream")[0] == 503
        assert ask(server, "/health")[0] == 200
        clients.pop().close()
        deadline = time.monotonic() + 60
        while (status := ask(server, "/stream")[0]) != 200 and time.monotonic() < deadline:
            time.sleep(0.05)
        for client in clients:
            client.close()

    assert status == 200


def test_the_end_of_the_acquisition_ends_the_streams(bench: Bench) -> None:
    ended = threading.Event()
    with serving(bench) as server:
        client = socket.create_connection(("127.0.0.1", server.address.port), timeout=60)
        client.sendall(b"GET /stream HTTP/1.1\r\nHost: localhost\r\n\r\n")

        def read_to_the_end() -> None:
            while client.recv(1 << 16):
                pass
            ended.set()

        threading.Thread(target=read_to_the_end, daemon=True).start()
    assert ended.wait(60)
    client.close()


def test_a_taken_port_is_one_line_with_a_way_out(make_bench: Callable[[], Bench]) -> None:
    with (
        serving(make_bench()) as server,
        pytest.raises(UsageError, match=rf"--live 127.0.0.1:{server.address.port}: is taken; name another port"),
    ):
        Server(server.address, "", ())


@pytest.mark.parametrize("text", ["a b", "host:port", ":99999", "http://x", "u@h:1", "[::1", "1:2:3"])
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="must be HOST:PORT"):
        parse_address(text, Address(), "--live")


def test_who_sends_a_request_letter_by_letter_is_hung_up_on_in_time(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("aemd.live.server.PATIENCE_S", 0.5)
    with serving(bench) as server, socket.create_connection(("127.0.0.1", server.address.port)) as slow:
        slow.settimeout(0.1)
        until, heard = time.monotonic() + 60, b"?"
        while heard and time.monotonic() < until:
            try:
                slow.send(b"G")
                heard = slow.recv(1)
            except TimeoutError:
                continue
            except ConnectionError:
                heard = b""

    assert heard == b""
