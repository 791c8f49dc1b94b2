# ruff: noqa: ARG002 - the arguments are pyusb's
"""Simulated USB-TMC meters as a back end of pyusb, in the place of libusb: pyvisa-py lists and opens them unchanged."""

import errno
import importlib
import struct
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

# pyusb has no types; mypy says so at one of the three, not always the same.
import usb.backend.libusb1  # type: ignore[import-untyped, unused-ignore]
from usb.backend import IBackend  # type: ignore[import-untyped, unused-ignore]
from usb.core import USBError, USBTimeoutError  # type: ignore[import-untyped, unused-ignore]

from sim34410.usb import BULK_IN, Stall, UsbDevice

__all__ = ["UsbBackend", "plugged_in"]

_POLL_S = 0.2e-3  # between two looks at a device that has nothing to say yet


@contextmanager
def plugged_in(*devices: UsbDevice) -> "Iterator[UsbBackend]":
    """Have pyusb find these devices and no others.

    While inside, `pyvisa.ResourceManager("@py")` lists them and opens `USB0::0x0957::0x0607::SERIAL::INSTR`. Where no
    libusb is installed, pyvisa-py has given up on USB when it was imported; it is made to look again.
    """
    backend = UsbBackend(devices)
    before = usb.backend.libusb1.get_backend
    usb.backend.libusb1.get_backend = lambda *_, **__: backend
    try:
        with suppress(ImportError):
            importlib.import_module("pyvisa_py.usb")
        yield backend
    finally:
        usb.backend.libusb1.get_backend = before


@dataclass(frozen=True, slots=True)
class _Plug:
    """A device as it was enumerated; gone, once it has been unplugged, even when it is back."""

    device: UsbDevice
    number: int


