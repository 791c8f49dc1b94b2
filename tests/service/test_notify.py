"""Notification: what systemd would hear, on a real datagram socket; and a watchdog that a wedged stage starves."""

import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import pytest

from aemd.block import Batch
from aemd.record.background import Background
from aemd.service import Notifier, Pulse, Watchdog, watched


class Listener:
    """The other end of the socket."""

    def __init__(self, address: str | bytes) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.settimeout(30)
        self.socket.bind(address)

    def hear(self) -> dict[str, str]:
        return dict(line.split("=", 1) for line in self.socket.recv(4096).decode().splitlines())

    def hear_until(self, key: str) -> dict[str, str]:
        while key not in (heard := self.hear()):
            pass
        return heard

    def heard_within(self, seconds: float) -> set[str]:
        """Everything that comes in this time, by name."""
        names: set[str] = set()
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            self.socket.settimeout(left)
            try:
                names |= self.hear().keys()
            except TimeoutError:
                break
        return names


@pytest.fixture
def listener(tmp_path: Path) -> Iterator[Listener]:
    there = Listener(str(tmp_path / "notify"))
    yield there
    there.socket.close()


def notifier(listener: Listener, **more: str) -> Notifier:
    return Notifier({"NOTIFY_SOCKET": listener.socket.getsockname(), **more})


def test_ready_and_status_are_lines_of_one_datagram(listener: Listener) -> None:
    notifier(listener).ready("14.90/s\nand more")

    assert listener.hear() == {"READY": "1", "STATUS": "14.90/s and more"}


def test_an_abstract_address_is_reached_too() -> None:
    name = f"aemd-test-{os.getpid()}"
    there = Listener(b"\0" + name.encode())
    Notifier({"NOTIFY_SOCKET": "@" + name}).alive()

    assert there.hear() == {"WATCHDOG": "1"}
    there.socket.close()


@pytest.mark.parametrize("environment", [{}, {"NOTIFY_SOCKET": "/nowhere/at/all"}, {"NOTIFY_SOCKET": "\0"}])
def test_nobody_listening_is_no_error(environment: dict[str, str]) -> None:
    Notifier(environment).ready("up")


@pytest.mark.parametrize(
    ("micros", "pid", "expected_s"),
    [("30000000", "", 30.0), ("30000000", "ours", 30.0), ("30000000", "1", 0.0), ("soon", "", 0.0)],
)
def test_the_watchdogs_time_is_taken_if_it_is_meant_for_us(micros: str, pid: str, expected_s: float) -> None:
    pid = str(os.getpid()) if pid == "ours" else pid

    assert Notifier({"WATCHDOG_USEC": micros, "WATCHDOG_PID": pid}).watchdog_s == expected_s


ALIVE = Pulse(acquiring=2, delivered=20, waiting=5, writing=2)


@pytest.mark.parametrize(
    ("now", "alive"),
    [
        (ALIVE, True),
        (Pulse(1, 20, 5, 2), False),  # nobody speaks to the instrument
        (Pulse(2, 10, 5, 2), False),  # readings wait, and nobody takes them
        (Pulse(2, 10, 0, 2), True),  # none waits: an outage, or a long interval
        (Pulse(2, 20, 5, 1), False),  # the writer hangs
    ],
)
def test_the_watchdog_is_fed_only_while_every_stage_moves(now: Pulse, alive: bool) -> None:
    assert Watchdog(Pulse(acquiring=1, delivered=10, waiting=0, writing=1)).is_alive(now) is alive


def test_a_stage_may_move_between_any_two_looks_since_it_was_last_fed() -> None:
    watchdog = Watchdog(Pulse(1, 10, 0, 1))

    assert not watchdog.is_alive(Pulse(2, 10, 0, 1))
    assert watchdog.is_alive(Pulse(2, 10, 0, 2))
    assert not watchdog.is_alive(Pulse(2, 10, 0, 2))


class WedgingDisk:
    def __init__(self) -> None:
        self.hangs = threading.Event()
        self.hanging = threading.Event()
        self.let_go = threading.Event()
        self.due_in_s = math.inf

    def write(self, batch: Batch, estimates: object) -> None:
        if self.hangs.is_set():
            self.hanging.set()
            self.let_go.wait(60)

    def close(self, reason: str = "stop", *, facts: object = None, clock: object = None) -> Path:
        return Path()

    def discard(self) -> None:
        pass


