"""Advice that fits what stands in the way, without a word to the instrument."""

import os
import socket
from pathlib import Path

import pytest

from aemd.acquire.reach import door_of, name_obstacle, way_to
from aemd.errors import InstrumentError
from agilent34410.knock import knock
from agilent34410.link import open_link

METER = "USB0::0x0957::0x0607::MY47006594::INSTR"


@pytest.fixture
def usb_tree(tmp_path: Path) -> Path:
    """What the kernel tells of one 34410A, whose node nobody has (there is no bus 99)."""
    device, interface = tmp_path / "1-2", tmp_path / "1-2:1.0"
    told = {"idVendor": "0957", "idProduct": "0607", "serial": "MY47006594", "busnum": "99", "devnum": "7"}
    for folder, files in ((device, told), (interface, {"bInterfaceClass": "fe", "bInterfaceSubClass": "03"})):
        folder.mkdir()
        for name, text in files.items():
            (folder / name).write_text(text + "\n")
    return tmp_path


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def test_a_usb_device_without_permission_names_the_udev_rule(usb_tree: Path) -> None:
    for spelling in (METER, "usb0::2391::1543::my47006594::instr", "USB::0x957::0x607::MY47006594::0::INSTR"):
        assert "install the udev rule" in name_obstacle(spelling, usb_tree=usb_tree)
    assert "sudo aemd install-service --system" in way_to(METER, 0.1, usb_tree=usb_tree)


def test_a_usb_device_that_may_be_opened_is_no_matter_of_permission(
    usb_tree: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda *_: True)

    assert name_obstacle(METER, usb_tree=usb_tree) == ""
    assert "may be opened: close other programs" in way_to(METER, 0.1, usb_tree=usb_tree)


def test_another_serial_number_is_not_on_the_bus(usb_tree: Path) -> None:
    assert "no such device on the USB" in name_obstacle(METER.replace("594", "595"), usb_tree=usb_tree)
    assert name_obstacle(METER, usb_tree=usb_tree / "none") == ""  # a system that does not tell of its USB


def test_a_serial_port_is_absent_or_none_or_barred(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    main, other = os.openpty()
    port = f"ASRL{os.ttyname(other)}::INSTR"

    assert "plug its adapter in" in name_obstacle(f"ASRL{tmp_path}/none::INSTR")
    assert "is no serial port" in name_obstacle(f"ASRL{tmp_path}/file::INSTR")
    assert name_obstacle(port) == ""
    assert "baud_rate, parity and flow_control" in way_to(port, 0.1)
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "join the group that owns it" in name_obstacle(port)
    os.close(main)
    os.close(other)


def test_the_line_of_a_link_that_cannot_be_opened_says_why() -> None:
    with pytest.raises(InstrumentError, match="there is no /dev/ttyNONE: plug its adapter in"):
        open_link("ASRL/dev/ttyNONE::INSTR", 0.1)


def test_a_host_is_unknown_or_without_the_port_or_does_not_answer() -> None:
    port = free_port()
    refused = way_to(f"TCPIP0::127.0.0.1::{port}::SOCKET", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        silent_port = listener.getsockname()[1]
        silent = way_to(f"TCPIP0::127.0.0.1::{silent_port}::SOCKET", 0.5)
        silent_vxi = way_to(f"TCPIP0::127.0.0.1,{silent_port}::inst0::INSTR", 0.5)

    assert "no computer is called '192.168..5'" in way_to("TCPIP0::192.168..5::5025::SOCKET", 0.5)
    assert "no computer is called 'no.such.host.invalid'" in way_to("TCPIP0::no.such.host.invalid::5025::SOCKET", 0.5)
    assert f"127.0.0.1 is there and has nothing at port {port}" in refused
    assert "TCPIP0::127.0.0.1::5025::SOCKET" in refused
    assert f"takes connections at port {silent_port}" in silent
    assert "a VXI-11 server" in silent_vxi


@pytest.mark.parametrize(
    ("resource", "door"),
    [
        ("TCPIP0::10.0.0.2::5025::SOCKET", ("10.0.0.2", "5025")),
        ("TCPIP::10.0.0.2", ("10.0.0.2", "111")),
        ("TCPIP0::10.0.0.2::INSTR", ("10.0.0.2", "111")),
        ("TCPIP0::10.0.0.2,1024::inst0::INSTR", ("10.0.0.2", "1024")),
        ("TCPIP0::10.0.0.2::inst0,5025::INSTR", ("10.0.0.2", "111")),
        ("tcpip0::10.0.0.2::HiSLIP0::instr", ("10.0.0.2", "4880")),
        ("TCPIP0::10.0.0.2::hislip0,4881::INSTR", ("10.0.0.2", "4881")),
        ("TCPIP0::10.0.0.2::SOCKET", ("10.0.0.2", "SOCKET")),
        ("TCPIP0::SOCKET", ("SOCKET", "")),
        ("TCPIP0", ("", "111")),
    ],
)
def test_the_door_is_the_one_at_which_pyvisa_py_seeks(resource: str, door: tuple[str, str]) -> None:
    assert door_of(resource) == door


def test_knock_and_advice_are_of_the_same_door() -> None:
    with socket.socket() as door:
        door.bind(("127.0.0.1", 0))  # nobody else's, and refused as long as nobody listens
        port = door.getsockname()[1]
        resource = f"TCPIP0::127.0.0.1::hislip0,{port}::INSTR"
        with pytest.raises(ConnectionRefusedError):
            knock(resource, 60.0)
        assert f"127.0.0.1 is there and has nothing at port {port}" in way_to(resource, 60.0)
        door.listen()
        knock(resource, 60.0)
        assert f"takes connections at port {port}" in (advice := way_to(resource, 60.0))
    assert "a HiSLIP server" in advice


def test_what_is_no_resource_is_shown_one() -> None:
    assert "TCPIP0::HOST::5025::SOCKET" in way_to("the meter on my desk", 0.1)


@pytest.mark.parametrize("resource", ["TCPIP0::127.0.0.1,x::inst0::INSTR", "TCPIP0::127.0.0.1::70000::SOCKET"])
def test_a_port_that_is_none_is_told_of_and_no_other_is_tried(resource: str) -> None:
    assert "as a number from 1 to 65535" in way_to(resource, 0.1)
