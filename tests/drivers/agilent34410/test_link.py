import os
import re
import select
import socket
import struct
import termios
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from threading import Event

import pytest

from aemd.errors import InstrumentError
from agilent34410 import Options
from agilent34410.knock import knock
from agilent34410.link import Link, open_link
from tests.drivers.agilent34410.bench import served, stranger, unused_resource


def opened(resource: str, timeout_s: float = 60.0) -> Link:
    """Open a line that waits for what comes for as long as a slow machine takes; where silence is meant, say less."""
    return open_link(resource, timeout_s)


def answer_in_time(link: Link, question: str) -> str:
    """Ask over a line of a short timeout until the answer comes within it."""
    for _ in range(100):
        try:
            return link.query(question)
        except InstrumentError:
            link.drain()
    raise AssertionError("no answer at all")


def test_a_line_and_a_block_come_back_whole_with_every_byte_value() -> None:
    content = bytes(range(256)) * 313
    with stranger(lambda line: b"#%d%d%s\n" % (len(str(len(content))), len(content), content)) as resource:
        link = opened(resource)

        assert link.query_block("R?", len(content)) == (content, "")
        link.close()


def test_an_empty_block_leaves_the_line_in_step() -> None:
    with stranger(lambda line: b"#10\n" if line == b"R?" else b"later\n") as resource:
        link = opened(resource)

        assert link.query_block("R?", 0) == (b"", "")
        assert link.query("*IDN?") == "later"
        link.close()


@pytest.mark.parametrize(
    ("answer", "what"),
    [
        (b"", "no whole answer within 0.3 s"),
        (b"#3100half of it", "no whole answer within 0.3 s"),
        (b"garbage\n", "the answer begins with b'ga' instead of a block's #"),
        (b"#0\n", "the answer begins with b'#0' instead of a block's #"),
        (b"#3x00\n", "invalid literal"),
    ],
)
def test_a_block_that_is_not_whole_is_one_clear_error_within_the_timeout(answer: bytes, what: str) -> None:
    with stranger(lambda line: answer) as resource:
        link = opened(resource, 0.3 if "0.3 s" in what else 60.0)
        begun = time.monotonic()

        with pytest.raises(InstrumentError, match=re.escape(what)) as caught:
            link.query_block("R? 100", 800)
        assert str(caught.value).startswith(f"{resource}: R? 100: ")
        assert "\n" not in str(caught.value)
        assert time.monotonic() - begun < 30.0
        link.close()


def test_a_refused_port_is_found_out_by_the_first_question() -> None:
    resource = unused_resource()
    link = opened(resource)

    with pytest.raises(
        InstrumentError, match=rf"^{re.escape(resource)}: \*IDN\?: .*refused.*check that the instrument"
    ):
        link.query("*IDN?")


def test_a_peer_that_hangs_up_is_an_error_at_once() -> None:
    with stranger(lambda line: None) as resource, closing(opened(resource)) as link:
        begun_s, begun_cpu_s = time.monotonic(), time.thread_time()
        with pytest.raises(InstrumentError, match="the other end has closed the connection"):
            link.query("*IDN?")

        assert time.monotonic() - begun_s < 30.0  # not after the timeout of 60 s
        assert time.thread_time() - begun_cpu_s < 1.0
        assert not link.is_open