def test_a_wedged_writer_stops_the_watchdog(listener: Listener) -> None:
    disk = WedgingDisk()
    writer = Background(disk, tick_s=0.01)
    looks = count()
    told = notifier(listener, WATCHDOG_USEC="80000")

    def status() -> str:
        """Say another thing in each round, so that rounds can be counted however late they are."""
        return f"{next(looks)} {'hanging' if disk.hanging.is_set() else 'up'}"

    with watched(told, lambda: Pulse(next(looks), 0, 0, writer.turns), status):
        assert listener.hear_until("WATCHDOG")
        disk.hangs.set()
        while not listener.hear_until("STATUS")["STATUS"].endswith("hanging"):
            pass
        listener.hear_until("STATUS")  # the round before may have seen it move
        later = [key for _ in range(10) for key in listener.hear()]
        disk.let_go.set()
        writer.close()

    assert later == ["STATUS"] * 10


def start(listener: Listener, folder: Path, **more: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "NOTIFY_SOCKET": listener.socket.getsockname(), **more}
    command = [sys.executable, "-m", "aemd", "acquire", "--out", str(folder)]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)


def test_a_service_is_ready_when_its_file_is_there_is_fed_and_says_that_it_stops(
    listener: Listener, tmp_path: Path
) -> None:
    process = start(listener, tmp_path / "rec", WATCHDOG_USEC="4000000")
    try:
        assert listener.hear()["READY"] == "1"
        assert list((tmp_path / "rec").glob("*.mcap.active"))
        assert "/s" in listener.hear_until("STATUS")["STATUS"]
        listener.hear_until("WATCHDOG")
        process.send_signal(signal.SIGHUP)  # systemctl reload of a unit that someone gave an ExecReload
        process.send_signal(signal.SIGTERM)
        stopping = listener.hear_until("STOPPING")
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()

    assert int(stopping["EXTEND_TIMEOUT_USEC"]) >= 1_000_000
    assert process.returncode == 0
    assert "reload ignored" in err
    assert list((tmp_path / "rec").glob("*.mcap"))
    assert not list((tmp_path / "rec").glob("*.active"))


def test_on_a_terminal_a_hangup_ends_it_as_ctrl_c_does(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "aemd", "acquire", "--out", str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until = time.monotonic() + 60
        while not list(tmp_path.glob("*.active")):
            assert time.monotonic() < until
            time.sleep(0.05)
        process.send_signal(signal.SIGHUP)
        code = process.wait(timeout=60)
    finally:
        process.kill()

    assert code == 0
    assert len(list(tmp_path.glob("*.mcap"))) == 1


def test_a_status_that_cannot_be_made_is_told_and_the_watchdog_lives(listener: Listener) -> None:
    moves = count()
    told = notifier(listener, WATCHDOG_USEC="200000")

    def status() -> str:
        raise FileNotFoundError("the folder is gone")

    with watched(told, lambda: Pulse(next(moves), 0, 0, next(moves)), status):
        assert listener.hear_until("STATUS")["STATUS"] == "state unknown: the folder is gone"
        assert listener.hear_until("WATCHDOG")
        assert listener.hear_until("WATCHDOG")


def test_a_folder_that_is_removed_under_a_service_is_in_its_status_and_does_not_starve_it(
    listener: Listener, tmp_path: Path
) -> None:
    process = start(listener, tmp_path / "rec", WATCHDOG_USEC="4000000")
    try:
        assert listener.hear()["READY"] == "1"
        shutil.rmtree(tmp_path / "rec")
        while "NOT RECORDING: somebody has removed" not in listener.hear_until("STATUS")["STATUS"]:
            pass
        assert listener.hear_until("WATCHDOG")
        (tmp_path / "rec").mkdir()
        while "NOT RECORDING" in listener.hear_until("STATUS")["STATUS"]:
            pass
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=60)
    finally:
        process.kill()

    assert process.returncode == 0
    assert len(list((tmp_path / "rec").glob("*.mcap"))) == 1


def test_a_long_timeout_of_the_meters_asks_the_watchdog_for_more_time_and_a_short_one_does_not(
    listener: Listener,
) -> None:
    told = notifier(listener, WATCHDOG_USEC="30000000")
    told.ready("up", 20.0)
    told.ready("up", 600.0)
    Notifier({"NOTIFY_SOCKET": listener.socket.getsockname()}).ready("up", 600.0)  # there is no watchdog

    heard = [listener.hear().get("WATCHDOG_USEC") for _ in range(3)]
    assert heard == [None, "600000000", None]
