import os
import socket
import threading
import time
from pathlib import Path

import pytest

from aemd.acquire.devices import Device, list_devices


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


def test_a_named_host_is_asked_who_it_is_and_a_silent_or_absent_one_is_told_of(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as talking, socket.create_server(("127.0.0.1", 0)) as silent:

        def answer() -> None:
            line, _ = talking.accept()
            with line:
                if line.recv(100) == b"*IDN?\n":
                    line.sendall(b"Agilent Technologies,34410A,MY1,2.35\n")

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