class UsbBackend(IBackend):  # type: ignore[misc]  # pyusb has no types
    """What pyusb asks of libusb, as far as pyvisa-py needs it."""

    def __init__(self, devices: Sequence[UsbDevice]) -> None:
        self._devices = devices

    # -- what there is -----------------------------------------------------------------------------------------------

    def enumerate_devices(self) -> Iterator[_Plug]:
        """Yield what is plugged in."""
        for device in self._devices:
            with device.bench.lock:
                number = device.plugs
            if number is not None:
                yield _Plug(device, number)

    def get_parent(self, dev: _Plug) -> None:
        """Return None: there is no hub."""

    def get_device_descriptor(self, dev: _Plug) -> SimpleNamespace:
        """Return the descriptor with the fields' names as USB 2.0 has them, and where on the bus it is."""
        names = (
            "bLength bDescriptorType bcdUSB bDeviceClass bDeviceSubClass bDeviceProtocol bMaxPacketSize0"
            " idVendor idProduct bcdDevice iManufacturer iProduct iSerialNumber bNumConfigurations"
        )
        address = 1 + self._devices.index(dev.device) + len(self._devices) * dev.number
        place = {"address": address, "bus": 1, "port_number": 1, "port_numbers": (1,), "speed": 3}
        return _descriptor(names, "<BBHBBBBHHHBBBB", dev.device.device_descriptor, **place)

    def get_configuration_descriptor(self, dev: _Plug, config: int) -> SimpleNamespace:
        """Return the only one."""
        if config:
            raise IndexError(config)
        names = (
            "bLength bDescriptorType wTotalLength bNumInterfaces bConfigurationValue iConfiguration"
            " bmAttributes bMaxPower"
        )
        return _descriptor(names, "<BBHBBBBB", dev.device.configuration_descriptor)

    def get_interface_descriptor(self, dev: _Plug, intf: int, alt: int, config: int) -> SimpleNamespace:
        """Return the only one."""
        if intf or alt or config:
            raise IndexError(intf)
        names = (
            "bLength bDescriptorType bInterfaceNumber bAlternateSetting bNumEndpoints"
            " bInterfaceClass bInterfaceSubClass bInterfaceProtocol iInterface"
        )
        return _descriptor(names, "<9B", dev.device.configuration_descriptor[9:])

    def get_endpoint_descriptor(self, dev: _Plug, ep: int, intf: int, alt: int, config: int) -> SimpleNamespace:
        """Return one of the three."""
        names = "bLength bDescriptorType bEndpointAddress bmAttributes wMaxPacketSize bInterval"
        also = {"bRefresh": 0, "bSynchAddress": 0}
        return _descriptor(names, "<BBBBHB", dev.device.configuration_descriptor[18 + 7 * ep :], **also)

    # -- opening -----------------------------------------------------------------------------------------------------

    def open_device(self, dev: _Plug) -> _Plug:
        """Return what the other calls take."""
        with dev.device.bench.lock:
            _make_sure(dev)
            if not dev.device.bench.is_open:
                raise USBError("Resource busy", errno=errno.EBUSY)
        return dev

    def close_device(self, dev_handle: _Plug) -> None:
        """Let go."""
        device = dev_handle.device
        with device.bench.lock:
            if device.plugs == dev_handle.number:
                device.close()

    def set_configuration(self, dev_handle: _Plug, config_value: int) -> None:
        """Obey without effect."""

    def get_configuration(self, dev_handle: _Plug) -> int:
        """Return the only one."""
        with dev_handle.device.bench.lock:
            _make_sure(dev_handle)
        return 1

    def set_interface_altsetting(self, dev_handle: _Plug, intf: int, altsetting: int) -> None:
        """Obey without effect."""

    def claim_interface(self, dev_handle: _Plug, intf: int) -> None:
        """Obey without effect."""

    def release_interface(self, dev_handle: _Plug, intf: int) -> None:
        """Obey without effect."""

    def is_kernel_driver_active(self, dev_handle: _Plug, intf: int) -> bool:
        """Return False."""
        return False

    def reset_device(self, dev_handle: _Plug) -> None:
        """Obey without effect."""

    # -- transfers ---------------------------------------------------------------------------------------------------

    def ctrl_transfer(
        self,
        dev_handle: _Plug,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: "array[int]",
        timeout: int,
    ) -> int:
        """Fill `data`, where the device sends; return how many bytes."""
        length = len(data) * data.itemsize
        answer = _do(dev_handle, lambda device: device.control(bmRequestType, bRequest, wValue, wIndex, length))
        data[: len(answer)] = array("B", answer)
        return len(answer) if bmRequestType & 0x80 else length

    def bulk_write(self, dev_handle: _Plug, ep: int, intf: int, data: "array[int]", timeout: int) -> int:
        """Send; return how many bytes."""
        content = data.tobytes()
        _do(dev_handle, lambda device: device.bulk_out(content))
        return len(content)

    def bulk_read(self, dev_handle: _Plug, ep: int, intf: int, buff: "array[int]", timeout: int) -> int:
        """Fill `buff` until a short packet; return how many bytes."""
        size = len(buff) * buff.itemsize
        arrived = _wait(dev_handle, lambda device: device.bulk_in(size) if ep == BULK_IN else None, timeout)
        buff[: len(arrived)] = array("B", arrived)
        return len(arrived)

    def intr_read(self, dev_handle: _Plug, ep: int, intf: int, size: "array[int]", timeout: int) -> int:
        """Fill `size`, which is the buffer, with a notification; return how many bytes."""
        arrived = _wait(dev_handle, UsbDevice.interrupt_in, timeout)
        size[: len(arrived)] = array("B", arrived)
        return len(arrived)

    def clear_halt(self, dev_handle: _Plug, ep: int) -> None:
        """Clear an endpoint's halt."""
        _do(dev_handle, lambda device: device.clear_halt(ep))


def _descriptor(names: str, form: str, content: bytes, **more: Any) -> SimpleNamespace:
    fields = struct.unpack_from(form, content)
    return SimpleNamespace(**dict(zip(names.split(), fields, strict=True)), extra_descriptors=[], **more)


def _make_sure(plug: _Plug) -> None:
    if plug.device.plugs != plug.number:
        raise USBError("No such device (it may have been disconnected)", errno=errno.ENODEV)


def _do(plug: _Plug, action: Callable[[UsbDevice], Any]) -> Any:
    with plug.device.bench.lock:
        _make_sure(plug)
        try:
            return action(plug.device)
        except Stall:
            raise USBError("Pipe error", errno=errno.EPIPE) from None


def _wait(plug: _Plug, action: Callable[[UsbDevice], bytes | None], timeout_ms: int) -> bytes:
    end_s = time.monotonic() + timeout_ms * 1e-3 if timeout_ms else float("inf")
    while True:
        arrived: bytes | None = _do(plug, action)
        if arrived is not None:
            return arrived
        if time.monotonic() >= end_s:
            raise USBTimeoutError("Operation timed out", errno=errno.ETIMEDOUT)
        time.sleep(_POLL_S)