@pytest.mark.parametrize("pieces", [1, 7, 300])
def test_a_block_is_whole_however_it_is_cut_on_its_way(pieces: int) -> None:
    content = bytes(range(256)) * 4  # every byte, so newlines, too
    answer = b"#41024" + content + b";+17\n"
    with socket.create_server(("127.0.0.1", 0)) as listener, ThreadPoolExecutor(1) as pool:

        def serve() -> None:
            line, _ = listener.accept()
            with line:
                line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                for _ in range(2):
                    line.recv(100)
                    size = -(-len(answer) // pieces)
                    for at in range(0, len(answer), size):
                        line.sendall(answer[at : at + size])
                        time.sleep(0)  # the reader has its turn between two of them

        served = pool.submit(serve)
        with closing(open_link(f"TCPIP0::127.0.0.1::{listener.getsockname()[1]}::SOCKET", 60.0)) as link:
            for _ in range(2):
                assert link.query_block("R? 128;:STAT:QUES:ENAB?", 1024) == (content, ";+17")
        served.result()


def test_an_answer_that_never_ends_is_given_up_after_the_timeout_however_often_something_comes() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener, ThreadPoolExecutor(1) as pool:

        def serve() -> None:
            line, _ = listener.accept()
            with line, suppress(ConnectionError):
                line.recv(100)
                while line.send(b"x"):
                    time.sleep(0.01)

        served = pool.submit(serve)
        with closing(open_link(f"TCPIP0::127.0.0.1::{listener.getsockname()[1]}::SOCKET", 0.3)) as link:
            begun_s = time.monotonic()
            with pytest.raises(InstrumentError, match="no whole answer"):
                link.query("*IDN?")
            assert 0.25 < time.monotonic() - begun_s < 30.0
        served.result()


def test_a_link_that_failed_is_used_again_only_after_what_came_late_was_thrown_away() -> None:
    given_up = Event()

    def answer(line: bytes) -> bytes:
        if line == b"slow":
            given_up.wait(60)
        return b"to " + line + b"\n"

    with stranger(answer) as resource:
        link = opened(resource, 0.3)
        with pytest.raises(InstrumentError, match="no whole answer"):
            link.query("slow")
        with pytest.raises(InstrumentError, match="the link has failed; drain it or open it again"):
            link.query("quick")
        given_up.set()
        select.select([link._inner.interface], [], [], 60)  # type: ignore[attr-defined] # the late answer is here
        link.drain()

        assert answer_in_time(link, "quick") == "to quick"
        link.close()
        with pytest.raises(InstrumentError, match="the link is closed; open it again"):
            link.query("quick")


@pytest.mark.timeout(20)
def test_draining_a_line_whose_other_end_has_gone_ends_and_closes_it() -> None:
    with stranger(lambda line: None) as resource:
        link = opened(resource)
        with pytest.raises(InstrumentError, match="the other end has closed the connection"):
            link.query("*IDN?")

        assert not link.is_open
        with pytest.raises(InstrumentError, match="the link is closed"):
            link.drain()


def test_a_line_that_is_not_quiet_is_not_drained_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agilent34410.link.MOST_DRAIN_S", 0.0)
    monkeypatch.setattr("agilent34410.link.QUIET_S", 60.0)  # the other end may be kept waiting, too
    much = b"x" * 100_000_000
    with stranger(lambda line: much) as resource:
        link = opened(resource)
        with pytest.raises(InstrumentError):
            link.query("*IDN?")
        with pytest.raises(InstrumentError, match="it goes on sending what nobody asked for"):
            link.drain()

        assert not link.is_open


@pytest.mark.parametrize(
    ("resource", "way_out"),
    [
        ("", "TCPIP0::192.168.1.5::5025::SOCKET"),
        ("nonsense", "TCPIP0::192.168.1.5::5025::SOCKET"),
        ("TCPIP0::127.0.0.1::SOCKET", "TCPIP0::192.168.1.5::5025::SOCKET"),
        ("TCPIP0::no.such.host.invalid::1::SOCKET", "the address"),
        ("TCPIP0::192.168..5::5025::SOCKET", "no computer can be called so; .*"),
        ("TCPIP0::192.168..5::inst0::INSTR", "no computer can be called so; .*"),
        ("TCPIP0::127.0.0.1,1::inst0::INSTR", "the address"),
        ("TCPIP0::127.0.0.1,x::inst0::INSTR", "TCPIP0::192.168.1.5::5025::SOCKET"),
        ("TCPIP0::127.0.0.1,0::inst0::INSTR", "TCPIP0::192.168.1.5::5025::SOCKET"),
        ("TCPIP0::127.0.0.1,65536::inst0::INSTR", "TCPIP0::192.168.1.5::5025::SOCKET"),
    ],
)
def test_a_malformed_address_is_refused_with_an_example_of_a_right_one_and_no_other_is(
    resource: str, way_out: str
) -> None:
    with pytest.raises(InstrumentError, match=rf"cannot open: .*{way_out}$"):
        opened(resource).query("*IDN?")


def test_whoever_keeps_a_connection_open_is_not_waited_for() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        begun_s = time.monotonic()
        knock(f"TCPIP0::127.0.0.1,{listener.getsockname()[1]}::inst0::INSTR", 60.0)

        assert time.monotonic() - begun_s < 4.0


@pytest.mark.parametrize(
    ("resource", "why"),
    [
        ("TCPIP0::127.0.0.1,1::inst0::INSTR", "connection refused"),
        ("ASRL/dev/nonesuch::INSTR", "no such file or directory"),
        (
            "TCPIP0::no.such.host.invalid::5025::SOCKET",
            "(name or service not known|temporary failure in name resolution)",
        ),
        ("USB0::0x0957::0x0607::NOSUCH::INSTR", "No device found"),
        ("TCPIP0::127.0.0.1::hislip0::INSTR", "connection refused"),
        ("TCPIP0::127.0.0.1::hislip0,1::INSTR", "connection refused"),
    ],
)
def test_why_a_link_cannot_be_opened_is_said_in_words_without_numbers(resource: str, why: str) -> None:
    with pytest.raises(InstrumentError, match=rf"^{re.escape(resource)}: cannot open: {why}; "):
        opened(resource)


@pytest.mark.parametrize(("error", "says"), [(9, "it has given out all it has"), (8, "error 8")])
def test_a_vxi_11_server_that_gives_out_no_link_is_quoted_in_words(error: int, says: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener, ThreadPoolExecutor(1) as pool:

        def serve() -> None:
            with listener.accept()[0] as line:
                line.settimeout(60)
                line.recv(1)  # the knock, which says nothing
            line, _ = listener.accept()
            with line:
                line.settimeout(60)
                call = line.recv(100)
                answer = struct.pack(">9I", 1, 0, 0, 0, 0, error, 0, 0, 0)
                line.sendall(struct.pack(">I", 1 << 31 | 4 + len(answer)) + call[4:8] + answer)
                line.recv(100)

        listener.settimeout(60)
        served = pool.submit(serve)
        with pytest.raises(InstrumentError, match=f"it gives out no link: {says}; "):
            opened(f"TCPIP0::127.0.0.1,{listener.getsockname()[1]}::inst0::INSTR")
        served.result()


def test_a_serial_line_has_the_speed_and_the_flow_control_that_are_asked_for() -> None:
    master, slave = os.openpty()
    try:
        asked = Options(baud_rate=115_200, flow_control="rts_cts").serial_line
        with closing(open_link(f"ASRL{os.ttyname(slave)}::INSTR", 1.0, asked)):
            _, _, control, _, in_speed, out_speed, _ = termios.tcgetattr(slave)
    finally:
        os.close(slave)
        os.close(master)

    assert in_speed == out_speed == termios.B115200
    assert control & termios.CRTSCTS


def test_closing_one_link_leaves_another_open() -> None:
    with served() as (resource, _):
        one, other = opened(resource), opened(resource)
        one.close()
        one.close()

        assert "34410A" in other.query("*IDN?")
        other.close()


@pytest.mark.parametrize("is_answered", [True, False])
def test_what_a_failed_link_has_still_to_send_is_thrown_away_and_a_good_one_ends_in_order(*, is_answered: bool) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        # Where nothing is to come, 0.2 s are enough to know it.
        link = open_link(f"TCPIP0::127.0.0.1::{listener.getsockname()[1]}::SOCKET", 60.0 if is_answered else 0.2)
        other, _ = listener.accept()
        with other:
            if is_answered:
                other.sendall(b"somebody\n")
                assert link.query("*IDN?") == "somebody"
            else:
                with pytest.raises(InstrumentError):
                    link.query("*IDN?")
            link.close()

            # Reset: a question in a buffer must not arrive when the cable is back, and take readings out of the meter.
            end = select.poll()
            end.register(other, select.POLLRDHUP)
            end.poll(60_000)  # ms
            assert (other.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) != 0) is not is_answered


def test_half_an_answer_is_thrown_away_by_a_drain_and_is_no_begin_of_the_next() -> None:
    with (
        stranger(lambda line: b"half" if line == b"first" else b"whole\n") as resource,
        closing(opened(resource, 0.3)) as link,
    ):
        with pytest.raises(InstrumentError, match="no whole answer"):
            link.query("first")
        link.drain()

        assert answer_in_time(link, "second") == "whole"
