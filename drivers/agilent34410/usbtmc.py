"""Device clear on USB-TMC, which pyvisa-py 0.8 lacks (USBTMC 1.00, sections 4.2.1.6 and 4.2.1.7)."""

import time
from typing import Any

__all__ = ["clear_usbtmc"]

CLASS_REQUEST_TO_INTERFACE = 0xA1  # device to host, class, interface
INITIATE_CLEAR, CHECK_CLEAR_STATUS = 5, 6
SUCCESS, PENDING = 1, 2
BULK_IN_IS_FULL = 1  # bmClear.D0
PAUSE_S = 0.01


def clear_usbtmc(interface: Any, timeout_s: float) -> None:
    """Have the device throw away what it was told and what it was about to say; the endpoints are ready afterwards.

    Args:
        interface: pyvisa-py's USBTMC of an open session (its pyusb device and endpoints).
        timeout_s: longest wait for each answer, and altogether for the clear, s.

    Raises:
        ValueError: the device refused, or was not done in time.
        OSError: the device is gone (pyusb's USBError is one).
    """
    device, timeout_ms = interface.usb_dev, max(1, round(timeout_s * 1000))
    number = interface.usb_intf.bInterfaceNumber
    status = device.ctrl_transfer(CLASS_REQUEST_TO_INTERFACE, INITIATE_CLEAR, 0, number, 1, timeout=timeout_ms)
    if status[0] != SUCCESS:
        raise ValueError(f"the device refused to be cleared: USB-TMC status {status[0]:#x}")
    end_s = time.monotonic() + timeout_s
    while True:
        status = device.ctrl_transfer(CLASS_REQUEST_TO_INTERFACE, CHECK_CLEAR_STATUS, 0, number, 2, timeout=timeout_ms)
        if status[0] != PENDING:
            break
        if time.monotonic() > end_s:
            raise ValueError(f"the device is not clear after {timeout_s:g} s")
        if len(status) > 1 and status[1] & BULK_IN_IS_FULL:  # it waits for its queue to be read out
            interface.usb_recv_ep.read(interface.usb_recv_ep.wMaxPacketSize, timeout_ms)
        else:
            time.sleep(PAUSE_S)
    if status[0] != SUCCESS:
        raise ValueError(f"the device could not be cleared: USB-TMC status {status[0]:#x}")
    # The device holds the Bulk-OUT endpoint halted from INITIATE_CLEAR on until the host says that it has noticed.
    device.clear_halt(interface.usb_send_ep.bEndpointAddress)
