"""Why nobody answers at a resource, as far as the system knows it, and what to do about it.

Nothing is said to the instrument: names are looked up, a connection is made and closed, files and sysfs are read.
"""

import errno
import os
import socket
import stat
from pathlib import Path

from aemd.acquire.devices import SYSFS, list_usb

__all__ = ["door_of", "name_obstacle", "way_to"]

SCPI_PORT = 5025  # of a raw SCPI socket, by its entry in the IANA list
TERMINALS = Path("/sys/class/tty")
PSEUDO_TERMINALS = Path("/dev/pts")
PORT_MAPPER = "111"  # tells the port of VXI-11, where a resource does not
HISLIP = "4880"  # by its entry in the IANA list


def name_obstacle(resource: str, *, usb_tree: Path = SYSFS) -> str:
    """Return what this computer has against opening a serial port or a USB device, and the way out; empty for nothing.

    Args:
        resource: the VISA resource.
        usb_tree: where the kernel tells of USB devices.
    """
    kind = resource.upper()
    if kind.startswith("ASRL"):
        return _serial_obstacle(Path(resource[4:].partition("::")[0]))
    if kind.startswith("USB"):
        return _usb_obstacle(resource, usb_tree)
    return ""


def way_to(resource: str, timeout_s: float, *, usb_tree: Path = SYSFS) -> str:
    """Return what to do about a resource at which no instrument answers.

    Args:
        resource: the VISA resource.
        timeout_s: longest wait for a connection, s.
        usb_tree: where the kernel tells of USB devices.
    """
    kind = resource.upper()
    if obstacle := name_obstacle(resource, usb_tree=usb_tree):
        return obstacle
    if kind.startswith("TCPIP"):
        return _way_to_host(resource, timeout_s)
    if kind.startswith("ASRL"):
        return (
            "the port can be opened: check that the meter is on, its cable (a null modem), and that baud_rate, parity"
            " and flow_control are those of its menu, with 8 data bits; close other programs that use the port"
        )
    if kind.startswith("USB") and not usb_tree.is_dir():
        return "check power and cable; `aemd devices` lists what is there"
    if kind.startswith("USB"):
        return (
            "the device is there and may be opened: close other programs that use it, then pull its plug and put it in"
            " again"
        )
    return "write it as TCPIP0::HOST::5025::SOCKET, USB0::...::INSTR or ASRL/dev/ttyUSB0::INSTR; see `aemd devices`"


def door_of(resource: str) -> tuple[str, str]:
    """Return the host and the port at which pyvisa-py seeks a resource of the LAN, both as they are written.

    VXI-11 has its port after the host, HiSLIP after the name of the device; what stands at the other place is not the
    port: of `10.0.0.2::inst0,5025` the port mapper is asked.

    >>> door_of("TCPIP0::10.0.0.2::hislip0::INSTR")
    ('10.0.0.2', '4880')

    Args:
        resource: a VISA resource whose kind is TCPIP.
    """
    _, where, what = [*resource.split("::"), "", ""][:3]
    host, _, port = where.partition(",")
    if resource.upper().endswith("::SOCKET"):
        return host, what
    device, _, its_port = what.lower().partition(",")
    if device.startswith("hislip"):
        return host, its_port or HISLIP
    return host, port or PORT_MAPPER


def _serial_obstacle(path: Path) -> str:
    try:
        mode = path.stat().st_mode
    except OSError:
        return f"there is no {path}: plug its adapter in; `aemd devices` lists the ports that there are"
    is_tty = (TERMINALS / path.resolve().name).exists() or path.parent == PSEUDO_TERMINALS or not TERMINALS.is_dir()
    if not (stat.S_ISCHR(mode) and is_tty):
        return f"{path} is no serial port; `aemd devices` lists those that there are"
    if not os.access(path, os.R_OK | os.W_OK):
        return f"no permission for {path}: join the group that owns it ({_group(path)}), then log in again"
    return ""


def _group(path: Path) -> str:
    try:
        return path.group()
    except (KeyError, OSError):
        return "dialout"


def _usb_obstacle(resource: str, tree: Path) -> str:
    if not tree.is_dir():
        return ""  # a system that does not tell
    wanted = _usb_name(resource)
    for device in list_usb(tree):
        if _usb_name(device.resource) == wanted:
            return device.hint
    return "no such device on the USB: check power and cable; `aemd devices` lists what is there"


def _usb_name(resource: str) -> tuple[int | str, ...]:
    """Return vendor, product and serial, however their numbers are written."""
    fields = resource.split("::")[1:4]
    try:
        return tuple(int(field, 0) for field in fields[:2]) + tuple(field.upper() for field in fields[2:])
    except ValueError:
        return tuple(fields)


def _way_to_host(resource: str, timeout_s: float) -> str:
    host, number = door_of(resource)
    if not (number.isascii() and number.isdigit() and 0 < int(number) < 1 << 16):
        return f"write its port, {number!r}, as a number from 1 to 65535; the raw socket of a meter is at {SCPI_PORT}"
    port = int(number)
    try:
        socket.create_connection((host, port), timeout=timeout_s).close()
    except (socket.gaierror, UnicodeError):  # the second, where it cannot even be a name: 192.168..5
        return f"no computer is called {host!r}: check the spelling, or use the address that the meter's menu shows"
    except ConnectionRefusedError:
        other = f"TCPIP0::{host}::{SCPI_PORT}::SOCKET" if port != SCPI_PORT else f"TCPIP0::{host}::inst0::INSTR"
        return (
            f"{host} is there and has nothing at port {port}: check that it is the meter's address, and its LAN"
            f" services in its menu; or try {other}"
        )
    except OSError as error:
        why = "no way to" if error.errno in (errno.ENETUNREACH, errno.EHOSTUNREACH) else "no sign of"
        return (
            f"{why} {host}: check the meter's power and network cable, and that the address is the one that its menu"
            " shows"
        )
    what = "the raw socket of a meter, which is at port 5025"
    if not resource.upper().endswith("::SOCKET"):
        what = "a HiSLIP server" if "::HISLIP" in resource.upper() else "a VXI-11 server"
    return (
        f"{host} takes connections at port {port} and does not answer as an instrument does: check that this"
        f" is {what}; close other programs that use it, or switch it off and on to end theirs"
    )
