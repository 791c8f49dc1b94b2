"""Nothing stays open: descriptors and threads before and after a link was opened, closed and lost, many times."""

import gc
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import pytest

import agilent34410
from aemd.acquire.devices import list_devices
from aemd.config import load_config
from aemd.doctor import examine
from aemd.errors import InstrumentError
from agilent34410.link import open_link
from sim34410 import Fault
from sim34410.faults import Kind
from tests.drivers.sim34410.links import counting_bench, served

TIMES = 20
OPTIONS = agilent34410.Options(baud_rate=115200)
LINKS = ["socket", "vxi11", "usb", "serial"]
NOBODY = [
    "TCPIP0::127.0.0.1::{port}::SOCKET",
    "TCPIP0::127.0.0.1,{port}::inst0::INSTR",
    "TCPIP0::no.such.host.invalid::5025::SOCKET",
    "USB0::0x0957::0x0607::NOSUCH::INSTR",
    "ASRL/dev/nonesuch::INSTR",
    "ASRL/dev/null::INSTR",
    "no resource",
]


def descriptors() -> dict[str, str]:
    """Return what this process has open."""
    names = {}
    for descriptor in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # the listing's own, closed by now
            names[descriptor.name] = str(descriptor.readlink())
    return names


@contextmanager
def nothing_left(act: Callable[[], object]) -> Iterator[None]:
    """Do it once, for what is opened once a process; then many times, without the garbage collector's help."""
    act()
    gc.collect()
    before, threads = descriptors(), threading.active_count()
    gc.disable()
    try:
        yield
        end_s = time.monotonic() + 60.0  # a server hears of a hang-up in its own time
        while len(descriptors()) > len(before) or threading.active_count() > threads:
            assert time.monotonic() < end_s, (set(descriptors().items()) - set(before.items()), threading.enumerate())
            time.sleep(0.01)
    finally:
        gc.enable()


@pytest.mark.parametrize("link", LINKS)
def test_a_link_that_was_used_and_closed_leaves_nothing_open(link: str) -> None:
    with served(counting_bench(time.monotonic_ns)) as resources:

        def use() -> None:
            with closing(open_link(resources[link], 60.0, OPTIONS.serial_line)) as line:
                line.query("*IDN?")

        with nothing_left(use):
            for _ in range(TIMES):
                use()


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("kind", ["silent", "unplug"])
def test_a_link_that_failed_leaves_nothing_open(kind: Kind, link: str) -> None:
    with served(counting_bench(time.monotonic_ns, [Fault(kind, at_s=0.0, lasts_s=1e6)])) as resources:

        def lose() -> None:
            with (
                suppress(InstrumentError),
                closing(open_link(resources[link], 0.02, OPTIONS.serial_line)) as line,
            ):
                line.query("*IDN?")

        with nothing_left(lose):
            for _ in range(TIMES):
                lose()


@pytest.mark.parametrize("resource", NOBODY)
def test_where_nobody_is_nothing_stays_open(resource: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]

    def try_it() -> None:
        with suppress(InstrumentError), closing(open_link(resource.format(port=port), 0.05)) as line:
            line.query("*IDN?")

    with nothing_left(try_it):
        for _ in range(TIMES):
            try_it()


def test_a_search_and_an_examination_leave_nothing_open() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    nobody = load_config(None).with_resource(f"TCPIP0::127.0.0.1::{port}::SOCKET")

    def look() -> None:
        list_devices(0.5, (f"127.0.0.1:{port}",), search=False)
        examine(nobody)

    with nothing_left(look):
        for _ in range(TIMES):
            look()
