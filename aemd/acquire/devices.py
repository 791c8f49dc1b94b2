"""What can be reached: USB-TMC devices, serial ports, VXI-11 instruments that answer a broadcast, and hosts one names.

Nothing is sent to a serial port or a USB device, which may be anything; a host is asked *IDN? on port 5025.
"""

import os
import socket
import time
from dataclasses import dataclass
from pathlib import Path
from threading import Thread

__all__ = ["Device", "list_devices"]

PORT = 5025  # of a raw SCPI socket, by its entry in the IANA list
LONGEST_ANSWER = 256
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
        search: also have pyvisa look for serial ports and, by broadcasts, for instruments on the LAN.
    """
    named: list[Device] = []
    listed: list[str] = []
    searches = [Thread(target=_ask_host, args=(host, timeout_s, named), daemon=True) for host in hosts]
    if search:
        searches.append(Thread(target=_list_resources, args=(listed,), daemon=True))
    for one in searches:
        one.start()
    usb = _list_usb(usb_tree)
    end_s = time.monotonic() + timeout_s
    for one in searches:
        one.join(max(0.0, end_s - time.monotonic()))
    known = {device.resource for device in usb}
    others = [_name(resource) for resource in list(listed) if resource.startswith(("ASRL", "TCPIP", "GPIB"))]
    return [
        *usb,
        *sorted(named, key=lambda device: (device.resource, device.found)),
        *(device for device in others if device.resource not in known),
    ]


def _list_resources(listed: list[str]) -> None:
    import warnings  # noqa: PLC0415

    import pyvisa  # noqa: PLC0415 - slow to import, and only this search needs it

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it misses optional packages
        try:
            manager = pyvisa.ResourceManager("@py")
            listed += manager.list_resources("?*")
            manager.close()
        except Exception:  # noqa: BLE001 - a search that fails has found nothing; pyvisa-py raises anything
            return


def _name(resource: str) -> Device:
    if resource.startswith("ASRL"):
        return _serial(resource)
    return Device(resource, "LAN", "a VXI-11 instrument")


def _serial(resource: str) -> Device:
    path = resource.removeprefix("ASRL").partition("::")[0]
    if os.access(path, os.R_OK | os.W_OK):
        return Device(resource, "serial", "a serial port")
    return Device(
        resource, "serial", "a serial port", f"no permission for {path}: join the group that owns it (dialout)"
    )


def _ask_host(host: str, timeout_s: float, named: list[Device]) -> None:
    name, _, port = host.partition(":")
    try:
        number = int(port) if port else PORT
        with socket.create_connection((name, number), timeout=timeout_s) as line:
            line.sendall(b"*IDN?\n")
            answer = b""
            while b"\n" not in answer and len(answer) < LONGEST_ANSWER:
                piece = line.recv(LONGEST_ANSWER)
                if not piece:
                    break
                answer += piece
    except (OSError, ValueError) as error:
        why = (getattr(error, "strerror", None) or str(error) or "no answer").lower()
        named.append(Device("", "LAN", host, f"{why}; is it on, and is the address right?"))
        return
    said = answer.decode("ascii", errors="backslashreplace").strip()
    named.append(Device(f"TCPIP0::{name}::{number}::SOCKET", "LAN", said or host))


def _list_usb(tree: Path) -> list[Device]:
    """Return the USB-TMC devices by what the kernel says of them, which needs no permission."""
    found = []
    for interface in sorted(tree.glob("*:*")) if tree.is_dir() else []:
        if (_text(interface / "bInterfaceClass"), _text(interface / "bInterfaceSubClass")) != USB_TMC:
            continue
        device = tree / interface.name.partition(":")[0]
        vendor, product, serial = (_text(device / name) for name in ("idVendor", "idProduct", "serial"))
        said = " ".join(filter(None, (_text(device / "manufacturer"), _text(device / "product")))) or "a USB-TMC device"
        resource = f"USB0::0x{vendor}::0x{product}::{serial}::INSTR"
        node = f"/dev/bus/usb/{_text(device / 'busnum'):0>3}/{_text(device / 'devnum'):0>3}"
        hint = ""
        if not os.access(node, os.R_OK | os.W_OK):
            hint = f"no permission for {node}: install the udev rule (aemd install-service), then plug it in again"
        found.append(Device(resource, "USB", said, hint))
    return found


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip() if path.is_file() else ""
    except OSError:
        return ""
