import os
import socket
import threading
import time
from pathlib import Path

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from aemd.acquire.devices import SEARCH, Device, _name, list_devices, list_usb


@pytest.fixture
def usb_tree(tmp_path: Path) -> Path:
    """What the kernel tells of a 34410A, and of a keyboard beside it."""
    device, interface = tmp_path / "1-2", tmp_path / "1-2:1.0"
    device.mkdir()
    interface.mkdir()
    told = {"idVendor": "0957", "idProduct": "0607", "serial": "MY47006594", "busnum": "99", "devnum": "7"}
    told |= {"manufacturer": "Agilent Technologies", "product": "34410A"}
    for name, text in told.items():
        (device / name).write_text(text + "\n")
    (interface / "bInterfaceClass").write_text("fe\n")
    (interface / "bInterfaceSubClass").write_text("03\n")
    (tmp_path / "1-3:1.0").mkdir()
    (tmp_path / "1-3:1.0" / "bInterfaceClass").write_text("03\n")
    return tmp_path


def test_a_usb_meter_that_may_not_be_opened_is_listed_with_what_to_do(usb_tree: Path) -> None:
    found = [device for device in list_devices(0.1, usb_tree=usb_tree, search=False) if device.link == "USB"]

    assert [device.resource for device in found] == ["USB0::0x0957::0x0607::MY47006594::INSTR"]
    assert found[0].found == "Agilent Technologies 34410A"
    assert "/dev/bus/usb/099/007: install the udev rule" in found[0].hint
    assert not os.access("/dev/bus/usb/099/007", os.R_OK)


def test_a_usb_device_without_a_serial_number_is_listed_and_not_offered(usb_tree: Path) -> None:
    (usb_tree / "1-2" / "serial").unlink()
    (found,) = list_usb(usb_tree)

    assert (found.resource, found.found) == ("", "Agilent Technologies 34410A")
    assert "no serial number" in found.hint


def test_a_search_that_is_cut_short_says_so_and_hides_no_serial_port(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(list_ports, "comports", lambda: [ListPortInfo(str(tmp_path / "ttyUSB0"))])
    found = list_devices(0.1, usb_tree=tmp_path)  # the broadcasts alone take a second

    assert [(device.resource, device.hint) for device in found] == [
        (
            f"ASRL{tmp_path}/ttyUSB0::INSTR",
            f"no permission for {tmp_path}/ttyUSB0: join the group that owns it (dialout)",
        ),
        ("", "not finished within 0.1 s; --timeout longer"),
    ]


def test_a_search_that_comes_to_its_end_does_not_say_that_it_was_cut_short(tmp_path: Path) -> None:
    found = list_devices(100.0, usb_tree=tmp_path)

    assert not [device for device in found if device.found == SEARCH and "not finished" in device.hint]


@pytest.mark.parametrize(
    ("resource", "link", "found"),
    [
        ("GPIB0::22::INSTR", "GPIB", "an instrument on this bus"),
        ("TCPIP::10.0.0.2::hislip0,4880::INSTR", "LAN", "a HiSLIP instrument"),
        ("TCPIP::10.0.0.2::INSTR", "LAN", "a VXI-11 instrument"),
    ],
)
def test_what_a_search_finds_is_called_by_its_own_link(resource: str, link: str, found: str) -> None:
    assert _name(resource) == Device(resource, link, found)


def test_a_named_host_is_asked_who_it_is_and_a_silent_or_absent_one_is_told_of(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as talking, socket.create_server(("127.0.0.1", 0)) as silent:

        def answer() -> None:
            line, _ = talking.accept()
            with line:
                if line.recv(100) == b"*IDN?\n":
                    line.sendall(b"\x1bAgilent Technologies,34410A,MY1,2.35\a\n")  # no terminal should see all of that

        thread = threading.Thread(target=answer)
        thread.start()
        ports = [talking.getsockname()[1], silent.getsockname()[1]]
        begun = time.monotonic()
        hosts = (*(f"127.0.0.1:{port}" for port in ports), "127.0.0.1:1")
        found = [device for device in list_devices(2.0, hosts, usb_tree=tmp_path, search=False) if device.link == "LAN"]
        thread.join()

    assert time.monotonic() - begun < 30.0
    said = {device.resource or device.found: device for device in found}
    assert said[f"TCPIP0::127.0.0.1::{ports[0]}::SOCKET"].found == "Agilent Technologies,34410A,MY1,2.35"
    assert "refused" in said["127.0.0.1:1"].hint
    assert said[f"127.0.0.1:{ports[1]}"].hint.startswith("timed out")


@pytest.mark.parametrize("host", ["192.168..5", "m" * 64])
def test_what_is_no_name_of_a_host_is_said_to_be_none(host: str, tmp_path: Path) -> None:
    (found,) = list_devices(30.0, (host,), usb_tree=tmp_path, search=False)

    assert found == Device("", "LAN", host, f"no computer can be called {host!r}; check the spelling")


@pytest.mark.parametrize("port", ["abc", "0", "65536", "-1", "\uff15"])
def test_what_is_no_port_is_said_to_be_none(port: str, tmp_path: Path) -> None:
    (found,) = list_devices(1.0, (f"127.0.0.1:{port}",), usb_tree=tmp_path, search=False)

    assert found.resource == ""
    assert f"{port!r} is not a port, which is a number from 1 to 65535" in found.hint
