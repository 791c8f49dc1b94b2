"""What can be reached: USB-TMC devices, serial ports, VXI-11 instruments that answer a broadcast, and hosts one names.

Nothing is sent to a serial port or a USB device, which may be anything; a host is asked *IDN? on port 5025.
"""

import os
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Thread

from serial.tools import list_ports

__all__ = ["SYSFS", "Device", "list_devices", "list_usb"]

PORT = 5025  # of a raw SCPI socket, by its entry in the IANA list
HIGHEST_PORT = 65_535
LONGEST_ANSWER = 256
FIRST_PART = 0.9  # of the time is a host's and the search's, so that what became of them can be told
SEARCH = "search of the LAN"
SYSFS = Path("/sys/bus/usb/devices")
USB_TMC = ("fe", "03")  # class and subclass of the interface (USBTMC 1.00, table 43)


@dataclass(frozen=True, slots=True)
class Device:
    """One thing that may be an instrument."""

    resource: str
    """As a config's `resource`; empty where it cannot be opened."""
    link: str
    """USB, serial, LAN."""
    found: str
    """Who it is, as far as is known without disturbing it."""
    hint: str = ""
    """What stands in the way, and what to do."""


def list_devices(
    timeout_s: float, hosts: tuple[str, ...] = (), *, usb_tree: Path = SYSFS, search: bool = True
) -> list[Device]:
    """Return what is found within the time.

    Args:
        timeout_s: longest time altogether, s; the broadcasts of pyvisa-py take 2 s.
        hosts: names or addresses to ask on the LAN, `host` or `host:port`.
        usb_tree: where the kernel tells of USB devices.
        search: also list the serial ports and have pyvisa look, by broadcasts, for instruments on the LAN.
    """
    named: list[Device] = []
    outcomes: list[list[Device]] = []
    searches = [Thread(target=_ask_host, args=(host, timeout_s, named), daemon=True) for host in hosts]
    if search:
        searches.append(Thread(target=_search_lan, args=(FIRST_PART * timeout_s, outcomes), daemon=True))
    for one in searches:
        one.start()
    here = [*list_usb(usb_tree), *(_list_serial() if search else ())]
    end_s = time.monotonic() + timeout_s
    for one in searches:
        one.join(max(0.0, end_s - time.monotonic()))
    asked = sorted(named, key=lambda device: (device.resource, device.found))
    if search and not outcomes:
        outcomes = [[Device("", "LAN", SEARCH, f"not finished within {timeout_s:g} s; --timeout longer")]]
    return [*here, *asked, *(device for outcome in outcomes for device in outcome)]


def list_usb(tree: Path = SYSFS) -> list[Device]:
    """Return the USB-TMC devices by what the kernel says of them, which needs no permission."""
    found = []
    for interface in sorted(tree.glob("*:*")) if tree.is_dir() else []:
        if (_text(interface / "bInterfaceClass"), _text(interface / "bInterfaceSubClass")) != USB_TMC:
            continue
        device = tree / interface.name.partition(":")[0]
        vendor, product, serial = (_text(device / name) for name in ("idVendor", "idProduct", "serial"))
        said = " ".join(filter(None, (_text(device / "manufacturer"), _text(device / "product")))) or "a USB-TMC device"
        if not serial:
            hint = "it tells no serial number, by which it would be opened: use its LAN or RS-232"
            found.append(Device("", "USB", said, hint))
            continue
        resource = f"USB0::0x{vendor}::0x{product}::{serial}::INSTR"
        node = f"/dev/bus/usb/{_text(device / 'busnum'):0>3}/{_text(device / 'devnum'):0>3}"
        hint = ""
        if not os.access(node, os.R_OK | os.W_OK):
            hint = (
                f"no permission for {node}: install the udev rule (`sudo aemd install-service --system`; --dry-run"
                " shows it), then plug it in again"
            )
        found.append(Device(resource, "USB", said, hint))
    return found


def _list_serial() -> list[Device]:
    return [_name_serial(port.device) for port in sorted(list_ports.comports())]


def _name_serial(path: str) -> Device:
    hint = (
        "" if os.access(path, os.R_OK | os.W_OK) else f"no permission for {path}: join the group that owns it (dialout)"
    )
    return Device(f"ASRL{path}::INSTR", "serial", "a serial port", hint)


def _search_lan(timeout_s: float, outcomes: list[list[Device]]) -> None:
    """Let a process of its own search: pyvisa-py leaves its broadcasts' sockets open, and cannot be told to end.

    What it found is one outcome; there is none where it did not come to its end in time.
    """
    search = "import pyvisa; print(*pyvisa.ResourceManager('@py').list_resources('?*'), sep='\\n')"
    command = [sys.executable, "-W", "ignore", "-c", search]
    with suppress(subprocess.TimeoutExpired):
        found = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)  # noqa: S603 - our own
        if found.returncode:
            why = " ".join(found.stderr.split("\n")[-2:]).strip()
            outcomes.append([Device("", "LAN", SEARCH, f"failed: {why}")])
            return
        outcomes.append([_name(one) for one in found.stdout.split() if one.startswith(("TCPIP", "GPIB"))])


def _name(resource: str) -> Device:
    kind, _, rest = resource.partition("::")
    if kind.startswith("GPIB"):
        return Device(resource, "GPIB", "an instrument on this bus")
    is_hislip = "::hislip" in f"::{rest.lower()}"
    return Device(resource, "LAN", "a HiSLIP instrument" if is_hislip else "a VXI-11 instrument")


def _ask_host(host: str, timeout_s: float, named: list[Device]) -> None:
    name, _, port = host.partition(":")
    end_s = time.monotonic() + FIRST_PART * timeout_s
    try:
        number = _port(port)
        with socket.create_connection((name, number), timeout=FIRST_PART * timeout_s) as line:
            line.sendall(b"*IDN?\n")
            answer = b""
            while b"\n" not in answer and len(answer) < LONGEST_ANSWER:
                line.settimeout(max(0.001, end_s - time.monotonic()))
                piece = line.recv(LONGEST_ANSWER)
                if not piece:
                    break
                answer += piece
    except UnicodeError:
        named.append(Device("", "LAN", host, f"no computer can be called {name!r}; check the spelling"))
        return
    except ValueError as error:
        named.append(Device("", "LAN", host, str(error)))
        return
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        named.append(Device("", "LAN", host, f"{why}; is it on, and is the address right?"))
        return
    # Whoever listens there may say anything, also what would move a terminal's cursor.
    said = "".join(filter(str.isprintable, answer.decode("ascii", errors="backslashreplace").strip()))
    named.append(Device(f"TCPIP0::{name}::{number}::SOCKET", "LAN", said or host))


def _port(text: str) -> int:
    if not text:
        return PORT
    if not (text.isascii() and text.isdigit() and 0 < int(text) <= HIGHEST_PORT):
        raise ValueError(f"{text!r} is not a port, which is a number from 1 to {HIGHEST_PORT}")
    return int(text)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip() if path.is_file() else ""
    except OSError:
        return ""
