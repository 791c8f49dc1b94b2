"""The device clear of USB-TMC against a device that takes its time, or does not obey (USBTMC 1.00, 4.2.1.6 and 7)."""

from types import SimpleNamespace

import pytest

from agilent34410.usbtmc import CHECK_CLEAR_STATUS, INITIATE_CLEAR, PENDING, SUCCESS, clear_usbtmc

FAILED = 0x80


class Device:
    """What pyusb gives: answers to the two requests, in turn, the last for ever; what else is asked is noted."""

    def __init__(self, to_initiate: int, *to_check: tuple[int, int]) -> None:
        self.to_initiate, self.to_check = to_initiate, list(to_check)
        self.read: list[int] = []
        self.cleared: list[int] = []
        endpoint = SimpleNamespace(wMaxPacketSize=512, read=lambda size, _timeout_ms: self.read.append(size))
        self.interface = SimpleNamespace(
            usb_dev=self,
            usb_intf=SimpleNamespace(bInterfaceNumber=0),
            usb_recv_ep=endpoint,
            usb_send_ep=SimpleNamespace(bEndpointAddress=2),
        )

    def ctrl_transfer(self, _kind: int, request: int, *_: int, timeout: int) -> tuple[int, ...]:
        assert timeout > 0
        if request == INITIATE_CLEAR:
            return (self.to_initiate,)
        assert request == CHECK_CLEAR_STATUS
        return self.to_check.pop(0) if len(self.to_check) > 1 else self.to_check[0]

    def clear_halt(self, address: int) -> None:
        self.cleared.append(address)


def test_a_device_that_waits_to_be_read_out_is_and_then_its_endpoint_is_freed() -> None:
    device = Device(SUCCESS, (PENDING, 1), (PENDING, 0), (PENDING, 1), (SUCCESS, 0))
    clear_usbtmc(device.interface, 60.0)

    assert device.read == [512, 512]
    assert device.cleared == [2]


@pytest.mark.parametrize(
    ("device", "why"),
    [
        (Device(FAILED, (SUCCESS, 0)), "refused to be cleared: USB-TMC status 0x80"),
        (Device(SUCCESS, (FAILED, 0)), "could not be cleared: USB-TMC status 0x80"),
        (Device(SUCCESS, (PENDING, 0)), "is not clear after 0.05 s"),
    ],
)
def test_a_device_that_does_not_obey_is_an_error_within_the_time(device: Device, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        clear_usbtmc(device.interface, 0.05)

    assert not device.cleared
